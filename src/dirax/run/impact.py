"""Impact: a wall that the motion bounces off, and what happens to the momentum there."""

from collections.abc import Callable, Sequence
from copy import copy
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from dirax.program.evaluation.functions import program_of
from dirax.program.linear_solves import solve
from dirax.program.tracing import once
from dirax.program.user_functions import is_traced
from dirax.run.event import OfMotion
from dirax.run.scalars import is_number
from dirax.schemes.collision_step import bounced, least_squares
from dirax.schemes.step import StepEquation
from dirax.text.representation import value_text

KNOWN = ("t", "q", "params")
"""What gap and restitution may be given, by the names of their arguments."""


class Restitution(OfMotion):
    """That of a wall, as a function of what is known of an impact."""

    name = "the restitution of a dx.Impact"


class Impact(OfMotion):
    """A wall: the motion bounces where `gap` becomes zero, `dx.simulate(…, events=[dx.Impact(gap, restitution=1.0)])`.

    `gap` returns one number of `q`, the time `t` and `params`, by the names of its arguments: positive off the wall.
    `restitution` is e in [0, 1] of v⁺·n = −e v⁻·n, relative to a wall that moves: a number, or a function like the gap, so that
    it may be one of the `params` that are fitted: `restitution=lambda params: params["e"]`.

    The step in which a wall is hit is divided (Fetecau, Marsden, Ortiz, West 2003): a step of the scheme of length αh that ends
    on the wall, α found with it; a jump of the momentum along ∂gap/∂q, and along the forces of constraints, so that these hold
    after it too (Rodríguez Abella, Colombo 2025); and a step of (1 − α)h, so that the rows stand at their times. With e = 1 the
    jump keeps the energy at walls at rest and with constraints that are linear in v; and always the momentum along every symmetry
    of the wall.

        ball = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[1])
        sol = dx.simulate(ball, dx.LagrangeDAlembert(), events=[dx.Impact(lambda q: q[1])], q=…, v=…, step=0.01, steps=1000)

    Under `jax.grad`, `jit` and `vmap` impacts are those of other runs, and are differentiated, their times too (what follows has
    the derivative of the saltation matrix): four a step of the run at most. `sol.events` then has as many entries, in the order
    of time in each trajectory, NaN where there are none. What has no scalar program, or runs by `engine="xla"`, has up to four in
    every step, and they are seen by the sign of the gap at quarters of it.

    The p that `dx.LagrangeDAlembert` saves with nonholonomic constraints, the mean over the two steps at a row, is off by O(h²)
    at the ends of a step that is divided, though the motion is not: `dx.DiscreteDirac(constraints="resolve")` has no such rows.

    `sol.events` has the times, and q and p after each impact; the row at the beginning of a step has the multipliers of
    its part before the impact. Where impacts accumulate (Zeno) the trajectory ends with a message.
    Raises `TypeError` for something that is no function of such arguments, `ValueError` for a restitution outside of [0, 1].
    """

    terminal = False
    name = "the gap of a dx.Impact"

    def __init__(self, gap: Callable, restitution: float | Callable = 1.0):
        self.restitution = _restitution(restitution)
        super().__init__(gap, "gap", KNOWN, self.restitution)

    @property
    def works(self) -> bool:
        """Whether it changes the energy: it moves, or may not give all of it back."""
        return self.restitution != 1.0 or "t" in self.arguments

    @property
    def functions(self) -> dict[str, Callable]:
        """Its functions of (t, q, params), with what they are."""
        return {"gap": self} | ({"restitution": self.restitution_at} if isinstance(self.restitution, Restitution) else {})

    def hoisted(self, values: list[Tracer]) -> Any:
        """The same of params that hold what its functions close over and JAX traces, which is added to `values`."""
        other, law = super().hoisted(values), self.restitution
        if not isinstance(law, Restitution) or (taken := law.hoisted(values)) is law:
            return other
        other = copy(other)
        other.restitution, other.key = taken, (*other.key[:-1], taken)
        return other

    def __call__(self, t: Any, q: Any, params: Any) -> Any:
        """The gap at one place."""
        return self.of({"t": t, "q": q, "params": params})

    def restitution_at(self, t: Any, q: Any, params: Any) -> Any:
        """The restitution at one place; NaN for one that is not in [0, 1]."""
        if not isinstance(self.restitution, Restitution):
            return self.restitution
        e = self.restitution.of({"t": t, "q": q, "params": params})
        return jnp.where((e >= 0.0) & (e <= 1.0), e, jnp.nan)

    def __repr__(self) -> str:
        law = self.restitution
        return f"Impact({self.signature}, restitution={law.signature if isinstance(law, Restitution) else f'{law:g}'})"


