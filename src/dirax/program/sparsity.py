"""Which results of a function depend on which of its unknowns: index sets through the jaxpr, an array of them at a time.

The set of every entry of an array is a row of one sparse matrix of booleans. What moves entries about takes rows, what computes
entry by entry unites them, a sum is a product of matrices. Entries that are zero whatever the unknowns are followed too, so that
a matrix of zeros with some entries is as sparse as it looks. Nothing is found by trying values: a set can be too large and
never too small.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

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
    (
        *("reshape", "squeeze", "expand_dims", "broadcast_in_dim", "transpose", "rev", "concatenate", "stack", "unstack"),
        *("tile", "split", "slice"),
    )
)
"""Primitives whose rules run on arrays of numbers of any kind."""

BY_ENTRY = frozenset(
    (
        *("add", "add_any", "sub", "mul", "div", "rem", "neg", "sign", "max", "min", "abs", "pow", "integer_pow", "square"),
        *("sqrt", "rsqrt", "cbrt", "exp", "exp2", "expm1", "log", "log1p", "logistic", "sin", "cos", "tan", "asin", "acos"),
        *("atan", "atan2", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "erf", "erfc", "erf_inv", "lgamma", "digamma"),
        *("floor", "ceil", "round", "nextafter", "clamp", "convert_element_type", "copy", "copy_p", "reduce_precision"),
        *("real", "imag", "bessel_i0e", "bessel_i1e", "igamma", "igammac", "polygamma"),
    )
)
"""Primitives that compute entry by entry."""

CALLS = {
    "jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr", "core_call": "call_jaxpr", "remat2": "jaxpr",
    "checkpoint": "jaxpr", "custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr", "custom_vjp_call_jaxpr": "fun_jaxpr",
}  # fmt: skip
BY_MATRIX = frozenset(("lu", "triangular_solve", "cholesky", "eigh", "svd", "qr", "householder_product"))


class Dense(Exception):
    """Raised where index sets become too large to be of use; says what made them so."""


def pattern_of(function: Callable, unknowns: Any, *others: Any) -> Any:
    """Where the Jacobian of `function(unknowns, *others)`, an array of floats, can have entries: booleans (results, unknowns).

    `unknowns` is a vector; all arguments are values or `jax.ShapeDtypeStruct`s. Other floats than unknowns are not looked at,
    whole numbers among them are, where their values are known. Raises `Dense`.
    """
    shaped = lambda x: x if isinstance(x, jax.ShapeDtypeStruct) else jax.ShapeDtypeStruct(np.shape(x), jax.numpy.result_type(x))
    closed = jax.make_jaxpr(function)(*jax.tree.map(shaped, (unknowns, *others)))
    size = math.prod(unknowns.shape)
    whole = lambda leaf: None if jax.numpy.issubdtype(jax.numpy.result_type(leaf), np.inexact) else _concrete(leaf)
    given = [Value(known=whole(leaf)) for leaf in jax.tree.leaves(others)]
    (found,) = _Sets(size).run(closed, [Value(_unit_sets(size)), *given])
    return sp.csr_matrix((closed.out_avals[0].size, size), dtype=bool) if found.sets is None else found.sets


def _unit_sets(size: int) -> Any:
    """Every unknown depends on itself."""
    return sp.csr_matrix((np.ones(size, bool), np.arange(size), np.arange(size + 1)), (size, size))


def _concrete(value: Any) -> np.ndarray | None:
    return None if isinstance(value, Tracer | jax.ShapeDtypeStruct) else np.asarray(value)


class Value(NamedTuple):
    """What is known of an array: the index sets of its entries (entries, unknowns), None for empty ones; its numbers, where they
    are known; which entries are zero whatever the unknowns, None for no entries."""

    sets: Any = None
    known: Any = None
    zero: Any = None

    def zeros(self, shape: tuple[int, ...]) -> np.ndarray:
        """Which entries are known to be zero."""
        if self.known is not None:
            return np.broadcast_to(self.known == 0, shape)
        return np.zeros(shape, bool) if self.zero is None else self.zero


class _Sets:
    """Runs jaxprs on `Value`s."""

    def __init__(self, size: int):
        self.size = size

    def run(self, closed: ClosedJaxpr, operands: Sequence[Value]) -> list[Value]:
        jaxpr, used = partial_eval.dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars))[:2]
        operands = [operand for operand, needed in zip(operands, used, strict=True) if needed]
        constants = [Value(known=_concrete(c)) for c in closed.consts]
        values: dict[Any, Value] = dict(zip(closed.jaxpr.constvars, constants, strict=True))
        values.update(zip(jaxpr.invars, operands, strict=True))
        read = lambda atom: Value(known=np.asarray(atom.val)) if isinstance(atom, Literal) else values[atom]
        for equation in jaxpr.eqns:
            results = self.equation(equation, [read(atom) for atom in equation.invars])
            for variable, result in zip(equation.outvars, results, strict=True):
                values[variable] = self.trimmed(equation, variable, result)
        return [read(atom) for atom in jaxpr.outvars]

    def trimmed(self, equation: Any, variable: Any, value: Value) -> Value:
        """Without the sets of what has no derivative. Raises `Dense` where there is too much of them."""
        sets, zero = value.sets, value.zero
        if sets is not None and not np.issubdtype(variable.aval.dtype, np.inexact):
            sets = None
        if zero is not None and not np.any(zero):
            zero = None
        if sets is not None and zero is not None:
            sets = self.rows(sets, np.where(zero.ravel(), 0, np.arange(1, zero.size + 1)))
        if sets is not None and sets.nnz > MOST_PER_UNKNOWN * (self.size + sets.shape[0]):
            raise Dense(f"the results of '{equation.primitive.name}' depend on too many unknowns each")
        return Value(sets, value.known, zero)

    def equation(self, equation: Any, operands: list[Value]) -> list[Value]:
        name, p, count = equation.primitive.name, equation.params, len(equation.outvars)
        if name in CALLS:
            inner = p[CALLS[name]]
            return self.run(inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ()), operands)
        if name.startswith("dirax_"):
            impl = lambda *given: equation.primitive.impl(*given, **p)
            return self.run(jax.make_jaxpr(impl)(*(v.aval for v in equation.invars)), operands)
        if name in MOVES or name == "pad":
            return self.moved(equation, operands)
        if name in IN_NUMPY and all(o.known is not None for o in operands):
            return [Value(known=IN_NUMPY[name](*(o.known for o in operands)).astype(equation.outvars[0].aval.dtype))]
        if name == "iota":
            return [Value(known=_iota(equation))]
        if self.is_whole(equation) and all(o.known is not None for o in operands):
            return [Value(known=a) for a in _evaluated(equation, [o.known for o in operands])]
        if name == "select_n":
            return [self.selected(equation, *operands)]
        if name in BY_ENTRY:
            return [self.united(equation, operands)] * count
        if name in FOLDS and "axes" in p:
            return [self.folded_value(equation, operands[0])]
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
        if not any(o.sets is not None for o in operands):
            return [Value()] * count
        if name in BY_MATRIX:
            return self.by_matrix(equation, operands)
        return self.all_of_all(equation, operands)

    def is_whole(self, equation: Any) -> bool:
        """Whether results are whole numbers, which can be indices, of a primitive that is quickly evaluated."""
        whole = all(np.issubdtype(v.aval.dtype, np.integer) or v.aval.dtype == np.bool_ for v in equation.outvars)
        name = equation.primitive.name
        return whole and not equation.effects and (name in BY_ENTRY or name in INDEXING)

    # ---------------------------------------------------------------------------------------------- what moves entries

    def moved(self, equation: Any, operands: list[Value]) -> list[Value]:
        """Numbers of entries are moved, counted from 1; 0 is that of an entry which depends on nothing."""
        rule: Any = _pad if equation.primitive.name == "pad" else RULES[equation.primitive.name]
        if all(o.known is not None for o in operands):
            return [Value(known=np.asarray(a)) for a in rule(None, equation, *(o.known for o in operands))]
        shapes = [v.aval.shape for v in equation.invars]
        results, count = [Value()] * len(equation.outvars), len(equation.outvars)
        zeros: list[Any] = [None] * count
        if any(o.known is not None or o.zero is not None for o in operands):
            zeros = rule(None, equation, *(o.zeros(shape) for o, shape in zip(operands, shapes, strict=True)))
        if any(o.sets is not None for o in operands):
            numbers, parts, first = [], [], 1
            for shape, operand in zip(shapes, operands, strict=True):
                if operand.sets is None:
                    numbers.append(np.zeros(shape, np.int64))
                    continue
                numbers.append(np.arange(first, first + operand.sets.shape[0]).reshape(shape))
                parts.append(operand.sets)
                first += operand.sets.shape[0]
            sets = parts[0] if len(parts) == 1 else sp.vstack(parts, "csr")
            results = [Value(self.rows(sets, moved)) for moved in rule(None, equation, *numbers)]
        return [Value(r.sets, None, zero) for r, zero in zip(results, zeros, strict=True)]

    def rows(self, sets: Any, numbers: np.ndarray) -> Any:
        """The sets of entries with these numbers, counted from 1; 0 for the empty set."""
        flat = numbers.ravel()
        if len(flat) == sets.shape[0] and np.array_equal(flat, np.arange(1, len(flat) + 1)):
            return sets
        pointers = np.append(sets.indptr, sets.indptr[-1])
        extended = sp.csr_matrix((sets.data, sets.indices, pointers), (sets.shape[0] + 1, self.size))
        return extended[np.where(flat > 0, flat - 1, sets.shape[0])]

    def gathered(self, equation: Any, value: Value, *indices: Value) -> Value:
        if value.sets is None and value.known is None and value.zero is None:
            return Value()
        if any(i.known is None for i in indices):
            if value.sets is None:
                return Value()
            raise Dense(f"'{equation.primitive.name}' has indices that depend on values")
        shape = equation.invars[0].aval.shape
        numbers = np.arange(1, math.prod(shape) + 1).reshape(shape)
        options = {"fill_value": 0} if equation.primitive.name == "gather" else {}
        places = _evaluated(equation, [numbers, *(i.known for i in indices)], **options)[0]
        zero = np.append(False, value.zeros(shape))[places] if value.known is not None or value.zero is not None else None
        return Value(None if value.sets is None else self.rows(value.sets, places), None, zero)

    def scattered(self, equation: Any, value: Value, indices: Value, updates: Value) -> Value:
        if indices.known is None:
            if value.sets is None and updates.sets is None:
                return Value()
            raise Dense(f"'{equation.primitive.name}' has indices that depend on values")
        shape, given = equation.invars[0].aval.shape, equation.invars[2].aval.shape
        total, name = math.prod(shape), equation.primitive.name
        put = lambda updates: _scatter_add(equation, np.zeros(shape), indices.known, updates)
        with jax.ensure_compile_time_eval():
            numbers = jax.numpy.arange(1.0, total + 1).reshape(shape)
            found = jax.linear_transpose(put, jax.ShapeDtypeStruct(given, np.float64))(numbers)[0]
            places = np.asarray(found).ravel().astype(int)
        inside = np.flatnonzero(places > 0)
        targets = places[inside] - 1
        kept, zero = value.sets, value.zeros(shape).ravel().copy()
        fresh = updates.zeros(given).ravel()[inside]
        if name == "scatter":  # what is written over is gone
            over = np.zeros(total, bool)
            over[targets] = True
            kept = None if kept is None else self.rows(kept, np.where(over, 0, np.arange(1, total + 1)))
            zero |= over
        elif name not in ("scatter-add", "scatter-sub"):
            zero[:] = False
        zero[targets[~fresh]] = False
        if updates.sets is not None:
            there = sp.csr_matrix((np.ones(len(inside), bool), (targets, inside)), (total, len(places)))
            kept = _union(kept, there @ updates.sets)
        return Value(kept, None, zero.reshape(shape))

    def updated(self, equation: Any, value: Value, updates: Value, *starts: Value) -> Value:
        if any(s.known is None for s in starts):
            if value.sets is None and updates.sets is None:
                return Value()
            raise Dense("'dynamic_update_slice' has indices that depend on values")
        shapes = [v.aval.shape for v in equation.invars[:2]]
        size, count = map(math.prod, shapes)
        numbers = np.arange(1, size + 1).reshape(shapes[0]), np.arange(size + 1, size + count + 1).reshape(shapes[1])
        places = _evaluated(equation, [*numbers, *(s.known for s in starts)])[0]
        zero = np.concatenate([v.zeros(shape).ravel() for v, shape in zip((value, updates), shapes, strict=True)])[places - 1]
        if value.sets is None and updates.sets is None:
            return Value(zero=zero)
        empty = lambda rows: sp.csr_matrix((rows, self.size), dtype=bool)
        both = [empty(n) if v.sets is None else v.sets for v, n in ((value, size), (updates, count))]
        return Value(self.rows(sp.vstack(both, "csr"), places), None, zero)

    # ------------------------------------------------------------------------------------------- what computes entries

    def united(self, equation: Any, operands: list[Value]) -> Value:
        shape, name = equation.outvars[0].aval.shape, equation.primitive.name
        found: Any = None
        zero: Any = None
        for operand, variable in zip(operands, equation.invars, strict=True):
            if operand.sets is not None:
                found = _union(found, self.spread(operand.sets, variable.aval.shape, shape))
        if any(o.known is not None or o.zero is not None for o in operands):
            zeros = [np.broadcast_to(o.zeros(v.aval.shape), shape) for o, v in zip(operands, equation.invars, strict=True)]
            if name == "mul":
                zero = zeros[0] | zeros[1]
            elif name in ("add", "add_any", "sub"):
                zero = zeros[0] & zeros[1]
            elif name == "div" or (name in ODD and len(zeros) == 1):
                zero = zeros[0]
        return Value(found, None, zero)

    def spread(self, sets: Any, shape: tuple[int, ...], whole: tuple[int, ...]) -> Any:
        """The sets of an operand that is repeated along axes of length 1, or is a number."""
        if shape == whole:
            return sets
        return self.rows(sets, np.broadcast_to(np.arange(1, math.prod(shape) + 1).reshape(shape), whole))

    def selected(self, equation: Any, which: Value, *cases: Value) -> Value:
        shape = equation.outvars[0].aval.shape
        size, found = math.prod(shape), None
        shapes = [v.aval.shape for v in equation.invars[1:]]
        zeros = [np.broadcast_to(case.zeros(own), shape) for case, own in zip(cases, shapes, strict=True)]
        spread = [
            None if case.sets is None else self.spread(case.sets, own, shape) for case, own in zip(cases, shapes, strict=True)
        ]
        if which.known is None:
            for sets in spread:
                found = found if sets is None else _union(found, sets)
            return Value(found, None, np.all(zeros, axis=0))
        chosen = np.broadcast_to(which.known, shape).astype(int)
        for k, sets in enumerate(spread):
            if sets is not None:
                found = _union(found, self.rows(sets, np.where(chosen.ravel() == k, np.arange(1, size + 1), 0)))
        return Value(found, None, np.choose(chosen, zeros))

    def folded_value(self, equation: Any, value: Value) -> Value:
        shape, axes = equation.invars[0].aval.shape, equation.params["axes"]
        sets = None if value.sets is None else self.folded(value.sets, shape, axes)
        zero = None if value.zero is None and value.known is None else np.all(value.zeros(shape), axis=tuple(axes))
        return Value(sets, None, zero)

    def folded(self, sets: Any, shape: tuple[int, ...], axes: Sequence[int]) -> Any:
        kept = [n for axis, n in enumerate(shape) if axis not in axes]
        inner = tuple(1 if axis in axes else n for axis, n in enumerate(shape))
        groups = np.broadcast_to(np.arange(math.prod(kept)).reshape(inner), shape).ravel()
        total = sp.csr_matrix((np.ones(len(groups), bool), (groups, np.arange(len(groups)))), (math.prod(kept), len(groups)))
        return total @ sets

    def product(self, equation: Any, *operands: Value) -> Value:
        """Sums of the products that are not zero: of each batch, rows of the one with columns of the other."""
        contracted, batched = equation.params["dimension_numbers"]
        shapes = [v.aval.shape for v in equation.invars]
        orders, sizes = [], []
        for shape, own, lead in zip(shapes, contracted, batched, strict=True):
            free = [i for i in range(len(shape)) if i not in (*own, *lead)]
            orders.append(np.arange(math.prod(shape)).reshape(shape).transpose((*lead, *free, *own)).ravel())
            sizes.append([math.prod(shape[i] for i in axes) for axes in (lead, free, own)])
        (batch, rows, length), (_, columns, _) = sizes
        whole, has_zeros = (batch, rows, columns), [o.known is not None or o.zero is not None for o in operands]
        there = [
            ~o.zeros(shape).ravel()[order].reshape(size) if z else None
            for o, shape, order, size, z in zip(operands, shapes, orders, sizes, has_zeros, strict=True)
        ]
        found: Any = None
        zero: Any = None
        if all(has_zeros) or (any(has_zeros) and not all(np.all(t) for t in there if t is not None)):
            zero = self.zero_products(there, sizes).reshape(equation.outvars[0].aval.shape)
        for k, operand in enumerate(operands):
            if operand.sets is None:
                continue
            sets, own, across = operand.sets[orders[k]], sizes[k][1], there[1 - k]
            if across is None or np.all(across):
                sums = self.folded(sets, (batch * own, length), (1,))
                numbers = np.arange(1, batch * own + 1).reshape(batch, own, 1)
                numbers = numbers if k == 0 else numbers.transpose(0, 2, 1)
                part = self.rows(sums, np.broadcast_to(numbers, whole))
            else:
                group, other, at = (a[:, None] for a in np.nonzero(across))
                mine = np.arange(own)
                if (count := group.size * own) > MOST_PER_UNKNOWN * (self.size + math.prod(whole)):
                    raise Dense(f"a product of arrays takes {count} multiplications")
                out = (group * rows + (mine if k == 0 else other)) * columns + (other if k == 0 else mine)
                source = (group * own + mine) * length + at
                taken = sp.csr_matrix(
                    (np.ones(out.size, bool), (out.ravel(), source.ravel())), (math.prod(whole), len(orders[k]))
                )
                part = taken @ sets
            found = _union(found, part)
        return Value(found, None, zero)

    def zero_products(self, there: list[Any], sizes: list[list[int]]) -> np.ndarray:
        """Which sums of products have no term."""
        full = [np.ones(size, bool) if t is None else t for t, size in zip(there, sizes, strict=True)]
        return np.stack([(sp.csr_matrix(a) @ sp.csr_matrix(b).T).toarray() == 0 for a, b in zip(*full, strict=True)])

    def by_matrix(self, equation: Any, operands: list[Value]) -> list[Value]:
        """Each matrix of a batch by itself."""
        batch = math.prod(equation.invars[0].aval.shape[:-2])
        found: Any = None
        for variable, operand in zip(equation.invars, operands, strict=True):
            if operand.sets is not None:
                found = _union(found, self.folded(operand.sets, (batch, variable.aval.size // max(batch, 1)), (1,)))
        each = [variable.aval.size // max(batch, 1) for variable in equation.outvars]
        if found.nnz * sum(each) > MOST_PER_UNKNOWN * (self.size + batch * sum(each)):
            raise Dense(f"'{equation.primitive.name}' is of a large matrix")
        return [Value(self.rows(found, np.repeat(np.arange(1, batch + 1), count))) for count in each]

    def branches(self, equation: Any, operands: list[Value]) -> list[Value]:
        found: list[Any] = [None] * len(equation.outvars)
        for branch in equation.params["branches"]:
            results = self.run(branch, operands[1:])
            found = [a if b.sets is None else _union(a, b.sets) for a, b in zip(found, results, strict=True)]
        return [Value(sets) for sets in found]

    def all_of_all(self, equation: Any, operands: list[Value]) -> list[Value]:
        """What is not known: every result depends on everything."""
        found: Any = None
        for operand in operands:
            if operand.sets is not None:
                found = _union(found, self.folded(operand.sets, (operand.sets.shape[0],), (0,)))
        sizes = [variable.aval.size for variable in equation.outvars]
        if found.nnz * sum(sizes) > MOST_PER_UNKNOWN * (self.size + sum(sizes)):
            raise Dense(f"'{equation.primitive.name}' is not followed")
        return [Value(self.rows(found, np.ones(size, int))) for size in sizes]


IN_NUMPY: dict[str, Callable] = {
    "add": np.add, "add_any": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "neg": np.negative,
    "max": np.maximum, "min": np.minimum, "abs": np.abs, "convert_element_type": np.asarray, "copy": np.asarray,
    "eq": np.equal, "ne": np.not_equal, "lt": np.less, "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal,
    "and": np.bitwise_and, "or": np.bitwise_or, "not": np.invert, "square": np.square, "sqrt": np.sqrt,
}  # fmt: skip
"""What is evaluated where all numbers are known: masks, indices, constants of a linear part."""

ODD = frozenset(("neg", "convert_element_type", "copy", "copy_p", "reduce_precision", "real", "abs", "square", "sin", "tan"))
"""Functions of one number that are zero at zero."""

INDEXING = frozenset(
    ("gather", "dynamic_slice", "cumsum", "reduce_sum", "scatter", "scatter-add", "sort", "xor", "is_finite", "select_n", "rem")
)


def _union(a: Any, b: Any) -> Any:
    if a is None or a is b:
        return b
    return a if b.nnz == 0 else b if a.nnz == 0 else sp.csr_matrix(a + b)


def _evaluated(equation: Any, operands: list[Any], **options: Any) -> list[np.ndarray]:
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


def _iota(equation: Any) -> np.ndarray:
    shape, along = equation.outvars[0].aval.shape, equation.params["dimension"]
    inner = [1] * len(shape)
    inner[along] = -1
    return np.broadcast_to(np.arange(shape[along], dtype=equation.outvars[0].aval.dtype).reshape(inner), shape)
