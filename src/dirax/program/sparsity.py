"""Which results of a function depend on which of its unknowns: index sets through the jaxpr, an array of them at a time.

The set of every entry of an array is a row of one sparse matrix of booleans. What moves entries about takes rows, what computes
entry by entry unites them, a sum is a product of matrices. Nothing is found by trying values: a set can be too large and never
too small.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
import scipy.sparse as sp
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Literal
from jax.interpreters import partial_eval

import dirax.program.rules  # noqa: F401  (registers the rules)
from dirax.program.interpreter import RULES
from dirax.program.rules.reductions import FOLDS

MOST_PER_UNKNOWN = 256
"""Entries of the sets of one array, for each of its entries and of the unknowns, from which on a function counts as dense."""

MOVES = frozenset(
    ("reshape", "squeeze", "expand_dims", "broadcast_in_dim", "transpose", "rev", "concatenate", "stack", "unstack", "tile")
    + ("split", "slice")
)
"""Primitives whose rules run on arrays of numbers of any kind."""

BY_ENTRY = frozenset(
    ("add", "add_any", "sub", "mul", "div", "rem", "neg", "sign", "max", "min", "abs", "pow", "integer_pow", "square", "sqrt")
    + ("rsqrt", "cbrt", "exp", "exp2", "expm1", "log", "log1p", "logistic", "sin", "cos", "tan", "asin", "acos", "atan", "atan2")
    + ("sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "erf", "erfc", "erf_inv", "lgamma", "digamma", "floor", "ceil", "round")
    + ("nextafter", "clamp", "convert_element_type", "copy", "copy_p", "reduce_precision", "real", "imag", "stop_gradient")
    + ("optimization_barrier", "bessel_i0e", "bessel_i1e", "igamma", "igammac", "polygamma")
)
CALLS = {
    "jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr", "core_call": "call_jaxpr", "remat2": "jaxpr",
    "checkpoint": "jaxpr", "custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr", "custom_vjp_call_jaxpr": "fun_jaxpr",
}  # fmt: skip
BY_MATRIX = frozenset(("lu", "triangular_solve", "cholesky", "eigh", "svd", "qr", "lu_pivots_to_permutation", "householder_product"))


class Dense(Exception):
    """Raised where index sets become too large to be of use; says what made them so."""


def pattern_of(function: Callable, unknowns: Any, *others: Any) -> sp.csr_matrix:
    """Where the Jacobian of `function(unknowns, *others)`, an array of floats, can have entries: booleans (results, unknowns).

    `unknowns` is a vector; all arguments are values or `jax.ShapeDtypeStruct`s. Other floats than unknowns are not looked at,
    whole numbers among them are, where their values are known. Raises `Dense`.
    """
    shaped = lambda x: x if isinstance(x, jax.ShapeDtypeStruct) else jax.ShapeDtypeStruct(np.shape(x), jax.numpy.result_type(x))
    closed = jax.make_jaxpr(function)(*jax.tree.map(shaped, (unknowns, *others)))
    size = math.prod(unknowns.shape)
    known = [_known(leaf) for leaf in jax.tree.leaves(others)]
    (found,) = _Sets(size).run(closed, [sp.identity(size, bool, "csr"), *known])
    return found if isinstance(found, sp.csr_matrix) else sp.csr_matrix((closed.out_avals[0].size, size), dtype=bool)


def _known(value: Any) -> np.ndarray | None:
    """A value that index sets may depend on; None for one that is not known."""
    if isinstance(value, Tracer | jax.ShapeDtypeStruct):
        return None
    return np.asarray(value)


class _Sets:
    """Runs jaxprs on index sets: a value is a matrix of them, an array that is known, or None for anything else."""

    def __init__(self, size: int):
        self.size = size

    def run(self, closed: ClosedJaxpr, operands: Sequence[Any]) -> list[Any]:
        jaxpr, used = partial_eval.dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars))[:2]
        operands = [operand for operand, needed in zip(operands, used, strict=True) if needed]
        values: dict[Any, Any] = dict(zip(closed.jaxpr.constvars, map(_known, closed.consts), strict=True))
        values.update(zip(jaxpr.constvars, (values[v] for v in jaxpr.constvars), strict=True))
        values.update(zip(jaxpr.invars, operands, strict=True))
        read = lambda atom: np.asarray(atom.val) if isinstance(atom, Literal) else values[atom]
        for equation in jaxpr.eqns:
            results = self.equation(equation, [read(atom) for atom in equation.invars])
            for variable, result in zip(equation.outvars, results, strict=True):
                if isinstance(result, sp.csr_matrix):
                    if not np.issubdtype(variable.aval.dtype, np.inexact):
                        result = None  # what is not a float has no derivative
                    elif result.nnz > MOST_PER_UNKNOWN * (self.size + result.shape[0]):
                        raise Dense(f"the results of '{equation.primitive.name}' depend on too many unknowns each")
                values[variable] = result
        return [read(atom) for atom in jaxpr.outvars]

    def equation(self, equation: Any, operands: list[Any]) -> list[Any]:
        name, p, count = equation.primitive.name, equation.params, len(equation.outvars)
        moves = any(isinstance(o, sp.csr_matrix) for o in operands)
        if name in CALLS:
            inner = p[CALLS[name]]
            closed = inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())
            return self.run(closed, operands)
        if name.startswith("dirax_"):
            if not moves:
                return [None] * count
            impl = lambda *given: equation.primitive.impl(*given, **p)
            return self.run(jax.make_jaxpr(impl)(*(v.aval for v in equation.invars)), operands)
        if name in MOVES or name == "pad":
            return self.moved(equation, operands)
        if not moves:
            return self.values(equation, operands)
        if name == "select_n":
            return [self.selected(equation, *operands)]
        if name in BY_ENTRY:
            return [self.united(equation, operands)] * count
        if name in FOLDS and "axes" in p:
            return [self.folded(operands[0], equation.invars[0].aval.shape, p["axes"])]
        if name == "dot_general":
            return [self.product(equation, *operands)]
        if name in ("gather", "dynamic_slice"):
            return [self.gathered(equation, *operands)]
        if name.startswith("scatter"):
            return [self.scattered(equation, *operands)]
        if name == "dynamic_update_slice":
            return [self.updated(equation, *operands)]
        if name == "cond":
            return self.branches(equation, operands)
        if name in BY_MATRIX:
            return self.by_matrix(equation, operands)
        return self.all_of_all(equation, operands)

    # ---------------------------------------------------------------------------------------------- what moves entries

    def moved(self, equation: Any, operands: list[Any]) -> list[Any]:
        """Numbers of entries are moved; the number 0 is that of an entry which depends on nothing."""
        rule = _pad if equation.primitive.name == "pad" else RULES[equation.primitive.name]
        if not any(isinstance(o, sp.csr_matrix) for o in operands):
            return [None] * len(equation.outvars) if any(o is None for o in operands) else list(rule(None, equation, *operands))
        numbers, parts, first = [], [], 1
        for variable, operand in zip(equation.invars, operands, strict=True):
            shape = variable.aval.shape
            if isinstance(operand, sp.csr_matrix):
                numbers.append(np.arange(first, first + operand.shape[0]).reshape(shape))
                parts.append(operand)
                first += operand.shape[0]
            else:
                numbers.append(np.zeros(shape, np.int64))
        sets = parts[0] if len(parts) == 1 else sp.vstack(parts, "csr")
        return [self.rows(sets, moved) for moved in rule(None, equation, *numbers)]

    def rows(self, sets: sp.csr_matrix, numbers: np.ndarray) -> sp.csr_matrix:
        """The sets of entries with these numbers, counted from 1; 0 for the empty set."""
        flat = numbers.ravel()
        if len(flat) == sets.shape[0] and np.array_equal(flat, np.arange(1, len(flat) + 1)):
            return sets
        pointers = np.append(sets.indptr, sets.indptr[-1])
        extended = sp.csr_matrix((sets.data, sets.indices, pointers), (sets.shape[0] + 1, self.size))
        return extended[np.where(flat > 0, flat - 1, sets.shape[0])]

    def gathered(self, equation: Any, sets: Any, *indices: Any) -> Any:
        if not isinstance(sets, sp.csr_matrix):
            return None  # an index has no derivative
        if any(not isinstance(i, np.ndarray) for i in indices):
            raise Dense(f"'{equation.primitive.name}' has indices that depend on values")
        numbers = np.arange(1, sets.shape[0] + 1).reshape(equation.invars[0].aval.shape)
        options = {"fill_value": 0} if equation.primitive.name == "gather" else {}
        return self.rows(sets, _evaluated(equation, [numbers, *indices], **options)[0])

    def scattered(self, equation: Any, sets: Any, indices: Any, updates: Any) -> Any:
        if not isinstance(indices, np.ndarray):
            raise Dense(f"'{equation.primitive.name}' has indices that depend on values")
        shape = equation.invars[0].aval.shape
        put = lambda updates: _scatter_add(equation, np.zeros(shape), indices, updates)
        numbers = np.arange(1.0, math.prod(shape) + 1).reshape(shape)
        with jax.ensure_compile_time_eval():
            given = jax.ShapeDtypeStruct(equation.invars[2].aval.shape, np.float64)
            places = np.asarray(jax.linear_transpose(put, given)(jax.numpy.asarray(numbers))[0]).ravel().astype(int)
        total = math.prod(shape)
        kept = sets if isinstance(sets, sp.csr_matrix) else None
        if kept is not None and equation.primitive.name == "scatter":  # what is written over is gone
            keep = np.ones(total, bool)
            keep[places[places > 0] - 1] = False
            kept = self.rows(kept, np.where(keep, np.arange(1, total + 1), 0))
        if not isinstance(updates, sp.csr_matrix):
            return kept
        inside = np.flatnonzero(places > 0)
        put = sp.csr_matrix((np.ones(len(inside), bool), (places[inside] - 1, inside)), (total, len(places)))
        return _union(kept, put @ updates)

    def updated(self, equation: Any, sets: Any, updates: Any, *starts: Any) -> Any:
        if any(not isinstance(s, np.ndarray) for s in starts):
            raise Dense("'dynamic_update_slice' has indices that depend on values")
        shape = equation.invars[0].aval.shape
        size = math.prod(shape)
        count = equation.invars[1].aval.size
        numbers = np.arange(1, size + 1).reshape(shape)
        new = np.arange(size + 1, size + count + 1).reshape(equation.invars[1].aval.shape)
        place = _evaluated(equation, [numbers, new, *starts])[0]
        empty = lambda rows: sp.csr_matrix((rows, self.size), dtype=bool)
        both = [s if isinstance(s, sp.csr_matrix) else empty(n) for s, n in ((sets, size), (updates, count))]
        return self.rows(sp.vstack(both, "csr"), place)

    # ------------------------------------------------------------------------------------------- what computes entries

    def spread(self, operand: sp.csr_matrix, variable: Any, size: int) -> sp.csr_matrix:
        """The sets of an operand of one entry, for each of `size` entries."""
        return operand if variable.aval.size == size else self.rows(operand, np.ones(size, int))

    def united(self, equation: Any, operands: list[Any]) -> Any:
        size = equation.outvars[0].aval.size
        given = list(zip(operands, equation.invars, strict=True))
        found = None
        for operand, variable in given:
            if isinstance(operand, sp.csr_matrix):
                found = _union(found, self.spread(operand, variable, size))
        if equation.primitive.name == "mul":
            for operand, _ in given:
                if isinstance(operand, np.ndarray) and not np.all(operand):
                    zero = np.broadcast_to(operand.ravel() == 0.0, size)
                    found = self.rows(found, np.where(zero, 0, np.arange(1, size + 1)))
        return found

    def selected(self, equation: Any, which: Any, *cases: Any) -> Any:
        size = equation.outvars[0].aval.size
        if isinstance(which, np.ndarray):
            which, found = np.broadcast_to(which.ravel(), size), None
            for k, case in enumerate(cases):
                if isinstance(case, sp.csr_matrix):
                    found = _union(found, self.rows(case, np.where(which == k, np.arange(1, size + 1), 0)))
            return found
        found = None
        for case in cases:
            if isinstance(case, sp.csr_matrix):
                found = _union(found, case)
        return found

    def folded(self, sets: sp.csr_matrix, shape: tuple[int, ...], axes: Sequence[int]) -> sp.csr_matrix:
        kept = [n for axis, n in enumerate(shape) if axis not in axes]
        inner = tuple(1 if axis in axes else n for axis, n in enumerate(shape))
        groups = np.broadcast_to(np.arange(math.prod(kept)).reshape(inner), shape).ravel()
        total = sp.csr_matrix((np.ones(len(groups), bool), (groups, np.arange(len(groups)))), (math.prod(kept), len(groups)))
        return total @ sets

    def product(self, equation: Any, a: Any, b: Any) -> Any:
        (ca, cb), (ba, bb) = equation.params["dimension_numbers"]
        of = [(a, equation.invars[0].aval.shape, ca, ba), (b, equation.invars[1].aval.shape, cb, bb)]
        sizes = []
        for _, shape, contracted, batched in of:
            free = [i for i in range(len(shape)) if i not in (*contracted, *batched)]
            sizes.append((*(math.prod(shape[i] for i in axes) for axes in (batched, free, contracted)), free))
        (batch, rows, length, _), (_, columns, _, _) = sizes
        found = None
        for k, (operand, shape, contracted, batched) in enumerate(of):
            if not isinstance(operand, sp.csr_matrix):
                continue
            free = sizes[k][3]
            order = np.arange(math.prod(shape)).reshape(shape).transpose((*batched, *free, *contracted)).ravel()
            sets = operand[order]
            other, own = of[1 - k][0], sizes[k][1]
            if isinstance(other, np.ndarray):
                across = _arranged(*of[1 - k]) != 0.0  # (batch, free of the other, length)
            else:
                across = None
            outer = rows if k else columns
            if across is None or np.all(across):
                sums = self.folded(sets, (batch * own, length), (1,))
                index = np.broadcast_to(np.arange(batch * own).reshape(batch, own, 1), (batch, own, outer))
                index = index if k == 0 else index.transpose(0, 2, 1)
                part = self.rows(sums, index + 1)
            else:
                where, row, at = np.nonzero(across)
                i = np.arange(own)
                out = (where[:, None] * rows + i) * columns + row[:, None] if k == 0 else (
                    (where[:, None] * rows + row[:, None]) * columns + i
                )  # fmt: skip
                source = (where[:, None] * own + i) * length + at[:, None]
                ones = np.ones(out.size, bool)
                taken = sp.csr_matrix((ones, (out.ravel(), source.ravel())), (batch * rows * columns, len(order)))
                part = taken @ sets
            found = _union(found, part)
        return found

    def by_matrix(self, equation: Any, operands: list[Any]) -> list[Any]:
        """Each matrix of a batch by itself."""
        lead = equation.invars[0].aval.shape[:-2]
        batch, found = math.prod(lead), None
        for variable, operand in zip(equation.invars, operands, strict=True):
            if isinstance(operand, sp.csr_matrix):
                found = _union(found, self.folded(operand, (batch, variable.aval.size // max(batch, 1)), (1,)))
        each = [variable.aval.size // max(batch, 1) for variable in equation.outvars]
        return [self.rows(found, np.repeat(np.arange(1, batch + 1), count)) for count in each]

    def branches(self, equation: Any, operands: list[Any]) -> list[Any]:
        found: list[Any] = [None] * len(equation.outvars)
        for branch in equation.params["branches"]:
            results = self.run(branch, operands[1:])
            found = [_union(a, b) if isinstance(b, sp.csr_matrix) else a for a, b in zip(found, results, strict=True)]
        return found

    def all_of_all(self, equation: Any, operands: list[Any]) -> list[Any]:
        """What is not known: every result depends on everything."""
        found = None
        for operand in operands:
            if isinstance(operand, sp.csr_matrix):
                found = _union(found, self.folded(operand, (operand.shape[0],), (0,)))
        assert found is not None
        sizes = [variable.aval.size for variable in equation.outvars]
        if found.nnz * sum(sizes) > MOST_PER_UNKNOWN * (self.size + sum(sizes)):
            raise Dense(f"'{equation.primitive.name}' is not followed")
        return [self.rows(found, np.ones(size, int)) for size in sizes]

    def values(self, equation: Any, operands: list[Any]) -> list[Any]:
        """Of what depends on no unknown the whole numbers are followed, for they can be indices, and constants that are moved."""
        whole = all(np.issubdtype(v.aval.dtype, np.integer) or v.aval.dtype == np.bool_ for v in equation.outvars)
        if not whole or equation.effects or any(not isinstance(o, np.ndarray) for o in operands):
            return [None] * len(equation.outvars)
        if equation.primitive.name == "iota":
            return list(_iota(equation))
        if equation.primitive.name in BY_ENTRY or equation.primitive.name in COMPARISONS or equation.primitive.name in INDEXING:
            return _evaluated(equation, operands)
        return [None] * len(equation.outvars)


COMPARISONS = frozenset(("lt", "le", "gt", "ge", "eq", "ne", "and", "or", "not", "xor", "is_finite", "select_n"))
INDEXING = frozenset(("gather", "dynamic_slice", "cumsum", "reduce_sum", "scatter", "scatter-add", "sort", "argsort"))


def _union(a: sp.csr_matrix | None, b: sp.csr_matrix) -> sp.csr_matrix:
    if a is None or a is b:
        return b
    return a if b.nnz == 0 else b if a.nnz == 0 else sp.csr_matrix(a + b)


def _arranged(array: Any, shape: tuple[int, ...], contracted: Sequence[int], batched: Sequence[int]) -> np.ndarray:
    """(batch, free, contracted)."""
    free = [i for i in range(len(shape)) if i not in (*contracted, *batched)]
    sizes = (math.prod(shape[i] for i in axes) for axes in (batched, free, contracted))
    return np.asarray(array).reshape(shape).transpose((*batched, *free, *contracted)).reshape(*sizes)


def _evaluated(equation: Any, operands: list[np.ndarray], **options: Any) -> list[np.ndarray]:
    """The results of an equation for known operands, also while JAX traces."""
    with jax.ensure_compile_time_eval():
        found = equation.primitive.bind(*map(jax.numpy.asarray, operands), **(equation.params | options))
    return [np.asarray(a) for a in (found if equation.primitive.multiple_results else [found])]


def _scatter_add(equation: Any, zeros: np.ndarray, indices: np.ndarray, updates: Any) -> Any:
    p = equation.params
    return jax.lax.scatter_add(
        jax.numpy.asarray(zeros), jax.numpy.asarray(indices), updates, p["dimension_numbers"],
        indices_are_sorted=p["indices_are_sorted"], unique_indices=p["unique_indices"], mode=p["mode"],
    )  # fmt: skip


def _pad(_: Any, equation: Any, x: np.ndarray, filler: np.ndarray) -> list[np.ndarray]:
    out = np.full(equation.outvars[0].aval.shape, filler.item(), x.dtype)
    source, target = [], []
    for n, size, (low, _, inside) in zip(x.shape, out.shape, equation.params["padding_config"], strict=True):
        places = low + np.arange(n) * (inside + 1)
        inner = np.flatnonzero((places >= 0) & (places < size))
        source.append(inner)
        target.append(places[inner])
    out[np.ix_(*target)] = x[np.ix_(*source)]
    return [out]


def _iota(equation: Any) -> list[np.ndarray]:
    shape, along = equation.outvars[0].aval.shape, equation.params["dimension"]
    inner = [1] * len(shape)
    inner[along] = -1
    return [np.broadcast_to(np.arange(shape[along], dtype=equation.outvars[0].aval.dtype).reshape(inner), shape)]
