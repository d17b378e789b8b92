"""Discrete Hamilton–Dirac schemes, (+) and (−): the (±)-discrete Lagrange–Dirac equations from a Hamiltonian."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from dirax.schemes.abstract_step import AbstractStep
from dirax.schemes.constraint_rows import ConstraintRows
from dirax.schemes.layout import Layout
from dirax.schemes.step import AbstractScheme, Field, Shape, StepEquation
from dirax.systems.hamilton_dirac import HamiltonDirac


class PlusHamiltonDirac(AbstractScheme):
    """The (+)-discrete Hamilton–Dirac scheme: dH at (q_k, p_{k+1}), the constraint at the new point q_{k+1}.

        v = ∂H/∂p(q_k, p_{k+1}),   p_k = p_{k+1} + h ∂H/∂q(q_k, p_{k+1}) + W(q_k)ᵀ μ_k,   W(q_{k+1}) v = 0,   q_{k+1} = q_k + h v.

    The elements of the (+)-discrete Dirac structure of [PY] §5 with dH in place of the Dirac differential of L; where H is
    the Legendre transform of a regular L, the steps of `dx.PlusLagrangeDirac("left")`. Explicit time is t_k in H, and that of
    the point in W. First order; without constraints symplectic (symplectic Euler). μ is an impulse of the sign of
    `dx.PlusLagrangeDirac`. Takes a `dx.HamiltonDirac`; raises `TypeError` for others.
    """

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        return HamiltonDiracStep(_checked(system, "PlusHamiltonDirac"), shape, True).equation()

    def part(self, system: Any, shape: Shape) -> AbstractScheme:
        return _part(self, shape)

    def discrete_structure(self, system: Any, shape: Shape, step: Any) -> str:
        return _NO_PAIRS


class MinusHamiltonDirac(AbstractScheme):
    """The (−)-discrete Hamilton–Dirac scheme: dH at (q_{k+1}, p_k − W(q_k)ᵀ μ_k), the constraint at the old point q_k.

        v = ∂H/∂p(q_{k+1}, p⁻),   p_{k+1} = p⁻ − h ∂H/∂q(q_{k+1}, p⁻),   W(q_k) v = 0,   q_{k+1} = q_k + h v;

    p⁻ = p_k − W(q_k)ᵀ μ_k.

    The elements of the (−)-discrete Dirac structure of [PY] §5, whose p_k is the outgoing p⁻; where H is the Legendre transform
    of a regular L, the steps of `dx.MinusLagrangeDirac("right")`. Explicit time is t_{k+1} in H. Otherwise as
    `PlusHamiltonDirac`.
    """

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        return HamiltonDiracStep(_checked(system, "MinusHamiltonDirac"), shape, False).equation()

    def part(self, system: Any, shape: Shape) -> AbstractScheme:
        return _part(self, shape)

    def discrete_structure(self, system: Any, shape: Shape, step: Any) -> str:
        return _NO_PAIRS


_NO_PAIRS = "the (±) structure of T*Q is the equations of this step themselves: whether a step is symplectic is measured instead"


def _part(scheme: AbstractScheme, shape: Shape) -> AbstractScheme:
    if shape.m:
        raise ValueError(
            "a constrained (±) Hamilton–Dirac step ends at a momentum whose constraint force jumps, so that compositions of it "
            "have no higher order: compose dx.LagrangeDAlembert() on the Lagrangian, or dx.DiscreteDirac()."
        )
    return scheme


def _checked(system: Any, scheme: str) -> HamiltonDirac:
    found = system.hamiltonian_form()
    if found is None:
        raise TypeError(
            f"dx.{scheme} steps a dx.HamiltonDirac, but a {type(system).__name__} was given: state H(q, p) and W(q) as one, or "
            "take dx.PlusLagrangeDirac or dx.MinusLagrangeDirac for a Lagrangian."
        )
    return found


@dataclass(frozen=True, eq=False)
class PhaseSpaceStep(AbstractStep):
    """A step in x = (q, p) of a Hamiltonian on T*Q."""

    system: HamiltonDirac
    shape: Shape

    @property
    def n(self) -> int:
        """Coordinates of Q."""
        return self.shape.n // 2

    @property
    def state(self) -> Layout:
        return Layout(q=self.n, p=self.n)


@dataclass(frozen=True, eq=False)
class HamiltonDiracStep(PhaseSpaceStep):
    """One step in (q, p); unknowns are the velocity Δq/h, the momentum at which dH is taken, and μ."""

    plus: bool

    @property
    def rows(self) -> ConstraintRows:
        """The constraints without the redundant ones."""
        return ConstraintRows(self.system, self.shape)

    @property
    def unknowns(self) -> Layout:
        return Layout(v=self.n, p=self.n, mu=self.rows.count)

    @property
    def fields(self) -> dict[str, Field]:
        return {"q": Field((self.n,)), "p": Field((self.n,)), **self.rows.fields()}

    @property
    def labels(self) -> tuple[str, ...]:
        velocity, balance = ([f"{name} {i}" for i in range(self.n)] for name in ("velocity", "momentum balance"))
        return (*velocity, *balance, *self.rows.labels())

    @property
    def canonical(self) -> bool:
        return True

    def start(self, data, h, params):
        return self.state.join(q=data["q"], p=data["p"]), self.unknowns.join(v=data["v"], p=data["p"])

    def residual(self, u, state, t, h, params):
        (q, p), (v, at_p, mu) = self.state.split(state), self.unknowns.split(u)
        end = q + h * v
        time, point = (t, q) if self.plus else (t + h, end)
        of_q, of_p = self.system.slopes(time, point, at_p, params)
        # the (+) step ends at the momentum of dH, the (−) step begins there
        balance = at_p - p + (h * of_q if self.plus else 0.0)
        if not self.rows.count:
            return jnp.concatenate([v - of_p, balance])
        balance = balance + self.rows.matrix(t, q, params).T @ mu
        return jnp.concatenate([v - of_p, balance, self.rows.pick(self._constraint(t, q, v, h, params))])

    def advance(self, u, state, t, h, params):
        q, (v, p, _) = self.state.split(state).q, self.unknowns.split(u)
        end = q + h * v
        return self.state.join(q=end, p=p if self.plus else p - h * self.system.slopes(t + h, end, p, params)[0])

    def unpack(self, state, u, t, h, params):
        (q, p), (v, _, mu) = self.state.split(state), self.unknowns.split(u)
        row = {"q": q, "p": p}
        if self.shape.m:
            row |= {"multipliers": self.rows.all(mu), "constraint": self._constraint(t, q, v, h, params)}
        return row

    def _constraint(self, t, q, v, h, params):
        """All m of W Δq/h, at the new or at the old point."""
        time, point = (t + h, q + h * v) if self.plus else (t, q)
        return self.system.constraints.one_forms_at(time, point, params) @ v
