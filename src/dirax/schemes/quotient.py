"""Discrete Lagrangians on the quotient by an abelian symmetry, their slot derivatives, and the state of a run there."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.functions import UserFunction
from dirax.reduction.connection import AbstractConnection, LinearConnection
from dirax.reduction.reduced import ReducedLagrangeDirac
from dirax.schemes.discrete_lagrangian import discrete_lagrangian
from dirax.schemes.step import Field

NODES = {"left": ((0.0, 1.0),), "right": ((1.0, 1.0),), "midpoint": ((0.5, 1.0),), "trapezoidal": ((0.0, 0.5), (1.0, 0.5))}
"""The quadrature of each rule: (place in the step, weight)."""

Slots = tuple[Float[Array, " n-k"], Float[Array, " n-k"], Float[Array, " k"]]


class Quotient:
    """The discrete Lagrangian l_{d±} on Σ × Σ × G ([RL] (4.5), (4.7)) and the layout (x, w, μ, g) of a state.

    A step from x to x + hẋ with the vertical part ω_d = hγ has the arguments (t, x, ẋ, γ); t is the time at its start.
    (+) starts at (x, 0): l_{d+} = L_d((x0, 0), (x1, g1 + h⁰_d(x0, x1))); (−) ends at group coordinate 0.
    """

    def __init__(self, system: ReducedLagrangeDirac, n: int, rule: str | UserFunction, sign: int = +1):
        self.system, self.n, self.rule, self.sign = system, n, rule, sign
        self.connection: AbstractConnection = system.connection
        self.k = len(self.connection.fibre)
        self.s = n - self.k
        self._lagrangian = system.system.lagrangian
        self._discrete = discrete_lagrangian(self._lagrangian, rule)

    # ------------------------------------------------------------------ the discrete Lagrangian and its derivatives

    def discrete_lagrangian(self, t: Any, x, rate, vertical, h, params) -> Float[Array, ""]:
        """l_{d±}."""
        along = self.group_rate(x, rate, vertical, h)
        group = jnp.zeros_like(vertical) if self.sign > 0 else -h * along
        return self._discrete(t, self.connection.join(x, group), self.connection.join(rate, along), h, params)

    def slots(self, t: Any, x, rate, vertical, h, params) -> Slots:
        """(−w_k, w_{k+1}, μ) from the derivatives of l: (∂l/∂x0, ∂l/∂x1, ∂l/∂g1) for linear h_d."""
        if self._by_quadrature:
            return self._quadrature_slots(t, x, rate, vertical, h, params)
        dx, drate, dvertical = jax.grad(self.discrete_lagrangian, argnums=(1, 2, 3))(t, x, rate, vertical, h, params)
        d0, d1, mu = dx - drate / h, drate / h, dvertical / h
        if isinstance(self.connection, LinearConnection):
            return d0, d1, mu
        # the terms with h⁰_d of (4.6) do not cancel those with A(x) = D2 h⁰_d(x, x) of the trivialization
        x1, matrix_at = x + h * rate, self.connection.matrix_at
        lift0, lift1 = jax.jacfwd(self.connection.lift_of_shapes, argnums=(0, 1))(x, x1)
        return d0 - mu @ (lift0 + matrix_at(x)), d1 + mu @ (matrix_at(x1) - lift1), mu

    def momentum(self, t: Any, x, rate, vertical, h, params) -> Float[Array, " k"]:
        """∂l/∂g1, which is μ."""
        if not self._by_quadrature:
            return jax.grad(self.discrete_lagrangian, argnums=3)(t, x, rate, vertical, h, params) / h
        slope = jax.grad(self._reduced_lagrangian, argnums=3)
        nodes = NODES[self.rule]
        parts = [slope(*self._at(place, t, x, rate, h), rate, vertical, params) for place, _ in nodes]
        return parts[0] if len(parts) == 1 else sum(b * part for (_, b), part in zip(nodes, parts, strict=True))

    @property
    def _by_quadrature(self) -> bool:
        """Whether l is a sum of values of L that the group coordinate does not enter."""
        return isinstance(self.connection, LinearConnection) and not isinstance(self.rule, UserFunction)

    def _reduced_lagrangian(self, t: Any, x, rate, vertical, params) -> Float[Array, ""]:
        """L((x, 0), (ẋ, γ + Aẋ))."""
        group = self.group_rate(x, rate, vertical, None)
        return self._lagrangian.at(
            t, self.connection.join(x, jnp.zeros_like(vertical)), self.connection.join(rate, group), params
        )

    def _at(self, place: float, t: Any, x, rate, h) -> tuple[Any, Array]:
        return (t, x) if place == 0.0 else (t + place * h, x + place * h * rate)

    def _quadrature_slots(self, t: Any, x, rate, vertical, h, params) -> Slots:
        """The same with the derivatives of L taken at the nodes, which is less work."""
        slope, total = jax.grad(self._reduced_lagrangian, argnums=(1, 2, 3)), None
        for place, weight in NODES[self.rule]:
            dx, drate, mu = slope(*self._at(place, t, x, rate, h), rate, vertical, params)
            if weight != 1.0:
                dx, drate, mu = weight * dx, weight * drate, weight * mu
            here = (1.0 - place) * h * dx - drate, place * h * dx + drate, mu
            total = here if total is None else tuple(a + b for a, b in zip(total, here, strict=True))
        assert total is not None
        return total

    # ------------------------------------------------------------------ the state

    def group_rate(self, x, rate, vertical, h) -> Float[Array, " k"]:
        """ġ = (g1 − g0)/h = γ + h⁰_d(x, x + hẋ)/h."""
        if isinstance(self.connection, LinearConnection):
            return vertical if self.connection.horizontal is None else vertical + self.connection.matrix_at(x) @ rate
        return vertical + self.connection.lift_of_shapes(x, x + h * rate) / h

    def split(self, state: Float[Array, " state"]) -> tuple[Array, Array, Array, Array]:
        """x, w, μ, g."""
        s, k = self.s, self.k
        return state[:s], state[s : 2 * s], state[2 * s : 2 * s + k], state[2 * s + k : 2 * s + 2 * k]

    def start(self, data: dict[str, Array], h, params) -> tuple[Float[Array, " 2n"], Float[Array, " n"]]:
        """The first state and the first guess of (ẋ, γ)."""
        connection, t = self.connection, data.get("t", 0.0)
        if "q0" in data:
            (x0, g0), (x1, g1) = connection.split(data["q0"]), connection.split(data["q1"])
            rate = (x1 - x0) / h
            vertical = (g1 - g0) / h - self.group_rate(x0, rate, jnp.zeros(self.k), h)
            d0, _, mu = self.slots(t, x0, rate, vertical, h, params)
            return jnp.concatenate([x0, -d0, mu, g0]), jnp.concatenate([rate, vertical])
        (x, g), (rate, along) = connection.split(data["q"]), connection.split(data["v"])
        _, w, mu = connection.trivialize_covector(data["q"], data["p"])
        return jnp.concatenate([x, w, mu, g]), jnp.concatenate([rate, along - connection.matrix_at(x) @ rate])

    def fields(self) -> dict[str, Field]:
        """What is saved of a run on the quotient."""
        s, k = self.s, self.k
        return {
            "x": Field((s,), dims=("shape",)),
            "w": Field((s,), dims=("shape",), description="momentum of the shape, w + h*_{d,Σ}(μ)"),
            "mu": Field((k,), dims=("group",), description="momentum map"),
            "g": Field((k,), dims=("group",), description="group coordinate, by reconstruction"),
            "vertical": Field((k,), "step", ("group",), "discrete connection ω_d(q_k, q_{k+1})"),
        }
