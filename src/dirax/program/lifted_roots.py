"""A jaxpr with the roots in it as operands, and with what they are roots of among its results."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, Var, jaxpr_as_fun, jaxprs_in_params
from jax.interpreters.partial_eval import dce_jaxpr

from dirax.numerics.ranks import rank_of_equations
from dirax.program.given_tangents import Axes, at_place, lead_of, over
from dirax.program.graph import GraphTooLarge
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.program.linear_solves import solve
from dirax.program.memo import Memo, Same, by_value
from dirax.program.roots import least_change_p, root_p
from dirax.program.same_jaxpr import value_key
from dirax.program.scalar_program import ScalarProgram
from dirax.program.tracing import CALLS, alone, jacobian, of_one_result

SIDE_BY_SIDE = 64
"""Roots of one kind whose equations are written one after the other, with derivatives that stay one equation each."""

NEAR = 0.1, 0.5
"""Numbers at which functions are tried: small, as for relativistic velocities, and for the exponentials of diodes."""

PLACES = 3
"""How many of them."""

_asked: Memo[frozenset] = Memo(512)


class Unliftable(Exception):
    """A root inside of a loop, a branch, or a function with a derivative of its own."""


class Part(NamedTuple):
    """Some results of a jaxpr, with the numbers of the operands that they need."""

    jaxpr: ClosedJaxpr
    used: tuple[int, ...]

    def __call__(self, operands: Sequence) -> list:
        return jaxpr_as_fun(self.jaxpr)(*(operands[k] for k in self.used))


class LiftedJaxpr:
    """A jaxpr and the roots in it, in the order in which it asks for them: `kinds`, their shapes.

    Roots of the same equations at the same values are one, and derivatives of roots are those of regular ones. Raises
    `Unliftable`.
    """

    def __init__(self, closed: ClosedJaxpr):
        self.of_operands = jax.make_jaxpr(lambda *operands: _Walk().through(closed, operands).roots)(*closed.in_avals)
        self.kinds: list[ShapedArray] = self.of_operands.out_avals
        self.results = len(closed.out_avals)

        def everything(*values: Any) -> tuple:
            walk = _Walk(values[: len(self.kinds)]).through(closed, values[len(self.kinds) :])
            return walk.results, jnp.concatenate([jnp.ravel(d) for d in walk.defects])

        self._all = jax.make_jaxpr(everything)(*self.kinds, *closed.in_avals)

    @property
    def size(self) -> int:
        """The numbers of all roots."""
        return sum(a.size for a in self.kinds)

    def roots(self, operands: Sequence) -> list:
        """The roots, found."""
        return jaxpr_as_fun(self.of_operands)(*operands)

    def split(self, numbers: Any) -> list:
        """The roots of which these are the numbers (size,), in order."""
        found, at = [], 0
        for kind in self.kinds:
            found.append(jnp.reshape(numbers[at : at + kind.size], kind.shape))
            at += kind.size
        return found

    @property
    def are_regular(self) -> bool:
        """Whether the equations of the roots determine them, at one of some places chosen at random that is in their domain; so
        they are said to be where none is, and where they have no scalar program."""
        defect = self.part(self.results)
        given = [ShapedArray((self.size,), np.dtype(float)), *self.of_operands.in_avals]
        of_roots = lambda numbers, *operands: defect([*self.split(numbers), *operands])[0]
        try:
            slope = ScalarProgram.of(jax.make_jaxpr(jacobian(of_roots))(*given), by_numpy=True)
        except (UnsupportedPrimitive, GraphTooLarge):
            return True
        random = np.random.default_rng(0).uniform
        with np.errstate(all="ignore"):
            (matrices,) = slope.in_numpy([random(*NEAR, (PLACES, *a.shape)) for a in given])
        finite = matrices[np.all(np.isfinite(matrices), axis=(1, 2))]
        return not len(finite) or int(np.max(rank_of_equations(finite)[0])) == self.size

    def part(self, *results: int) -> Part:
        """(roots, operands) ↦ results of these numbers; the last one is what vanishes at the roots, (size,)."""
        jaxpr, used = dce_jaxpr(self._all.jaxpr, [k in results for k in range(self.results + 1)])[:2]
        return Part(ClosedJaxpr(jaxpr, self._all.consts), tuple(np.flatnonzero(used).tolist()))


def has_roots(jaxpr: Any) -> bool:
    """Whether a jaxpr, or one inside of it, asks for a root."""
    return root_p in _asked_by(jaxpr)


def _asked_by(jaxpr: Any) -> frozenset:
    """Which of the primitives that are roots or derivatives of them a jaxpr has, or one inside of it."""
    every = lambda: frozenset().union(*(_asked_in(e) | ({e.primitive} & {root_p, least_change_p}) for e in jaxpr.eqns))
    return _asked.get(Same(jaxpr), every)


def _asked_in(equation: Any) -> frozenset:
    return frozenset().union(*(_asked_by(getattr(j, "jaxpr", j)) for j in jaxprs_in_params(equation.params)))


class _Walk:
    """A jaxpr gone through with its roots given, or found: calls with roots in them are opened, and equal equations are one."""

    def __init__(self, given: Sequence | None = None):
        self.given = given
        self.results: list = []
        self.roots: list = []
        self.defects: list = []
        self._known: dict[Any, list] = {}

    def through(self, closed: ClosedJaxpr, operands: Sequence) -> "_Walk":
        self.results = self._through(closed, operands)
        return self

    def _through(self, closed: ClosedJaxpr, operands: Sequence) -> list:
        known = dict(zip(closed.jaxpr.constvars, closed.consts, strict=True))
        known.update(zip(closed.jaxpr.invars, operands, strict=True))
        read = lambda atom: atom.val if isinstance(atom, Literal) else known[atom]
        for equation in closed.jaxpr.eqns:
            found = self._equation(closed.jaxpr, equation, [read(atom) for atom in equation.invars])
            known.update(zip(equation.outvars, found, strict=True))
        return [read(atom) for atom in closed.jaxpr.outvars]

    def _equation(self, jaxpr: Jaxpr, equation: Any, operands: list) -> list:
        if equation.primitive is not root_p and _asked_in(equation):
            if equation.primitive.name not in CALLS:
                raise Unliftable
            return self._through(equation.params["jaxpr"], operands)
        key = by_value((equation.primitive, value_key(equation.params), *map(_operand_key, operands)))
        if key not in self._known:
            if equation.primitive is root_p:
                self._known[key] = self._root(equation, operands)
            elif equation.primitive is least_change_p:
                self._known[key] = [_each(solve, equation.params["axes"], operands)]
            else:
                one, variables = alone(jaxpr, equation)
                values = {v: x for v, x in zip(equation.invars, operands, strict=True) if isinstance(v, Var)}
                self._known[key] = jaxpr_as_fun(one)(*(values[v] for v in variables))
        return self._known[key]

    def _root(self, equation: Any, operands: list) -> list:
        if self.given is None:
            (root,) = root_p.bind(*operands, **equation.params)
        else:
            root = self.given[len(self.roots)]
            self.defects.append(_defect(equation.params, operands[:-1], root))
        self.roots.append(root)
        return [root]


def _operand_key(value: Any) -> Any:
    small = not isinstance(value, Tracer) and np.ndim(value) == 0
    return (np.asarray(value).dtype.str, np.asarray(value).tobytes()) if small else Same(value)


def _defect(parameters: dict[str, Any], captured: list, root: Any) -> Any:
    """What vanishes at a root; at roots side by side, at each."""
    residual, axes = of_one_result(parameters["residual"]), tuple((*level[:-1], 0) for level in parameters["axes"])
    return _each(residual, axes, [*captured, root])


def _each(function: Callable, axes: Axes, operands: Sequence) -> Any:
    """A function under `jax.vmap`s, written out for each place of them where they are few."""
    lead = lead_of(operands, axes)
    if not axes or math.prod(lead) > SIDE_BY_SIDE:
        return over(function, axes)(*operands)
    found = jnp.stack([function(*at_place(operands, axes, index)) for index in np.ndindex(*lead)])
    return found.reshape(*lead, *found.shape[1:])
