"""What is computed by NumPy between parts of a graph: decompositions, roots, loops whose length depends on their values."""

import hashlib
import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr

from dirax.numerics.inverses import solved
from dirax.numerics.newton import damped_step, sizes_of_unknowns
from dirax.numerics.sparse import FEWEST_SPARSE
from dirax.numerics.tolerances import EQUATION_RANK, TINY
from dirax.program.evaluation.in_numpy import LANES, Slopes, Values, in_parts
from dirax.program.given_tangents import Axes
from dirax.program.graph import GraphTooLarge
from dirax.program.interpreter import RULES, Interpreter, Nodes, Unavailable, Unsupported, UnsupportedPrimitive, elementwise
from dirax.program.linear_solves import equilibrated_inverse, pseudo_inverses
from dirax.program.memo import Memo, Same
from dirax.program.rules.linear_algebra import linear_equations, split_as
from dirax.program.rules.reductions import factors_of_product, sum_of_products, terms_of_product, zeros_of
from dirax.program.scalar_program import IN_NUMPY, ScalarProgram, numpy_rule
from dirax.program.tracing import jacobian, of_one_result

LARGE_DERIVATIVE = 30_000
"""Nodes of a function times numbers by which it is differentiated from which on a graph of the derivative takes longer than its
values at a few entries."""

LARGE_FOR_FEW = 2000
"""The same of programs that are evaluated once, at a handful of entries."""

TOGETHER = 2**18
"""Numbers of the matrices that are inverted side by side, which a processor has at hand."""

LARGE_PRODUCT = 256
"""Multiplications of a product of arrays from which on it is no graph of them."""

MOST_KEPT = 2**16
"""Numbers of roots, or inverses, side by side, up to which they are kept: those of a part of the rows of a run."""

MOSTLY = 16
"""A product or a matrix is of mostly zeros where no more than one in so many numbers is another one."""


@numpy_rule("dot_general")
def dot_general(made: ScalarProgram, interpreter: Interpreter, equation: Any, a: Nodes, b: Nodes) -> list[Nodes]:
    """Large products stay products of arrays, but for those of mostly zeros; summed in one order, so that an entry's bits do not
    depend on the others."""
    shape, (rows, columns) = equation.outvars[0].aval.shape, factors_of_product(equation, a, b)
    every = math.prod(shape) * rows.shape[-1]
    there = lambda: np.sum(terms_of_product(rows, columns, zeros_of(made.graph, rows, columns)))
    if every < LARGE_PRODUCT or equation.outvars[0].aval.dtype != np.float64 or MOSTLY * there() <= every:
        return list(RULES["dot_general"](interpreter, equation, a, b))
    left, right = np.moveaxis(rows, -1, 0)[..., None], np.moveaxis(columns, -1, 0)[:, :, None]

    def product(arrays: list[np.ndarray]) -> list[np.ndarray]:
        return [sum_of_products(*arrays).reshape(len(arrays[0]), *shape)]

    return made.between([left, right], [shape], product)


@numpy_rule("dirax_derivative")
def derivative_in_numbers(made: ScalarProgram, interpreter: Interpreter, equation: Any, *operands: Nodes) -> list[Nodes]:
    """Derivatives of large functions by many numbers are found in numbers, with no graph of their own; constant ones at once."""
    jaxpr, wanted = equation.params["jaxpr"], equation.params["wanted"]
    inner = _inner.get(Same(jaxpr), lambda: _plain(jaxpr))
    large = LARGE_FOR_FEW if made.for_few else LARGE_DERIVATIVE
    if inner is None or len(inner.graph) * sum(operands[k].size for k in wanted) < large:
        return list(RULES["dirax_derivative"](interpreter, equation, *operands))
    found = _in_numbers.get((Same(jaxpr), wanted), lambda: _InNumbers(inner, wanted))
    whole = np.full(found.there.shape, made.graph.zero)
    if found.constant is not None:
        whole[found.there] = elementwise(made.graph.constant, found.constant)
    else:
        whole[found.there] = made.between([operands[k] for k in found.given], [(int(found.there.sum()),)], found.slopes)[0]
    parts = np.split(whole, np.cumsum([operands[k].size for k in wanted])[:-1], axis=1)
    return [part.reshape(v.aval.shape) for part, v in zip(parts, equation.outvars, strict=True)]


