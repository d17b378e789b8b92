"""Step densities: how many steps a unit of time needs at a place, from the system alone."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from dirax.numerics.arrays import Numbers
from dirax.program.linear_solves import solve
from dirax.program.tracing import along, gradient, jacobian


@dataclass(frozen=True, eq=False)
class LocalFrequency:
    """The frequency with which neighbouring motions swing about each other: √‖∂a/∂q‖ of the acceleration a(q) from rest,
    without the forces of constraints, by the Frobenius norm of the metric ∂²L/∂v²; √‖S‖ of a system ẋ = f(x) with
    S = (∂f/∂x)², ‖S‖² = Σ |S_ij S_ji|. Neither depends on the units of coordinates."""

    system: Any
    lagrangian: Any
    """Its `lagrangian_form`, None where the places are points x."""

    def at(self, t: Any, place: Numbers, params: Any) -> Any:
        """ρ(t, q) or ρ(t, x)."""
        if self.lagrangian is not None:
            slope, mass = jacobian(lambda q: self._acceleration(t, q, params))(place), self._mass(t, place, params)
            size = jnp.sum(slope * (mass @ solve(mass, slope.T).T))  # tr(M⁻¹ AᵀM A), M symmetric
        else:
            rate = jacobian(lambda x: self.system.velocity_at({"x": x, "t": t}, params))(place)
            slope = rate @ rate
            size = jnp.sum(jnp.abs(slope * slope.T))
        return jnp.abs(size) ** 0.25

    def _mass(self, t: Any, q: Numbers, params: Any) -> Numbers:
        """∂²L/∂v² at rest."""
        return jacobian(lambda v: self.lagrangian.legendre(q, v, params, t))(jnp.zeros_like(q))

    def _acceleration(self, t: Any, q: Numbers, params: Any) -> Numbers:
        """∂²L/∂v² a = ∂L/∂q + f − ∂²L/∂t∂v at v = 0."""
        form, rest = self.lagrangian, jnp.zeros_like(q)
        force = gradient(lambda q: form.lagrangian.at(t, q, rest, params))(q)
        if (own := form.forces_at(None)) is not None and not form.forces_see_multipliers:
            force = force + own(t, q, rest, params)
        if form.lagrangian.takes_time:
            force = force - along(lambda t: form.legendre(q, rest, params, t), (jnp.asarray(t, float),), (jnp.ones(()),))
        return solve(self._mass(t, q, params), force)
