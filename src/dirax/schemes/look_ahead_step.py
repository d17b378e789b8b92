"""One step of a Hamiltonian with constraints by the lift of the θ map with θ = 1, whose force is found by looking ahead."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.program.linear_solves import solve
from dirax.program.roots import nearest_root
from dirax.schemes.hamilton_dirac import PhaseSpaceStep
from dirax.schemes.layout import Layout
from dirax.schemes.step import Field
from dirax.systems.forms import RelationForm


@dataclass(frozen=True, eq=False)
class LookAheadStep(PhaseSpaceStep):
    """The discrete Dirac system of the lift of dx.Theta(1.0), with the base point (q_1, p_0):

        Δq/h = ∂H/∂p(q_1, p_0),   Δp/h = −∂H/∂q(q_1, p_0) + W(q_1)ᵀλ,   W(q_1) Δq/h = 0.

    W(q_1) Δq = 0 restricts (q_0, p_0) and leaves λ free: the pairs lie over the states that satisfy it, and λ is the force
    that leads to such a state again, W(q_2) ∂H/∂p(q_2, p_1) = 0. So a step looks one step ahead, as
    `dx.DiscreteEvolution` does ([PY] Definition 6.6). A run begins at the p of such a state that differs from the given one
    by a force Wᵀμ. It is the (+)-discrete Lagrange–Dirac step of h L(q_1, Δq/h) with outgoing momenta.

    State x = (q, p); unknowns are Δq/h, p_1 and the velocity of the step after.
    """

    form: RelationForm
    """Of the system that is run, which says what is saved."""

    @property
    def unknowns(self) -> Layout:
        return Layout(v=self.n, p=self.n, ahead=self.n)

    @property
    def fields(self) -> dict[str, Field]:
        found = {name: Field((self.shape.n,)) for name in self.form.names}
        if self.form.saved:
            found["multipliers"] = Field((self.form.saved,), "step", (self.form.axis,), "multipliers at the base point")
        return found

    @property
    def labels(self) -> tuple[str, ...]:
        kinds = ("velocity {}", "momentum balance {} with the constraint of the step ahead", "velocity {} of the step ahead")
        return tuple(kind.format(i) for kind in kinds for i in range(self.n))

    def matrix(self, t: Any, q: Float[Array, " n"], params: Any) -> Float[Array, "m n"]:
        """W(q), without redundant rows."""
        rows = self.system.constraints.one_forms_at(t, q, params)
        return self.shape.pick(rows) if self.shape.m else rows

    def outgoing(self, v, p, incoming, t, q, h, params) -> Float[Array, " two_n"]:
        """Zero where p differs from the incoming momentum at q by a force in Δ°(q), and the step of velocity v that leaves
        (q, p) has W(q + h v) v = 0."""
        here, ahead = self.matrix(t, q, params), self.matrix(t + h, q + h * v, params)
        onto = lambda rows, a: rows.T @ solve(rows @ rows.T, rows @ a)
        jump = p - incoming
        balance = jump - onto(here, jump) + onto(here, onto(ahead, v))
        return jnp.concatenate([balance, v - self.system.slopes(t + h, q + h * v, p, params)[1]])

    def residual(self, u, state, t, h, params):
        (q, p), (v, p1, ahead) = self.state.split(state), self.unknowns.split(u)
        end = q + h * v
        of_q, of_p = self.system.slopes(t + h, end, p, params)
        return jnp.concatenate([v - of_p, self.outgoing(ahead, p1, p - h * of_q, t + h, end, h, params)])

    def advance(self, u, state, t, h, params):
        v, p, _ = self.unknowns.split(u)
        return self.state.join(q=self.state.split(state).q + h * v, p=p)

    def unpack(self, state, u, t, h, params):
        row = dict(self.form.node(state, params))
        if self.form.saved:
            (q, p), (v, p1, _) = self.state.split(state), self.unknowns.split(u)
            rows = self.matrix(t + h, q + h * v, params)
            force = (p1 - p) / h + self.system.slopes(t + h, q + h * v, p, params)[0]
            row["multipliers"] = self.form.spread(solve(rows @ rows.T, rows @ force))
        return row

    def start(self, data, h, params):
        t, (q, p), both = data.get("t", 0.0), self.state.split(data["x"]), Layout(v=self.n, p=self.n)

        def equations(u):
            v, outgoing = both.split(u)
            return self.outgoing(v, outgoing, p, t, q, h, params)

        guess = both.join(v=data["velocity"][: self.n], p=p)
        found = nearest_root(equations, guess)
        v, outgoing = both.split(jnp.where(jnp.all(jnp.isfinite(found)), found, guess))
        return self.state.join(q=q, p=outgoing), self.unknowns.join(v=v, p=outgoing, ahead=v)
