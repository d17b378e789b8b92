"""One step of energy-preserving collocation, on a Hamiltonian with a bracket, or on a Lagrangian with constraints."""

import warnings
from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.numerics.tolerances import STRUCTURE_DEFECT
from dirax.program.legendre import constrained_velocity
from dirax.program.linear_solves import solve
from dirax.program.tracing import along, gradient, jacobian, once
from dirax.schemes.abstract_step import AbstractStep
from dirax.schemes.collocation_tables import Quadrature, Tableau
from dirax.schemes.layout import Layout
from dirax.schemes.stage_relation import MeanRelation
from dirax.schemes.step import Field, StepEquation
from dirax.systems.forms import EnergyForm, RelationForm
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.shape import Shape

NOTICED = 1e-11
"""Changes of the energy in a step, relative to its terms, from which on they are more than roundoff of the rows, whose angles may
have run to 10⁶. What is less is given back in the momenta, so that it does not add up over many steps."""

NEARLY_DEPENDENT = 1e-2
"""The smallest singular value of one-forms of length 1 from which on they are called dependent where a step has failed."""

STEEP = 1e-3
"""Of the terms of the energy, ⟨p, v⟩ below which little is given back."""


@dataclass(frozen=True, eq=False)
class EnergyCollocationStep(AbstractStep):
    """The equations of a mean relation at every node: state (a, b), a of length `moving`.

    Every state ends with its energy and its `energy_defect`, the largest change of H in a step that is not the work of that
    step, relative to the sizes of the terms of H: what the quadrature leaves, and roundoff.
    """

    tableau: Tableau
    quadrature: Quadrature

    @property
    @abstractmethod
    def moving(self) -> int:
        """The length of a."""

    @abstractmethod
    def slopes(self, a: Array, rate: Array, t: Any, params: Any) -> Float[Array, " g"]:
        """The derivatives of H at a point of the polynomial whose derivative there is `rate`, and what else is averaged."""

    @abstractmethod
    def rates(self, a: Array, mean: Float[Array, " g"], t: Any, params: Any) -> Float[Array, " s"]:
        """(ȧ, ḃ) at a node, of the mean of the slopes."""

    @abstractmethod
    def settle(self, before: Array, after: Array, rate: Array, t: Any, h: Any, params: Any) -> Float[Array, " s"]:
        """What is added to the state at the end of a step that ends with this rate."""

    @property
    def unknowns(self) -> Layout:
        return Layout(**{f"rate_{i + 1}": self.moving for i in range(self.tableau.stages)})

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(f"equation {i} at node {j + 1}" for j in range(self.tableau.stages) for i in range(self.moving))

    def nodes(self, u, state, t, h, params) -> Float[Array, "stages s"]:
        """(ȧ, ḃ) at every node."""
        y, start, table = u.reshape(self.tableau.stages, -1), state[: self.moving], self.quadrature
        slopes = lambda a, rate, t: once(self.slopes)(a, rate, t, params)
        rates = lambda a, mean, t: once(self.rates)(a, mean, t, params)
        found = jax.vmap(slopes)(start[None] + h * (table.matrix @ y), table.values @ y, t + h * table.points)
        return jax.vmap(rates)(start[None] + h * (self.tableau.matrix @ y), table.means @ found, t + h * self.tableau.nodes)

    def residual(self, u, state, t, h, params):
        return u - self.nodes(u, state, t, h, params)[:, : self.moving].ravel()

    def advance(self, u, state, t, h, params):
        after = state + h * (self.tableau.weights @ self.nodes(u, state, t, h, params))
        end = jnp.asarray(self.quadrature.end) @ u.reshape(self.tableau.stages, -1)
        return after + once(self.settle)(state, after, end, t, h, params)

    @property
    def interpolation(self):
        return self.interpolate

    @abstractmethod
    def node(self, state: Array, params: Any) -> dict[str, Array]:
        """The fields of nodes at a state."""

    def unpack(self, state, u, t, h, params):
        return self.node(state, params)

    def interpolate(self, theta, u, state, t, h, params):
        """At the integral of the polynomial of the rates, with its share of what is settled at the end."""
        rates = self.nodes(u, state, t, h, params)
        inner = state + h * (jnp.stack(self.tableau.integrals(theta)) @ rates)
        end = state + h * (self.tableau.weights @ rates)
        slope = jnp.asarray(self.quadrature.end) @ u.reshape(self.tableau.stages, -1)
        return self.node(inner + theta * once(self.settle)(state, end, slope, t, h, params), params)

    def settled(self, before: Array, after: Array, energy: Any, work: Any, size: Any) -> dict[str, Array]:
        """The parts of what is added that belong to the energy at the end, with the work of the step and the size of the
        terms of the energy."""
        left = jnp.abs((energy - before[-2]) - work) / size
        return {"energy": energy - after[-2], "energy_defect": jnp.where(left > before[-1], left, before[-1]) - after[-1]}

    @property
    def book(self) -> dict[str, Field]:
        """The field that every step saves."""
        about = "largest change of the energy in a step, less its work, relative to the terms of the energy"
        return {"energy_defect": Field((), "node", (), about)}

    def review(self, fields):
        defect = float(np.nanmax(fields["energy_defect"], initial=0.0))
        if defect > NOTICED:
            warnings.warn(
                f"the energy changed by {defect:.1e} of the size of its terms in a step of dx.EnergyCollocation, more than "
                f"roundoff: the quadrature with {len(self.quadrature.points)} points is not exact for such steps, or one of them "
                "passed a place where the equations are nearly singular. Take smaller steps, or more points=.",
                stacklevel=4,
            )
        return {"energy_defect": defect}

    def equation(self) -> StepEquation:
        """The StepEquation, with the mean relation that it is made of."""
        extra, functions = self.state.size - self.moving, (self.slopes, self.rates, self.settle)
        relation = MeanRelation(self.moving, extra, *functions, self.tableau, self.quadrature)
        return replace(super().equation(), collocation=relation)


