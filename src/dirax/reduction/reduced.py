"""Systems on the quotient by an abelian symmetry, and the way back."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.numerics.arrays import Data
from dirax.numerics.equilibration import diagonal_units
from dirax.numerics.tolerances import INERTIA_RANK, SYMMETRY_DEFECT
from dirax.program.memo import Memo
from dirax.program.user_functions import UserFunction, evaluated, is_traced
from dirax.reduction.actions import AbstractAction, Translations
from dirax.reduction.connection import AbstractConnection
from dirax.reduction.sample_units import SampleUnits
from dirax.reduction.symmetry import discrete_invariance, forces_at, invariance, sampled_near, units_of
from dirax.systems.constraints import Constraints
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.premise import Premise
from dirax.systems.system import AbstractSystem

NEARBY, SAMPLES = 0.3, 8
"""Invariance is looked at in the initial data and at so many random points within this distance of them."""


_symmetric: Memo[None] = Memo(256)


class AbstractReducedSystem(AbstractSystem):
    """A Lagrangian system on the quotient by a symmetry: what those on flat and on curved shape spaces have in common.

    Rows of a trajectory hold the shape x, the momenta w and μ of λ̂_d(q, p) = (x, w, μ), and the group's g, a quadrature.
    """

    system: eqx.AbstractVar[Any]
    connection: eqx.AbstractVar[Any]

    @property
    def stepped_by(self) -> str:
        """Those whose steps descend to the quotient."""
        return (
            "Reduced systems are stepped by dx.LagrangeDAlembert, dx.PlusLagrangeDirac, dx.MinusLagrangeDirac and "
            "dx.DiscreteRouth: with another scheme step the system that dx.reduce was given."
        )

    @property
    @abstractmethod
    def action(self) -> AbstractAction:
        """The action of the group on Q."""

    @property
    @abstractmethod
    def own_fields(self) -> tuple[str, ...]:
        """The names of the saved arrays from which `unreduced_row` makes those on T*Q."""

    @property
    @abstractmethod
    def conserves_momentum(self) -> bool:
        """Whether μ is a constant of the motion whatever the functions."""

    @abstractmethod
    def sampled(self, data: Data, params: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Times, points and velocities, (1 + SAMPLES, …) each: the initial data, and random ones near them at later times."""

    @abstractmethod
    def named(self, generator: int) -> str:
        """What moves along a generator, in words."""

    @abstractmethod
    def along(self, q: Array, covectors: Float[Array, "m n"]) -> Float[Array, "m k"]:
        """The parts of covectors at q along the group, as μ is that of the momentum."""

    @abstractmethod
    def at_identity(self, q: Array, covectors: Float[Array, "m n"]) -> Float[Array, "m d"]:
        """Covectors at q moved along its orbit to where what is invariant is computed, in components."""

    @abstractmethod
    def origin_of(self, q: Array) -> Array:
        """The point of the orbit of q at which what is invariant is computed."""

    @abstractmethod
    def unreduced_row(self, row: Data) -> dict[str, Array]:
        """The row (q, p, …) on T*Q over a reduced row."""

    @abstractmethod
    def momentum_map(self, row: Data) -> Float[Array, " k"]:
        """J at a row, which is conserved where nothing acts along the group: of an abelian one μ itself."""

    # ------------------------------------------------------------------ what follows from these

    def quotient_form(self) -> "AbstractReducedSystem":
        return self

    def unreduced(self) -> Any:
        """The system on Q that this one is the quotient of."""
        return self.system

    def project_position(self, q: Array, v: Array, params: Any = None, t: Any = 0.0) -> Array:
        return self.system.project_position(q, v, params, t)

    def project_velocity(self, q: Array, v: Array, params: Any = None, t: Any = 0.0) -> Array:
        return self.system.project_velocity(q, v, params, t)

    @property
    def constraints(self) -> Constraints:
        """All constraints of the unreduced system."""
        return self.system.constraints

    @property
    def free(self) -> bool:
        """Whether nothing acts but L."""
        return self.system.forces is None and not self.constraints.any

    def moves_momentum(self, data: Data, params: Any) -> str:
        """What has a part along the group and moves μ, with the part and where, at initial data and near them, which must be
        concrete; empty where nothing does."""
        if self.system.forces is None and self.system.one_forms is None:
            return ""
        t, q, v = self.sampled(data, params)
        parts, sizes = (np.asarray(a) for a in evaluated(self._parts_along, t, q, v, params))
        largest = np.max(np.where(np.isfinite(sizes), sizes, 0.0), axis=0)
        defects = np.abs(parts) / np.where(largest > 0, largest, 1.0)[:, None]
        where, row, column = np.unravel_index(int(np.argmax(np.where(np.isfinite(defects), defects, 0.0))), defects.shape)
        if not defects[where, row, column] > SYMMETRY_DEFECT:
            return ""
        forces = row >= self.constraints.sizes(jnp.asarray(q[0]), params)[0]
        what = "the forces f(t, q, v) move" if forces else "the forces of the constraints move"
        part = (
            f"{'f' if forces else f'one-form {row}'} has the part {parts[where, row, column]:.3g} along {self.named(int(column))}"
        )
        at = f"q = {np.asarray(q[where])}" + f", v = {np.asarray(v[where])}" * bool(forces)
        return f"{what}: {part} at {at}, at or near the initial data"

    def _parts_along(self, t, q, v, params):
        """The parts of the rows of W and of f along the group, (samples, rows, k), and the sizes of the rows."""

        def at(t, q, v):
            rows = self.constraints.one_forms_at(t, q, params)
            if self.system.forces is not None:
                rows = jnp.concatenate([rows, forces_at(self.system, t, q, v, params)])
            return self.along(q, rows), jnp.max(jnp.abs(rows), axis=1)

        return jax.vmap(at)(t, q, v)

    def refuse_moved_one_forms(self, data: Data, params: Any) -> None:
        """Raise `ValueError` where the group leaves the span of the one-forms alone but not these themselves, at or near initial
        data, which must be concrete: impulses at several points then are those of different one-forms, and have no sum."""
        if self.system.one_forms is None:
            return
        t, q, _ = self.sampled(data, params)
        moved, sizes = (np.asarray(a) for a in evaluated(self._moved_one_forms, t, q, params))
        worst = np.max(np.where(np.isfinite(moved), moved, 0.0) / np.where(sizes > 0, sizes, 1.0), axis=0)
        if np.max(worst, initial=0.0) > SYMMETRY_DEFECT:
            raise ValueError(
                f"one-form {int(np.argmax(worst))} is moved by the group, which leaves the span of the one-forms alone: the "
                "impulses of a composed step, at several points of an orbit, have no sum on the quotient. State the one-forms so "
                "that each is invariant, or step the unreduced system."
            )

    def _moved_one_forms(self, t, q, params):
        """By how much each one-form differs from that at the origin of the orbit, (samples, m), and how large it is."""

        def at(t, q):
            rows, fixed = (self.at_identity(q, self.constraints.one_forms_at(t, q, params)) for q in (q, self.origin_of(q)))
            return jnp.max(jnp.abs(rows - fixed), axis=1), jnp.max(jnp.abs(rows), axis=1)

        return jax.vmap(at)(t, q)

    @abstractmethod
    def refuse_asymmetry(self, data: Data, params: Any) -> None:
        """Raise `ValueError` where the group is no symmetry of the system, at or near initial data, which must be concrete."""

    @property
    def premise_of_params(self) -> bool:
        """The symmetry."""
        return True

    def check(self, data: Data, params: Any) -> None:
        """Raise `ValueError` where the premise does not hold, or the group is no symmetry, at values not looked at before."""
        if not is_traced(data, params):
            values = [(str(name), np.asarray(a).tobytes()) for name, a in sorted(data.items())]
            leaves = [(str(where), np.asarray(a).tobytes()) for where, a in jax.tree_util.tree_leaves_with_path(params)]
            _symmetric.get((self, *values, *leaves), lambda: self.refuse_asymmetry(data, params))
        super().check(data, params)

    def complete(self, data: Data, params: Any, project: bool) -> Data:
        """Those of the unreduced system, of a saved row too."""
        if "x" in data:
            whole = self.unreduced_row({name: data[name] for name in self.own_fields})
            data = {"q": whole["q"], "p": whole["p"]} | ({"t": data["t"]} if "t" in data else {})
        return self.system.complete(data, params, project)

    def initial_defect(self, data: Data, params: Any) -> Float[Array, " m"]:
        return self.system.initial_defect(data, params)

    def initial_terms(self, data: Data, params: Any) -> Float[Array, " m"]:
        return self.system.initial_terms(data, params)

    def energy_at(self, row: Data, params: Any) -> Float[Array, ""]:
        """The energy of the unreduced system, which the group coordinate does not change."""
        return self.system.energy_at(self._whole(row), params)

    def constraint_at(self, row: Data, params: Any) -> Float[Array, " m"]:
        return self.system.constraint_at(self._whole(row), params)

    @property
    def searches_near(self) -> tuple[str, ...]:
        return ("x", "g") if self.system.searches_near == ("q",) else ()

    def _whole(self, row: Data) -> Data:
        """The row over a reduced row, with the velocity q̇ that it is about of ẋ and ġ."""
        whole = self.unreduced_row(row)
        if "about" not in row:
            return whole
        places = row["x"], row["g"]
        along = jnp.split(row["about"], [row["x"].size])
        moving = tuple(a.reshape(place.shape) for a, place in zip(along, places, strict=True))
        return whole | {"about": jax.jvp(self.connection.join, places, moving)[1]}

    @property
    def projected(self) -> str:
        return self.system.projected

    @property
    def energy_changes(self) -> str:
        return self.system.energy_changes


