"""One step of energy-preserving collocation of a Lagrangian with constraints: an almost-Poisson system on T*Q."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from dirax.numerics.sparse import FEWEST_SPARSE
from dirax.program.legendre import constrained_velocity
from dirax.program.linear_solves import solve
from dirax.program.tracing import along, gradient, jacobian, once
from dirax.schemes.energy_collocation_step import FAR, EnergyCollocationStep, given_back
from dirax.schemes.layout import Layout
from dirax.schemes.step import Field
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.shape import Shape

NEARLY_DEPENDENT = 1e-2
"""The smallest singular value of one-forms of length 1 from which on they are called dependent where a step has failed."""


@dataclass(frozen=True, eq=False)
class LagrangianEnergyCollocation(EnergyCollocationStep):
    """A Lagrangian with W v + b = 0 as an almost-Poisson system on T*Q, with H(q, p) = ext_v ⟨p, v⟩ − L over W v + b = 0.

    H does not change along D° = im Wᵀ where b = 0, so that it is a function on D*. With the multipliers ν of the extremum,
    ∂L/∂v = p + Wᵀν, its derivatives are ∂H/∂p = v and ∂H/∂q = −∂L/∂q + ∂⟨ν, W v + b⟩/∂q, and the motion is

        q̇ = v,   ṗ = P (−∂H/∂q + f + ∂⟨ν, W q̇ + b⟩/∂q − d(Wᵀν)/dt|_ν),   P = 1 − Wᵀ(W S Wᵀ)⁻¹W S,

    with the derivative along q̇ at fixed ν, and S the inverses of the masses ∂²L/∂v_i², so that units drop out. The terms in ν
    are −⟨∂L/∂v − p, [X, Y]⟩ for fields X, Y in D: where p = ∂L/∂v, as at the start of every step, they vanish, and along the
    step they make of the bracket of vector fields of D that of [PY], −⟨∂L/∂v, [X, Y]⟩ (Celledoni, Farré Puiggalí, Høiseth,
    Martín de Diego 2019), without a frame of D. q̇ is projected onto W q̇ + b = 0 at the nodes, and p is made ∂L/∂v at the end
    of the step, where this changes nothing on D.

    Of many coordinates without constraints the velocities at the points and at the end are unknowns, with p = ∂L/∂v.
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
    def sparse(self) -> bool:
        """Without constraints alone: the projection P makes every equation one of all unknowns."""
        return self.moving >= FEWEST_SPARSE and not self.shape.kept

    @property
    def inner(self) -> int:
        """The velocities, which are those of p at the right ones."""
        return self.n if self.sparse else 0

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
        """(v, ν); where velocities are unknowns themselves, the `guess`."""
        if self.inner:
            return guess, jnp.zeros(0)
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
        mobile = rows * self._mobility(t, q, velocity, params)[None] if len(rows) else rows  # W S
        inside = lambda vector: vector - rows.T @ solve(mobile @ rows.T, mobile @ vector) if len(rows) else vector
        outside = lambda missing: mobile.T @ solve(mobile @ rows.T, missing) if len(rows) else jnp.zeros(n)
        rate = velocity - outside(rows @ velocity + offset)
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
                own = velocity - outside(rows @ velocity)
                work = slope @ (rate - own) + own @ (pull + force) + (mean[-1] if self.system.depends_on_time else 0.0)
            out.append(work[None])
        return jnp.concatenate([*out, jnp.zeros(2)])

    def of_inner(self, a, inner, t, params):
        q, p = a[: self.n], a[self.n :]
        return p - gradient(lambda v: self.system.lagrangian.at(t, q, v, params))(inner)

    def _mobility(self, t, q, v, params):
        """1/|∂²L/∂v_i²|, the diagonal S; 1 for a coordinate without a mass of its own."""
        lagrangian = lambda v: self.system.lagrangian.at(t, q, v, params)
        mass = jnp.abs(jnp.diagonal(jacobian(gradient(lagrangian))(v)))
        return jnp.where(mass > 0.0, 1.0 / jnp.where(mass > 0.0, mass, 1.0), 1.0)

    def lifted(self, place, rate, t, params):
        """p becomes ∂L/∂v, and the work that of this p."""
        if not self.shape.kept:
            return jnp.zeros_like(place)
        now = self.state.split(place)
        _, multipliers = self.velocity(t, now.q, now.p, rate[: self.n], params)
        rows, offset = self.constraint(t, now.q, params)
        return self.state.join(p=rows.T @ multipliers, **({"work": -(multipliers @ offset)[None]} if self.working else {}))

    def settle(self, before, after, rate, t, h, params):
        now = self.state.split(after)
        v, multipliers = self.velocity(t + h, now.q, now.p, rate[: self.n], params)
        rows, offset = self.constraint(t + h, now.q, params)
        moved, given = rows.T @ multipliers, multipliers @ offset
        at_place = lambda q: self.system.lagrangian.at(t + h, q, v, params)
        lagrangian, of_place = at_place(now.q), jnp.abs(gradient(at_place)(now.q)) @ jnp.abs(now.q)
        energy, size = (now.p + moved) @ v - lagrangian, jnp.abs(now.p) @ jnp.abs(v) + jnp.abs(lagrangian)
        terms = size + FAR * of_place
        work = (now.work - self.state.split(before).work)[0] - given if self.working else jnp.zeros(())
        changes = {"work": -given[None]} if self.working else {}
        book = self.settled(before, after, energy, work, terms)
        kept, scale = given_back(self.state.split(before).energy + work - energy, (now.p + moved) @ v, size, terms)
        book["energy"] = book["energy"] + kept
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
        rates = jnp.tile(self.rates(state[: 2 * self.n], mean, t, params)[: 2 * self.n], self.tableau.stages)
        return state, jnp.concatenate([rates, jnp.tile(v, len(self.quadrature.points) + 1)]) if self.inner else rates

    def node(self, state, params):
        now = self.state.split(state)
        row = {"q": now.q, "p": now.p, "energy_defect": now.energy_defect}
        return row | ({"work": now.work[0]} if self.working else {})