@dataclass(frozen=True, eq=False)
class LagrangianEnergyCollocation(EnergyCollocationStep):
    """A Lagrangian with W v + b = 0 as an almost-Poisson system on T*Q, with H(q, p) = ext_v ⟨p, v⟩ − L over W v + b = 0.

    H does not change along D° = im Wᵀ where b = 0, so that it is a function on D*. With the multipliers ν of the extremum,
    ∂L/∂v = p + Wᵀν, its derivatives are ∂H/∂p = v and ∂H/∂q = −∂L/∂q + ∂⟨ν, W v + b⟩/∂q, and the motion is

        q̇ = v,   ṗ = P (−∂H/∂q + f + ∂⟨ν, W q̇ + b⟩/∂q − d(Wᵀν)/dt|_ν),   P = 1 − Wᵀ(W Wᵀ)⁻¹W,

    with the derivative along q̇ at fixed ν. The terms in ν are −⟨∂L/∂v − p, [X, Y]⟩ for fields X, Y in D: where p = ∂L/∂v, as
    at the start of every step, they vanish, and along the step they make of the bracket of vector fields of D that of [PY],
    −⟨∂L/∂v, [X, Y]⟩ (Celledoni, Farré Puiggalí, Høiseth, Martín de Diego 2019), without a frame of D. q̇ is projected
    onto W q̇ + b = 0 at the nodes, and p is made ∂L/∂v at the end of the step, where this changes nothing on D.
    """

    system: LagrangeDirac
    shape: Shape

    @property
    def working(self) -> bool:
        """Whether the energy changes: by forces, by constraints that move, or by explicit time."""
        return self.system.forces is not None or bool(self.system.energy_changes)

    @property
    def n(self) -> int:
        """The number of coordinates."""
        return self.shape.n

    @property
    def moving(self) -> int:
        return 2 * self.n

    @property
    def state(self) -> Layout:
        return Layout(q=self.n, p=self.n, work=int(self.working), energy=(), energy_defect=())

    @property
    def canonical(self) -> bool:
        return False

    @property
    def fields(self) -> dict[str, Field]:
        work = {"work": Field((), "node", (), "work of the forces and of what moves since the start")}
        return {"q": Field((self.n,)), "p": Field((self.n,))} | (work if self.working else {}) | self.book

    def constraint(self, t, q, params):
        """W and b, of the constraints that are independent."""
        if not self.shape.m:
            return jnp.zeros((0, self.n)), jnp.zeros(0)
        rows = self.shape.pick(self.system.constraints.one_forms_at(t, q, params))
        affine = self.system.affine
        return rows, jnp.zeros(len(rows)) if affine is None else self.shape.pick(affine.at(t, q, params))

    @once
    def velocity(self, t, q, p, guess, params):
        """(v, ν)."""
        rows, offset = self.constraint(t, q, params)
        return constrained_velocity(lambda v: self.system.lagrangian.at(t, q, v, params), p, rows, offset, guess)

    def slopes(self, a, rate, t, params):
        q, p = a[: self.n], a[self.n :]
        v, multipliers = self.velocity(t, q, p, rate[: self.n], params)

        def energy(t, q):
            rows, offset = self.constraint(t, q, params)
            return multipliers @ (rows @ v + offset) - self.system.lagrangian.at(t, q, v, params)

        parts = [gradient(lambda q: energy(t, q))(q), v, multipliers]
        if self.system.depends_on_time:
            parts.append(gradient(lambda t: energy(t, q))(jnp.asarray(t, float))[None])
        return jnp.concatenate(parts)

    def rates(self, a, mean, t, params):
        n, q = self.n, a[: self.n]
        slope, velocity, multipliers = mean[:n], mean[n : 2 * n], mean[2 * n : 2 * n + len(self.shape.kept)]
        rows, offset = self.constraint(t, q, params)
        inside = self._projection(rows)
        missing = rows @ velocity + offset
        rate = velocity - rows.T @ solve(rows @ rows.T, missing) if len(rows) else velocity
        pull = jnp.zeros(n)
        if len(rows):
            reaction = lambda t, q: self.constraint(t, q, params)[0].T @ multipliers

            def power(q):
                rows, offset = self.constraint(t, q, params)
                return multipliers @ (rows @ rate + offset)

            pull = gradient(power)(q) - along(reaction, (jnp.asarray(t, float), q), (jnp.ones(()), rate))
        force = jnp.zeros(n) if self.system.forces is None else self.system.forces(t, q, rate, params)
        out = [rate, inside(pull + force - slope)]
        if self.working:
            work = force @ rate
            if self.system.energy_changes:
                own = inside(velocity)
                work = slope @ (rate - own) + own @ (pull + force) + (mean[-1] if self.system.depends_on_time else 0.0)
            out.append(work[None])
        return jnp.concatenate([*out, jnp.zeros(2)])

    @staticmethod
    def _projection(rows):
        """α ↦ P α."""
        return lambda vector: vector - rows.T @ solve(rows @ rows.T, rows @ vector) if len(rows) else vector

    def settle(self, before, after, rate, t, h, params):
        now = self.state.split(after)
        v, multipliers = self.velocity(t + h, now.q, now.p, rate[: self.n], params)
        rows, offset = self.constraint(t + h, now.q, params)
        moved, given = rows.T @ multipliers, multipliers @ offset
        lagrangian = self.system.lagrangian.at(t + h, now.q, v, params)
        energy, size = (now.p + moved) @ v - lagrangian, jnp.abs(now.p) @ jnp.abs(v) + jnp.abs(lagrangian)
        work = (now.work - self.state.split(before).work)[0] - given if self.working else jnp.zeros(())
        changes = {"work": -given[None]} if self.working else {}
        book = self.settled(before, after, energy, work, size)
        left = self.state.split(before).energy + work - energy
        kept = jnp.abs(left) <= NOTICED * size
        power = (now.p + moved) @ v
        scale = jnp.where(kept, left, 0.0) * power / (power * power + (STEEP * size) ** 2)
        book["energy"] = book["energy"] + jnp.where(kept, left, 0.0)
        return self.state.join(p=moved + scale * (now.p + moved), **changes, **book)

    def remark(self, state, t, h, params):
        """Whether the distribution changes its rank within the step."""
        now = self.state.split(jnp.asarray(state))
        v = self.velocity(t, now.q, now.p, jnp.zeros(self.n), params)[0]
        points = [(t + share * h, now.q + share * h * v) for share in np.linspace(0.0, 1.0, 17)] if self.shape.m else []
        for t, q in points:
            rows = np.asarray(self.constraint(t, q, params)[0])
            lengths = np.linalg.norm(rows, axis=1, keepdims=True)
            least = np.linalg.svd(rows / np.where(lengths > 0.0, lengths, 1.0), compute_uv=False)[-1]
            if not least > NEARLY_DEPENDENT:
                place = np.array2string(np.asarray(q), precision=4)
                return (
                    f"near q = {place} the one-forms depend on each other (smallest singular value {least:.1g} of rows of length "
                    "1), so that the distribution changes its rank there, where this scheme does not pass"
                )
        return ""

    def start(self, data, h, params):
        if "q0" in data:
            raise ValueError("collocation is a one-step method: start it from q= with v= or p=, not from two points.")
        q, v, p, t = data["q"], data["v"], data["p"], data.get("t", 0.0)
        state = self.state.join(q=q, p=p, energy=self.system.generalized_energy(q, v, p, params, t))
        mean = self.slopes(state[: 2 * self.n], jnp.concatenate([v, jnp.zeros(self.n)]), t, params)
        return state, jnp.tile(self.rates(state[: 2 * self.n], mean, t, params)[: 2 * self.n], self.tableau.stages)

    def node(self, state, params):
        now = self.state.split(state)
        row = {"q": now.q, "p": now.p, "energy_defect": now.energy_defect}
        return row | ({"work": now.work[0]} if self.working else {})


