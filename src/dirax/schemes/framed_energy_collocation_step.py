"""One step of energy-preserving collocation of a Lagrangian with one-forms in a frame of the distribution: adapted momenta."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from dirax.numerics.tolerances import FRAME_DEFECT
from dirax.program.legendre import constrained_velocity
from dirax.program.linear_solves import solve
from dirax.program.tracing import along, gradient, once
from dirax.program.user_functions import UserFunction, evaluated, is_traced
from dirax.schemes.energy_collocation_step import FAR, EnergyCollocationStep, given_back
from dirax.schemes.lagrangian_energy_collocation_step import NEARLY_DEPENDENT
from dirax.schemes.layout import Layout
from dirax.schemes.step import Field
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.shape import Shape


@dataclass(frozen=True, eq=False)
class FramedEnergyCollocation(EnergyCollocationStep):
    """A Lagrangian on D = im A(q) as an almost-Poisson system in (q, π), π = Aᵀp: with H(q, π) = ext_ξ ⟨π, ξ⟩ − L(q, Aξ)

        q̇ = Aξ,   π̇ = Aᵀ(−∂H/∂q + f) + Γξ,   Γ_ab = −⟨p, [A_a, A_b]⟩,   ξ = ∂H/∂π,   p = ∂L/∂v(q, Aξ)

    (Celledoni, Farré Puiggalí, Høiseth, Martín de Diego 2019). The rates at a node have the means of ∂H/∂q and of ξ, with A, p
    and the brackets there. Every q̇ lies in D, and Γ is antisymmetric whatever the frame is.
    """

    system: LagrangeDirac
    shape: Shape
    given: UserFunction

    @property
    def rank(self) -> int:
        """How many vectors the frame has."""
        return self.shape.n - len(self.shape.kept)

    @property
    def moving(self) -> int:
        return self.shape.n + self.rank

    @property
    def state(self) -> Layout:
        work = int(self.system.forces is not None)
        return Layout(q=self.shape.n, momentum=self.rank, work=work, energy=(), energy_defect=())

    @property
    def canonical(self) -> bool:
        return False

    @property
    def fields(self) -> dict[str, Field]:
        n = self.shape.n
        work = {"work": Field((), "node", (), "work of the forces since the start")}
        return {"q": Field((n,)), "p": Field((n,))} | (work if self.system.forces is not None else {}) | self.book

    def frame(self, q, params):
        """A(q) (n, k). Raises `ValueError` for another shape."""
        frame, n, k = self.given(q, params), self.shape.n, self.rank
        if jnp.shape(frame) != (n, k):
            raise ValueError(
                f"frame(q) must have shape ({n}, {k}), a basis of the {k} directions that {n - k} one-forms leave free as "
                f"columns, but it has shape {jnp.shape(frame)}."
            )
        return frame

    @once
    def velocity(self, q, momentum, guess, params):
        """ξ and p of adapted momenta π; `guess` is a velocity q̇."""
        frame = self.frame(q, params)
        inside = solve(frame.T @ frame, frame.T @ guess)
        of_xi = lambda xi: self.system.lagrangian.at(0.0, q, frame @ xi, params)
        xi, _ = constrained_velocity(of_xi, momentum, jnp.zeros((0, self.rank)), jnp.zeros(0), inside)
        return xi, self.system.legendre(q, frame @ xi, params)

    def slopes(self, a, rate, t, params):
        n, q = self.shape.n, a[: self.shape.n]
        xi, _ = self.velocity(q, a[n:], rate[:n], params)
        value = lambda q: self.system.lagrangian.at(0.0, q, self.frame(q, params) @ xi, params)
        # the velocity too, from which Newton's method finds that of a node
        return jnp.concatenate([-gradient(value)(q), xi, rate[:n]])

    def rates(self, a, mean, t, params):
        n, k, q = self.shape.n, self.rank, a[: self.shape.n]
        slope, xi = mean[:n], mean[n : n + k]
        _, p = self.velocity(q, a[n:], mean[n + k :], params)
        frame = self.frame(q, params)
        rate = frame @ xi
        turning = along(lambda q: p @ self.frame(q, params), (q,), (rate,))
        bracket = turning - gradient(lambda q: p @ (self.frame(q, params) @ xi))(q) @ frame
        if self.system.forces is None:
            return jnp.concatenate([rate, bracket - slope @ frame, jnp.zeros(2)])
        force = self.system.forces(t, q, rate, params)
        return jnp.concatenate([rate, bracket + (force - slope) @ frame, (force @ rate)[None], jnp.zeros(2)])

    def settle(self, before, after, rate, t, h, params):
        n, then, now = self.shape.n, self.state.split(before), self.state.split(after)
        xi, _ = self.velocity(now.q, now.momentum, rate[:n], params)
        at_place = lambda q: self.system.lagrangian.at(0.0, q, self.frame(q, params) @ xi, params)
        lagrangian, of_place = at_place(now.q), jnp.abs(gradient(at_place)(now.q)) @ jnp.abs(now.q)
        power = now.momentum @ xi
        energy, size = power - lagrangian, jnp.abs(now.momentum) @ jnp.abs(xi) + jnp.abs(lagrangian)
        terms = size + FAR * of_place
        work = (now.work - then.work)[0] if self.system.forces is not None else jnp.zeros(())
        book = self.settled(before, after, energy, work, terms)
        kept, scale = given_back(then.energy + work - energy, power, size, terms)
        book["energy"] = book["energy"] + kept
        return self.state.join(momentum=scale * now.momentum, **book)

    def check(self, data, h, params):
        """Raise `ValueError` where A(q) is no basis, or has vectors out of D."""
        q = data["q"]
        if is_traced(q, params):
            return
        place = f"at q = {np.array2string(np.asarray(q), precision=4)}"
        frame, rows = (
            np.asarray(a) for a in evaluated(lambda q, params: (self.frame(q, params), self._rows(q, params)), q, params)
        )
        unit, least = _of_length_one(frame)
        sizes = np.linalg.norm(rows, axis=1)
        if not least > FRAME_DEFECT:
            raise ValueError(
                f"the columns of frame(q) must be independent, but {place} their smallest singular value is {least:.3g} "
                "(of columns of length 1): give another basis there, or leave frame= out."
            )
        out = np.abs(rows @ unit) / np.where(sizes > 0.0, sizes, 1.0)[:, None]
        if out.size and not out.max() <= FRAME_DEFECT:
            row, column = np.unravel_index(int(np.argmax(out)), out.shape)
            raise ValueError(
                f"the columns of frame(q) must be in the kernel of the one-forms, but {place} one-form {self.shape.kept[row]} "
                f"takes column {column} to {(rows @ frame)[row, column]:.3g}: take this part out of it, or leave frame= out."
            )

    def _rows(self, q, params):
        if not self.shape.kept:
            return jnp.zeros((0, self.shape.n))
        return self.shape.pick(self.system.constraints.one_forms_at(0.0, q, params))

    def remark(self, state, t, h, params):
        """Whether the frame degenerates within the step."""
        now = self.state.split(jnp.asarray(state))
        xi, _ = self.velocity(now.q, now.momentum, jnp.zeros(self.shape.n), params)
        for share in np.linspace(0.0, 1.0, 17):
            q = now.q + share * h * (self.frame(now.q, params) @ xi)
            _, least = _of_length_one(np.asarray(self.frame(q, params)))
            if not least > NEARLY_DEPENDENT:
                return (
                    f"near q = {np.array2string(np.asarray(q), precision=4)} the columns of frame(q) depend on each other "
                    f"(smallest singular value {least:.1g} of columns of length 1): give another, or leave frame= out"
                )
        return ""

    def start(self, data, h, params):
        if "q0" in data:
            raise ValueError("collocation is a one-step method: start it from q= with v= or p=, not from two points.")
        q, v, p = data["q"], data["v"], data["p"]
        n, energy = self.shape.n, self.system.generalized_energy(q, v, p, params, 0.0)
        state = self.state.join(q=q, momentum=p @ self.frame(q, params), energy=energy)
        mean = self.slopes(state[: self.moving], jnp.concatenate([v, jnp.zeros(self.rank)]), data.get("t", 0.0), params)
        rates = self.rates(state[: self.moving], mean, data.get("t", 0.0), params)
        return state, jnp.tile(rates[: n + self.rank], self.tableau.stages)

    def node(self, state, params):
        now = self.state.split(state)
        _, p = self.velocity(now.q, now.momentum, jnp.zeros(self.shape.n), params)
        row = {"q": now.q, "p": p, "energy_defect": now.energy_defect}
        return row | ({"work": now.work[0]} if self.system.forces is not None else {})


def _of_length_one(frame: np.ndarray) -> tuple[np.ndarray, float]:
    """The columns of a frame divided by their lengths, and the smallest singular value of these; NaN where one is not finite."""
    lengths = np.linalg.norm(frame, axis=0)
    unit = frame / np.where(lengths > 0.0, lengths, 1.0)
    return unit, np.linalg.svd(unit, compute_uv=False)[-1] if np.all(np.isfinite(unit)) else np.nan