class _InNumbers:
    """The derivative of the result of a program by some of its inputs: which entries can differ from zero, which inputs they are
    made of, and what they are where they are made of none."""

    def __init__(self, inner: ScalarProgram, wanted: tuple[int, ...]):
        self.inner, (result,) = inner, inner.results
        outputs, inputs = result.ravel().tolist(), [node for k in wanted for node in inner.inputs[k].ravel().tolist()]
        self.there, self.plan = inner.graph.dependence(outputs, inputs), Slopes(inner.graph, outputs, inputs)
        needed = set(inner.graph.reachable(self.plan.factors))
        self.given = [k for k, nodes in enumerate(inner.inputs) if not needed.isdisjoint(nodes.ravel().tolist())]
        self.constant = None if self.given else self.slopes([])[0][0]

    def slopes(self, arrays: list[np.ndarray]) -> list[np.ndarray]:
        """Those entries, (states, entries), by what is given of the inputs."""
        known, given = Values(self.inner.graph, len(arrays[0]) if arrays else 1), dict(zip(self.given, arrays, strict=True))
        for k, nodes in enumerate(self.inner.inputs):
            known.bind(nodes, given[k] if k in given else np.zeros((known.entries, *nodes.shape)))
        return [known.slopes(self.plan.nodes, self.plan.inputs, self.plan)[:, self.there]]


_inner: Memo[ScalarProgram | None] = Memo(128)
_in_numbers: Memo[_InNumbers] = Memo(128)


def _plain(jaxpr: ClosedJaxpr) -> ScalarProgram | None:
    try:
        return ScalarProgram.of(jaxpr, limit=IN_NUMPY)
    except (UnsupportedPrimitive, GraphTooLarge):
        return None


@numpy_rule("svd")
def svd(made: ScalarProgram, interpreter: Interpreter, equation: Any, matrix: Nodes) -> list[Nodes]:
    p = equation.params

    def decompose(a: np.ndarray) -> list[np.ndarray]:
        left, values, right = np.linalg.svd(a, full_matrices=p["full_matrices"])
        return [values, left, right] if p["compute_uv"] else [values]

    return _decomposed(made, equation, matrix, decompose, "singular values")


@numpy_rule("eigh")
def eigh(made: ScalarProgram, interpreter: Interpreter, equation: Any, matrix: Nodes) -> list[Nodes]:
    def decompose(a: np.ndarray) -> list[np.ndarray]:
        values, vectors = np.linalg.eigh(a, UPLO="L" if equation.params["lower"] else "U")
        return [vectors, values]

    return _decomposed(made, equation, matrix, decompose, "eigenvalues")


def _decomposed(made: ScalarProgram, equation: Any, matrix: Nodes, decompose: Callable, what: str) -> list[Nodes]:
    if equation.params.get("subset_by_index") is not None:
        raise Unsupported(f"finds some {what} only")
    shapes = [v.aval.shape for v in equation.outvars]
    return made.between([matrix], shapes, lambda operands: _of_finite(decompose, *operands))


@numpy_rule("while")
def while_(made: ScalarProgram, interpreter: Interpreter, equation: Any, *operands: Nodes) -> Any:
    try:
        return list(RULES["while"](interpreter, equation, *operands))
    except Unsupported:
        pass
    if lost := next((o for o in operands if isinstance(o, Unavailable)), None):
        return [Unavailable(lost.error)] * len(equation.outvars)
    p = equation.params
    condition, body = (ScalarProgram.of(p[name], by_numpy=True).in_numpy for name in ("cond_jaxpr", "body_jaxpr"))
    a, b = p["cond_nconsts"], p["cond_nconsts"] + p["body_nconsts"]

    def loop(arrays: list[np.ndarray]) -> list[np.ndarray]:
        for_condition, for_body, carry = arrays[:a], arrays[a:b], arrays[b:]
        while True:
            going = condition([*for_condition, *carry])[0] != 0
            if not np.any(going):
                return carry
            after = body([*for_body, *carry])  # under vmap each of its entries has a condition of its own, in front
            here = lambda a, going=going: going.reshape(*going.shape, *(1,) * (a.ndim - going.ndim))
            carry = [np.where(here(x), x, y) for x, y in zip(after, carry, strict=True)]

    return made.between(list(operands), [v.aval.shape for v in equation.outvars], loop)


@numpy_rule("custom_linear_solve")
def linear_solve(made: ScalarProgram, interpreter: Interpreter, equation: Any, *operands: Nodes) -> Any:
    try:
        return list(RULES["custom_linear_solve"](interpreter, equation, *operands))
    except Unsupported:  # too many to be written out
        found = linear_equations(interpreter, equation, operands)
    if isinstance(found, Unavailable):
        return [found] * len(equation.outvars)
    matrix, right = found
    (x,) = made.between([matrix, right], [right.shape], lambda operands: [solved(*operands)], "solve")
    return split_as(equation, x)


@numpy_rule("dirax_solve")
def solved_by_numpy(made: ScalarProgram, interpreter: Interpreter, equation: Any, matrix: Nodes, right: Nodes) -> list[Nodes]:
    return made.between([matrix, right], [right.shape], lambda operands: [solved(*operands)], "solve")