@dataclass(frozen=True, eq=False)
class HamiltonianEnergyCollocation(EnergyCollocationStep):
    """(ẋ, dH) in a Dirac structure that is a graph, with ports: dH replaced by its means in the energy form's relation."""

    relation: RelationForm
    form: EnergyForm
    n: int

    @property
    def moving(self) -> int:
        return self.n

    @property
    def state(self) -> Layout:
        return Layout(x=self.n, work=2 * int(self.form.ports is not None), energy=(), energy_defect=())

    @property
    def fields(self) -> dict[str, Field]:
        work = {"work": Field((2,), "node", ("work",), "energy supplied and energy dissipated since the start")}
        return {name: Field((self.n,)) for name in self.relation.names} | (work if self.form.ports else {}) | self.book

    def slopes(self, a, rate, t, params):
        return self.form.differential(a, params)

    def rates(self, a, mean, t, params):
        defect = lambda rate: self.form.residual(a, rate, jnp.zeros(0), t, params, mean)
        zero = jnp.zeros(self.n)
        out = [solve(jacobian(defect)(zero), -defect(zero))]
        if self.form.ports is not None:
            driven, outputs, loss = self.form.ports(t, a, mean, params)
            out += [(driven @ outputs)[None], loss[None]]
        return jnp.concatenate([*out, jnp.zeros(2)])

    def settle(self, before, after, rate, t, h, params):
        old, now = self.state.split(before), self.state.split(after)
        energy = self.form.hamiltonian(now.x, params)
        balance = (lambda change: change[0] - change[1])(now.work - old.work) if self.form.ports is not None else 0.0
        size = jnp.abs(energy) + jnp.abs(now.x) @ jnp.abs(self.form.differential(now.x, params))
        return self.state.join(**self.settled(before, after, energy, balance, size))

    def check(self, data, h, params):
        if self.form.ports is not None:
            return
        point = data["x"] if "x" in data else data["q"]
        x = jnp.asarray(point if len(point) == self.n else np.concatenate([point, data["p"]]))
        rate = lambda mean: self.rates(x, mean, data.get("t", 0.0), params)[: self.n]
        bracket = np.asarray(jacobian(rate)(jnp.zeros(self.n)))
        worst = np.max(np.abs(bracket + bracket.T))
        if worst > STRUCTURE_DEFECT * np.max(np.abs(bracket)):
            raise ValueError(
                f"the bracket Π of ẋ = Π dH is not antisymmetric at the initial point: max |Π + Πᵀ| = {worst:.3g}, so that the "
                "energy is not kept. Put the symmetric part into R of a dx.PortHamiltonian."
            )

    def start(self, data, h, params):
        if "x" not in data:
            raise ValueError("this scheme is a one-step method in x: start it from one point, not from two.")
        x, t = data["x"], data.get("t", 0.0)
        rate = self.rates(x, self.slopes(x, x, t, params), t, params)[: self.n]
        return self.state.join(x=x, energy=self.form.hamiltonian(x, params)), jnp.tile(rate, self.tableau.stages)

    def node(self, state, params):
        now = self.state.split(state)
        row = self.relation.node(now.x, params) | {"energy_defect": now.energy_defect}
        return row | ({"work": now.work} if self.form.ports is not None else {})
