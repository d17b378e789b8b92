"""The reduced discrete Lagrangian l_{d+} of a symmetric system, and its derivatives ([RL] (4.5))."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.program.user_functions import UserFunction
from dirax.reduction.connection import LinearConnection
from dirax.reduction.reduced import ReducedLagrangeDirac
from dirax.schemes.discrete_lagrangian import discrete_lagrangian
from dirax.schemes.quotient_state import Quotient

NODES = {"left": ((0.0, 1.0),), "right": ((1.0, 1.0),), "midpoint": ((0.5, 1.0),), "trapezoidal": ((0.0, 0.5), (1.0, 0.5))}
"""The quadrature of each rule: (place in the step, weight)."""


class ReducedDiscreteLagrangian:
    """l_{d+}(x0, x1, g1) = L_d((x0, 0), (x1, g1 + h⁰_d(x0, x1))) on Σ × Σ × G, as a function of (t, x, ẋ, γ, h, params):

    x0 = x at time t, x1 = x + hẋ, and the vertical part g1 = ω_d = hγ.
    """

    def __init__(self, system: ReducedLagrangeDirac, n: int, rule: str | UserFunction):
        self.connection = system.connection
        self.nodes = () if isinstance(rule, UserFunction) else NODES[rule]
        self.quotient = Quotient(system.connection, n)
        self._lagrangian = system.system.lagrangian
        self._discrete = discrete_lagrangian(self._lagrangian, rule)

    def __call__(self, t: Any, x, rate, vertical, h, params) -> Float[Array, ""]:
        along = self.quotient.group_rate(x, rate, vertical, h)
        return self._discrete(t, self._point(x), self.connection.join(rate, along), h, params)

    def slots(self, t: Any, x, rate, vertical, h, params) -> tuple[Array, Array]:
        """(−w_k, w_{k+1}): (∂l/∂x0, ∂l/∂x1) for linear h_d."""
        if self._by_quadrature:
            return self._slots_by_quadrature(t, x, rate, vertical, h, params)
        dx, drate, dvertical = jax.grad(self, argnums=(1, 2, 3))(t, x, rate, vertical, h, params)
        d0, d1, mu = dx - drate / h, drate / h, dvertical / h
        if isinstance(self.connection, LinearConnection):
            return d0, d1
        # the terms with h⁰_d of (4.6) do not cancel those with A(x) = D2 h⁰_d(x, x) of the trivialization
        x1, matrix_at = x + h * rate, self.connection.matrix_at
        lift0, lift1 = jax.jacfwd(self.connection.lift_of_shapes, argnums=(0, 1))(x, x1)
        return d0 - mu @ (lift0 + matrix_at(x)), d1 + mu @ (matrix_at(x1) - lift1)

    def momentum(self, t: Any, x, rate, vertical, h, params) -> Float[Array, " k"]:
        """∂l/∂g1, which is μ."""
        if not self._by_quadrature:
            return jax.grad(self, argnums=3)(t, x, rate, vertical, h, params) / h
        total = jnp.zeros(self.quotient.k)
        for place, weight in self.nodes:
            total += weight * self.connection.split(self._slopes(place, t, x, rate, vertical, h, params)[1])[1]
        return total

    def finite(self, t: Any, x, rate, vertical, h, params) -> Array:
        """Whether l is a number: its derivatives can be numbers outside the domain of L too."""
        if not self._by_quadrature:
            return jnp.isfinite(self(t, x, rate, vertical, h, params))
        values = [self._lagrangian.at(*self._node(place, t, x, rate, vertical, h), params) for place, _ in self.nodes]
        return jnp.all(jnp.isfinite(jnp.stack(values)))

    @property
    def _by_quadrature(self) -> bool:
        """Whether l is a sum of values of L that the group coordinate does not enter."""
        return isinstance(self.connection, LinearConnection) and bool(self.nodes)

    def _point(self, x) -> Array:
        """(x, 0)."""
        return self.connection.join(x, jnp.zeros(self.quotient.k))

    def _node(self, place: float, t: Any, x, rate, vertical, h) -> tuple[Any, Array, Array]:
        """The time, point and velocity at a place in the step."""
        velocity = self.connection.join(rate, self.quotient.group_rate(x, rate, vertical, h))
        return (t, self._point(x), velocity) if place == 0.0 else (t + place * h, self._point(x + place * h * rate), velocity)

    def _slopes(self, place: float, t: Any, x, rate, vertical, h, params) -> tuple[Array, Array]:
        """∂L/∂q and ∂L/∂v there; in all coordinates, which XLA makes less of than of derivatives by some of them."""
        time, q, v = self._node(place, t, x, rate, vertical, h)
        return jax.grad(lambda q, v: self._lagrangian.at(time, q, v, params), argnums=(0, 1))(q, v)

    def _slots_by_quadrature(self, t: Any, x, rate, vertical, h, params) -> tuple[Array, Array]:
        """The same from the derivatives of L at the nodes, which is less work."""
        first, last = jnp.zeros(self.quotient.s), jnp.zeros(self.quotient.s)
        for place, weight in self.nodes:
            dq, dv = self._slopes(place, t, x, rate, vertical, h, params)
            along, momentum = self.connection.split(dq)[0], self.connection.trivialize_covector(self._point(x), dv)[1]
            first += weight * ((1.0 - place) * h * along - momentum)
            last += weight * (place * h * along + momentum)
        return first, last
