"""One step of the discrete Euler–Poincaré, Lie–Poisson and Suslov equations."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.geometry.group_retractions import coadjoint, pulled_back, retraction
from dirax.program.tracing import once
from dirax.schemes.abstract_step import AbstractStep
from dirax.schemes.layout import Layout
from dirax.schemes.step import Field


class Motion(NamedTuple):
    """A step of the group, without the forces of constraints: f = τ(hξ), a at its end, ν, the torques J of the potential at both
    ends, and what is left of ξ = ∂h/∂μ for a Lie–Poisson system."""

    f: Array
    after: Array
    nu: Float[Array, " d"]
    torque: Float[Array, " d"]
    next_torque: Float[Array, " d"]
    defect: Array


class Stepped(NamedTuple):
    """The momentum m that leaves the first node, the one that arrives at the second, and the motion between them."""

    leaving: Float[Array, " d"]
    arriving: Float[Array, " d"]
    motion: Motion


@dataclass(frozen=True, eq=False)
class EulerPoincareStep(AbstractStep):
    """(dτ_{hξ})*m = ν with m = μ_k + (h/2)(Aᵀλ − J), and the constraints of `DiscreteEulerPoincare`.

    State (μ, a, g) and the impulse (h/2)λ' of the step before; unknowns ξ, of a Lie–Poisson system also ν, with `m`
    constraints also λ, and at the end of the step its velocity ξ' and λ'. `system` is a `dx.EulerPoincare` or `dx.LiePoisson`.
    """

    system: Any
    m: int
    map: str

    @property
    def hamiltonian(self) -> bool:
        """Whether the system is stated by h(μ, a), not l(ξ, a)."""
        return self.system.stated_by_momenta

    @cached_property
    def tau(self) -> Callable:
        """The retraction τ of the Lie algebra to the group."""
        return retraction(self.system.space.group, self.map)

    @property
    def state(self) -> Layout:
        space = self.system.space
        d, n = space.dimension, space.size
        return Layout(mu=d, a=n - d, g=space.group.ambient_dimension, impulse=self.m)

    @property
    def unknowns(self) -> Layout:
        d, m = self.system.space.dimension, self.m
        return Layout(xi=d, nu=d if self.hamiltonian else 0, first=m, end=d if m else 0, last=m)

    @property
    def fields(self) -> dict[str, Field]:
        space, m = self.system.space, self.m
        about = "group element g_k, from the identity on unless q= was given"
        fields = {
            "x": Field((space.size,), dims=("component",), description="body momentum μ and advected quantities a"),
            "g": Field((space.group.ambient_dimension,), dims=("group",), description=about),
            "xi": Field((space.dimension,), "step", ("algebra",), "velocity ξ_k of the step, g_k⁻¹g_{k+1} = τ(hξ_k)"),
        }
        if m:
            fields["multipliers"] = Field((m,), "step", ("constraint",), "impulse of the constraints at the node", "sum")
            fields["constraint"] = Field((m,), "step", ("constraint",), "discrete constraint A ξ_k")
        return fields

    @property
    def labels(self) -> tuple[str, ...]:
        d, m = self.system.space.dimension, self.m
        labels = [f"discrete Euler–Poincaré equation {i}, of a step that turns by less than π" for i in range(d)]
        labels += [f"velocity ∂h/∂μ, component {i}" for i in range(d * self.hamiltonian)]
        labels += [f"discrete constraint {r}" for r in range(m)]
        labels += [f"Legendre transform {i} at the end of the step" for i in range(d * bool(m))]
        labels += [f"constraint {r} at the end of the step" for r in range(m)]
        return tuple(labels)

    # ------------------------------------------------------------------------------------------------ the equations

    def motion(self, u, a, h, params) -> Motion:
        """The step of the group with the unknowns u from the advected quantities a."""
        system, space = self.system, self.system.space
        f = self.tau(h * u.xi)
        after = space.carried(f, a)
        at = u.nu if self.hamiltonian else u.xi
        (first, slope), (second, next_slope) = system.slopes(at, a, params), system.slopes(at, after, params)
        mean = (first + second) / 2.0 if space.advected else first
        if self.hamiltonian:
            return Motion(f, after, at, -space.diamond(slope, a), -space.diamond(next_slope, after), u.xi - mean)
        return Motion(f, after, mean, space.diamond(slope, a), space.diamond(next_slope, after), jnp.zeros(0))

    def reaction(self, a, multipliers, params):
        """Aᵀλ."""
        d = self.system.space.dimension
        return self.system.constraint_forms(a, params).T @ multipliers if self.m else jnp.zeros(d)

    @once
    def step(self, u, state, h, params) -> Stepped:
        """The step with the unknowns u."""
        u, state = self.unknowns.split(u), self.state.split(state)
        motion = self.motion(u, state.a, h, params)
        leaving = state.mu + h / 2.0 * (self.reaction(state.a, u.first, params) - motion.torque)
        turned = coadjoint(self.system.space.group, motion.f, leaving)
        arriving = turned + h / 2.0 * (self.reaction(motion.after, u.last, params) - motion.next_torque)
        return Stepped(leaving, arriving, motion)

    def discrete_constraint(self, xi, a, after, params):
        """A ξ, with the mean of A at both ends where it depends on a."""
        forms = self.system.constraint_forms(a, params)
        return (forms + self.system.constraint_forms(after, params)) @ xi / 2.0 if self.system.space.advected else forms @ xi

    def residual(self, u, state, t, h, params):
        leaving, arriving, motion = self.step(u, state, h, params)
        group, u = self.system.space.group, self.unknowns.split(u)
        angle = h * u.xi[group.translations :]
        small = jnp.sum(angle * angle) < np.pi**2
        balance = pulled_back(group, self.tau, h * u.xi, leaving) - motion.nu
        rows = [jnp.where(small, balance, jnp.nan), motion.defect]
        if self.m:
            rows.append(self.discrete_constraint(u.xi, self.state.split(state).a, motion.after, params))
            rows.append(self.system.legendre(u.end, motion.after, params) - arriving)
            rows.append(self.system.constraint_forms(motion.after, params) @ u.end)
        return jnp.concatenate(rows)

    def advance(self, u, state, t, h, params):
        _, arriving, motion = self.step(u, state, h, params)
        group = self.system.space.group
        g = group.nearest(group.multiply(self.state.split(state).g, motion.f))
        return self.state.join(mu=arriving, a=motion.after, g=g, impulse=h / 2.0 * self.unknowns.split(u).last)

    def unpack(self, state, u, t, h, params):
        u, state = self.unknowns.split(u), self.state.split(state)
        saved = {"x": jnp.concatenate([state.mu, state.a]), "g": state.g, "xi": u.xi}
        if self.m:
            saved["multipliers"] = state.impulse + h / 2.0 * u.first
            after = self.system.space.carried(self.tau(h * u.xi), state.a)
            saved["constraint"] = self.discrete_constraint(u.xi, state.a, after, params)
        return saved

    def start(self, data, h, params):
        x, xi, space = data["x"], data["v"], self.system.space
        mu, a = x[: space.dimension], x[space.dimension :]
        first = {"xi": xi} | ({"nu": mu} if self.hamiltonian else {}) | ({"end": xi} if self.m else {})
        return self.state.join(mu=mu, a=a, g=data.get("g", space.group.identity())), self.unknowns.join(**first)