@numpy_rule("dirax_least_change")
def least_change(made: ScalarProgram, interpreter: Interpreter, equation: Any, matrix: Nodes, right: Nodes) -> list[Nodes]:
    axes, k = equation.params["axes"], right.shape[-1]

    def solutions(arrays: list[np.ndarray]) -> list[np.ndarray]:
        (inverse, _), sides = _inverted(arrays[0].reshape(-1, k, k)), arrays[1].reshape(-1, k)
        return [(inverse @ sides[..., None])[..., 0].reshape(arrays[1].shape)]

    return made.between([_in_front(matrix, axes, 0, right.shape[: len(axes)]), right], [right.shape], solutions, "least change")


@numpy_rule("dirax_pseudo_inverse")
def pseudo_inverse(made: ScalarProgram, interpreter: Interpreter, equation: Any, matrix: Nodes) -> list[Nodes]:
    tolerance, shape = equation.params["tolerance"], equation.outvars[0].aval.shape

    def inverses(arrays: list[np.ndarray]) -> list[np.ndarray]:
        found = lambda: _of_finite(lambda a: [pseudo_inverses(a, tolerance=tolerance)], *arrays)[0]
        return [_kept(("pseudo-inverse", tolerance), arrays, found, len(arrays[0]) * math.prod(shape))]

    return made.between([matrix], [shape], inverses)


@numpy_rule("dirax_scaled_inverse")
def scaled_inverse(made: ScalarProgram, interpreter: Interpreter, equation: Any, matrix: Nodes) -> list[Nodes]:
    tolerance, shapes = equation.params["tolerance"], [v.aval.shape for v in equation.outvars]
    return made.between([matrix], shapes, lambda operands: _inverted(operands[0], tolerance), ("scaled inverse", tolerance))


def _inverted(matrices: np.ndarray, tolerance: float = EQUATION_RANK) -> list[np.ndarray]:
    """The scaled pseudo-inverses and the units of their rows; of a matrix that all entries have, once."""
    inverted = lambda a: list(equilibrated_inverse(np, a, tolerance))
    if len(matrices) > 1 and np.all(matrices == matrices[:1]):
        return [np.repeat(a, len(matrices), axis=0) for a in _of_finite(inverted, matrices[:1])]
    return in_parts(lambda some: _of_finite(inverted, *some), [matrices], _together(matrices[0].size))