class ReducedLagrangeDirac(AbstractReducedSystem):
    """A Lagrangian system on the quotient (Q × Q)/G ≅ Σ × Σ × G by translations in the fibre ([RL] §4). Made by `dx.reduce`.

    Rows of a trajectory hold x (n − k,), w (n − k,) and mu (k,), the trivialized momentum λ̂_d(q, p) = (x, w, μ), and the
    group coordinate g (k,), a quadrature that `dx.reconstruct` uses.
    """

    system: LagrangeDirac
    connection: AbstractConnection

    @property
    def action(self) -> Translations:
        return Translations(self.connection.fibre)

    @property
    def own_fields(self) -> tuple[str, ...]:
        return ("x", "w", "mu", "g")

    @property
    def conserves_momentum(self) -> bool:
        """G = ∂g/∂q of invariant holonomic constraints has no part along the group."""
        return self.system.forces is None and self.system.one_forms is None

    def sampled(self, data: Data, params: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        q, units = np.asarray(data["q"] if "q" in data else data["q0"]), self._units(data, params)
        v = np.asarray(data["v"]) if "v" in data else units.v
        return sampled_near(q, v, units, NEARBY, SAMPLES, data.get("t", 0.0))

    def _units(self, data: Data, params: Any) -> SampleUnits:
        q = np.asarray(data["q"] if "q" in data else data["q0"])
        return units_of(self.system, q, np.asarray(data["v"]) if "v" in data else np.zeros_like(q), params, data.get("t", 0.0))

    def named(self, generator: int) -> str:
        return f"q[{self.connection.fibre[generator]}]"

    def along(self, q: Array, covectors: Float[Array, "m n"]) -> Float[Array, "m k"]:
        return covectors[:, np.array(self.connection.fibre)]

    def at_identity(self, q: Array, covectors: Float[Array, "m n"]) -> Float[Array, "m n"]:
        return covectors

    def origin_of(self, q: Array) -> Array:
        return self.connection.join(self.connection.split(q)[0], jnp.zeros(len(self.connection.fibre)))

    def unreduced_row(self, row: Data) -> dict[str, Array]:
        q = self.connection.join(row["x"], row["g"])
        p = self.connection.untrivialize_covector(row["x"], row["w"], row["mu"])
        return {"q": q, "p": p} | {name: value for name, value in row.items() if name not in self.own_fields}

    def momentum_map(self, row: Data) -> Float[Array, " k"]:
        return row["mu"]

    def sizes(self, data: Data, params: Any) -> tuple[int, ...]:
        sizes = self.system.sizes(data, params)
        self.connection.check(sizes[0])
        return sizes

    def premise(self, data: Data, params: Any) -> Premise:
        """The orbits of the group are free where a run begins: a generator that vanishes there has no inertia there only."""
        away = 0.1 * self._units(data, params).q * np.random.default_rng(0).uniform(0.5, 1.0, self.point(data).shape)
        return Premise(_Inertias(self.system, self.connection, tuple(away.tolist())), self._refuse_fixed_points)

    def _refuse_fixed_points(self, found):
        q, here, nearby = found
        if not (np.all(np.isfinite(here)) and np.all(np.isfinite(nearby))):
            return
        own = diagonal_units(nearby)

        def rank(inertia):
            scaled = inertia / own / own[:, None]
            if len(scaled) == 1:
                return int(abs(scaled[0, 0]) > INERTIA_RANK)
            return int(np.linalg.matrix_rank(scaled, tol=INERTIA_RANK, hermitian=True))

        if rank(here) < rank(nearby):
            raise ValueError(
                f"the orbits of the group are not free at the initial point q = {q}: the group inertia has rank {rank(here)} "
                f"there and {rank(nearby)} nearby. Start elsewhere, or use coordinates that do not end there."
            )

    def refuse_asymmetric(self, functions: dict[str, UserFunction], data: Data, h: float, params: Any) -> None:
        """Raise `ValueError` where functions of ([t, ]q0, q1, h[, params]) are not invariant, at data that must be concrete."""
        t, q, v = self.sampled(data, params)
        found = discrete_invariance(functions, self.action, t, q, q + h * v, h, params, self._units(data, params))
        if not found.ok:
            worst = self.connection.fibre[found.generator]
            raise ValueError(
                f"the {found.of} is not invariant under translation of q[{worst}]: its derivative along it is "
                f"{found.defect:.3g} at q0 = {found.q}, q1 = {found.v}, at or near the initial data; let it depend on "
                f"q1[{worst}] − q0[{worst}] alone, or take that coordinate out of fibre."
            )

    def refuse_asymmetry(self, data, params) -> None:
        units = self._units(data, params)
        found = invariance(self.system, self.action, *self.sampled(data, params), params, units)
        if not found.ok:
            worst = self.connection.fibre[found.generator]
            what = {"lagrangian": f"∂L/∂q[{worst}]", "one_forms": "the motion of its one-forms out of their span"}
            what = what.get(found.of, f"its derivative by q[{worst}]")
            raise ValueError(
                f"the {found.of} is not invariant under translation of q[{worst}]: {what} = {found.defect:.3g} at "
                f"q = {found.q}, v = {found.v}, at or near the initial data; take that coordinate out of fibre."
            )


@dataclass(frozen=True)
class _Inertias:
    """(data, params) ↦ q, and ∂²L/∂ġ² at rest at q and at the point `away` from it."""

    system: LagrangeDirac
    connection: AbstractConnection
    away: tuple[float, ...]

    def __call__(self, data: Data, params: Any) -> tuple[Array, Array, Array]:
        q, t, fibre = self.system.point(data), data.get("t", 0.0), np.array(self.connection.fibre)
        rest, away = jnp.zeros_like(q), jnp.asarray(self.away)
        here, nearby = (jnp.asarray(self.system.velocity_hessian(t, at, rest, params))[fibre][:, fibre] for at in (q, q + away))
        return q, here, nearby