def _restitution(given: Any) -> float | Restitution:
    """A number that JAX traces is a function, which hands it over with the params."""
    if callable(given):
        return Restitution(given, "restitution", KNOWN)
    if is_number(given) and np.ndim(given) == 0 and not np.iscomplexobj(given):
        if is_traced(given):
            return Restitution(lambda t: given, "restitution", KNOWN)
        if 0.0 <= given <= 1.0:
            return float(given)
    expected = "a number from 0 to 1, or a function of some of t, q, params by their names"
    raise ValueError(f"restitution must be {expected}, but {value_text(given)} was given.")


def gaps_of(walls: Sequence[Impact]) -> Callable:
    """(t, q, params) ↦ the gaps of all walls (walls,)."""
    return once(_gaps, tuple(walls))


def _gaps(walls: Sequence[Impact], t: Any, q: Any, params: Any) -> Any:
    return jnp.stack([jnp.asarray(wall(t, q, params), float) for wall in walls])


def restitutions_of(walls: Sequence[Impact]) -> Callable:
    """(t, q, params) ↦ the restitutions of all walls (walls,)."""
    return once(_restitutions, tuple(walls))


def _restitutions(walls: Sequence[Impact], t: Any, q: Any, params: Any) -> Any:
    return jnp.stack([jnp.asarray(wall.restitution_at(t, q, params), float) for wall in walls])


def jump(
    system: Any, stage: StepEquation, gap: Callable, restitution: Callable, state: Any, t: Any, h: Any, params: Any
) -> tuple[Any, Any, Any, Any]:
    """`bounced` off the wall of `gap(t, q, params)` with `restitution(t, q, params)`, of constraints that may depend on each
    other."""
    now, constraints = stage.state_layout.split(state), system.constraints
    v = system.complete({"q": now.q, "p": now.p, "t": t}, params, False)["v"]
    if constraints.any:
        rows = constraints.matrix(t, now.q, params)
        forces = solve(system.velocity_hessian(t, now.q, v, params), rows.T)
        v = v - forces @ least_squares(rows @ forces, constraints.velocity_defect(t, now.q, v, params))
    return bounced(system, stage, lambda t, q: gap(t, q, params), restitution(t, now.q, params), state, v, t, h, params)


class Numbers:
    """A function of arrays and params, by its scalar program: of one place in floats, of many in NumPy; else compiled."""

    def __init__(self, function: Callable, values: list[np.ndarray], params: Any, *key: Any):
        leaves, structure = jax.tree.flatten(params)
        count = len(values)

        def flat(*numbers):
            return function(*numbers[:count], jax.tree.unflatten(structure, numbers[count:]))

        shapes = [jax.ShapeDtypeStruct(np.shape(a), jnp.float64) for a in [*values, *leaves]]
        found = program_of(flat, shapes, (*key, structure))
        self.program = found[0] if found else None
        self.of_many = jax.jit(jax.vmap(flat, in_axes=(0,) * count + (None,) * len(leaves)))
        self._set(params)

    def _set(self, params: Any) -> None:
        self.leaves = [np.asarray(leaf, float) for leaf in jax.tree.leaves(params)]
        self.fixed = [x for leaf in self.leaves for x in leaf.ravel().tolist()]

    def of(self, params: Any) -> "Numbers":
        """The same with other params."""
        other = copy(self)
        other._set(params)
        return other

    def one(self, *values: Any) -> np.ndarray:
        """The numbers of the results at one place."""
        if self.program is None:
            return np.concatenate([np.ravel(a) for a in self.many(*(np.asarray(value)[None] for value in values))])
        floats, flat = self.program.in_floats, [x for value in values for x in np.ravel(value).tolist()]
        try:
            return np.array(floats((*flat, *self.fixed)))
        except (ArithmeticError, ValueError):
            return np.full(sum(nodes.size for nodes in self.program.results), np.nan)

    def many(self, *values: Any) -> list[np.ndarray]:
        """The results at many places, arrays with an axis of them in front."""
        arrays = [np.asarray(a, float) for a in values]
        if self.program is None:
            return [np.asarray(a) for a in jax.tree.leaves(self.of_many(*arrays, *self.leaves))]
        count = len(arrays[0])
        return self.program.in_numpy([*arrays, *(np.broadcast_to(leaf, (count, *leaf.shape)) for leaf in self.leaves)])