def _together(numbers: int) -> int:
    """How many matrices of so many numbers are taken at a time."""
    return max(1, TOGETHER // max(1, numbers))


def _of_finite(function: Callable, matrices: np.ndarray) -> list[np.ndarray]:
    """The arrays that `function` gives for matrices with leading axes; NaN for a matrix that is not finite."""
    good = np.all(np.isfinite(matrices), axis=(-2, -1))
    spread = lambda a: good.reshape(*good.shape, *(1,) * (a.ndim - good.ndim))
    return [np.where(spread(a), a, np.nan) for a in function(np.where(spread(matrices), matrices, 0.0))]


At = Callable[[np.ndarray, list[np.ndarray], np.ndarray, np.ndarray], tuple[Callable, np.ndarray, np.ndarray]]
"""(numbers of the entries, what is captured, u, r(u)) ↦ (right-hand sides ↦ solutions with the Jacobian at u, units and sizes of
the unknowns)."""

_equations: Memo[tuple[Callable, Callable[[], At], int]] = Memo(128)


def _with_slope(residual: ClosedJaxpr) -> tuple[Callable, Callable[[], At], int]:
    """A residual for arguments with an axis of entries, how equations with its derivative by the last argument are solved, from
    the first step of Newton's method on, and of how many entries at a time."""
    slope = jax.make_jaxpr(jacobian(of_one_result(residual), len(residual.in_avals) - 1))(*residual.in_avals)
    value = ScalarProgram.of(residual, by_numpy=True).in_numpy
    if (sparse := _sparse(slope)) is not None:
        return value, lambda: _by_elimination(*sparse), LANES
    linear = ScalarProgram.of(slope, by_numpy=True)
    if not linear.depends_on(*linear.inputs):
        at = _least_changes(linear.in_numpy, CONSTANT)
        return value, lambda: at, LANES
    kind = MOVING if linear.depends_on(linear.inputs[-1]) else FIXED
    return value, lambda: _least_changes(linear.in_numpy, kind), _together(linear.results[0].size)


CONSTANT, FIXED, MOVING = "constant", "fixed", "moving"
"""Derivatives that are surely the same for all entries, the same whatever the unknowns of an entry are, and others."""


def _least_changes(linear: Callable, kind: str) -> At:
    """By pseudo-inverses of the derivatives, which are found once unless they move with the unknowns."""
    known_of_all: list[np.ndarray] = []

    def at(entries, captured, u, value):
        if kind == MOVING or not known_of_all:
            arrays = [*captured, u]
            slope = linear([a[:1] for a in arrays] if kind == CONSTANT else arrays)[0]
            known_of_all[:] = slope, *_inverted(slope)
        slope, inverse, units = (a[entries] for a in known_of_all) if kind == FIXED else known_of_all
        return lambda right: (inverse @ right[..., None])[..., 0], units, sizes_of_unknowns(slope, inverse, u, value)

    return at


def _by_elimination(values: Callable, factored: Callable) -> At:
    """By sparse elimination, as `dirax.program.roots` does for many unknowns."""

    def at(entries, captured, u, value):
        solutions = [factored(own) for own in values([*captured, u])[0]]
        inverse = lambda right: np.stack([solution(one) for solution, one in zip(solutions, right, strict=True)])
        sizes = np.max(np.abs(u), axis=-1, keepdims=True, initial=TINY)
        return inverse, np.ones(u.shape), np.broadcast_to(sizes, u.shape)

    return at


def _sparse(slope: ClosedJaxpr) -> tuple[Callable, Callable] | None:
    """The entries of a large derivative that can differ from zero, and how equations with them are solved; None for a small one,
    and where it is not sparse."""
    if slope.out_avals[0].shape[0] < FEWEST_SPARSE or any(e.primitive.name != "dirax_derivative" for e in slope.jaxpr.eqns):
        return None
    if (made := _plain(slope)) is None:
        return None
    (matrix,) = made.results
    rows, columns = np.nonzero(matrix != made.graph.zero)
    if MOSTLY * len(rows) > matrix.size:
        return None
    from dirax.numerics.sparse.elimination import StructurallySingular, solver_of  # imported when it is used

    made.results = [matrix[rows, columns]]
    try:
        return made.in_numpy, solver_of(len(matrix), rows, columns)
    except StructurallySingular:
        return None


@numpy_rule("dirax_root")
def root(made: ScalarProgram, interpreter: Interpreter, equation: Any, *operands: Nodes) -> list[Nodes]:
    """The method of `dirax.program.roots`, for all entries side by side."""
    closed: ClosedJaxpr = equation.params["residual"]
    residual, begun, most = _equations.get(Same(closed), lambda: _with_slope(closed))

    def find(arrays: list[np.ndarray]) -> list[np.ndarray]:
        *captured, found = arrays
        found, going, at, near = found.copy(), np.arange(len(found)), begun(), np.zeros(len(found), bool)
        for _ in range(equation.params["max_steps"]):
            if not len(going):
                break
            known = [a[going] for a in captured]
            value = residual([*known, found[going]])[0]
            inverse, units, sizes = at(going, known, found[going], value)
            update = lambda u, known=known, inverse=inverse: inverse(residual([*known, u])[0])
            found[going], more, near[going] = damped_step(inverse(value), update, found[going], units, sizes)
            going = going[more]
        if equation.params["strict"]:
            found[~near] = np.nan
        return [found]

    axes, (result,) = equation.params["axes"], [v.aval.shape for v in equation.outvars]
    given = [*closed.in_avals[:-1], closed.out_avals[0]]  # the guess has the shape of the residual
    lead = result[: len(axes)]

    def side_by_side(arrays: list[np.ndarray]) -> list[np.ndarray]:
        entries, count = len(arrays[0]), len(arrays[0]) * math.prod(lead)
        one = [a.reshape(count, *aval.shape) for a, aval in zip(arrays, given, strict=True)]
        found = lambda: in_parts(find, one, most)[0].reshape(entries, *result)
        what = Same(closed), equation.params["max_steps"], equation.params["strict"], lead
        return [_kept(what, one, found, entries * math.prod(result))]

    return made.between([_in_front(nodes, axes, k, lead) for k, nodes in enumerate(operands)], [result], side_by_side)


_last: Memo[np.ndarray] = Memo(64)


def _kept(what: tuple, arrays: list[np.ndarray], make: Callable[[], np.ndarray], numbers: int) -> np.ndarray:
    """What `make` finds of arrays, so many numbers; what was found last of the same ones is kept: the energy, hidden constraints
    and structures of a run ask for the same velocities."""
    if numbers > MOST_KEPT:
        return make()
    digests = [(a.shape, hashlib.blake2b(a.tobytes(), digest_size=16).digest()) for a in arrays]
    return _last.get((*what, *digests), make).copy()


def _in_front(nodes: Nodes, axes: Axes, number: int, lead: tuple[int, ...]) -> Nodes:
    """An operand that went through `jax.vmap`s, with all axes of them, which are `lead` long."""
    has = [level[number] is not None for level in reversed(axes)]
    own = nodes.shape[sum(has) :]
    mine = (n if h else 1 for n, h in zip(lead, has, strict=True))
    return np.broadcast_to(nodes.reshape((*mine, *own)), (*lead, *own))
