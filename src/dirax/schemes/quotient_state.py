"""The state (x, w, μ, g) of a run on the quotient by an abelian symmetry."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.reduction.connection import AbstractConnection, LinearConnection
from dirax.schemes.layout import Layout
from dirax.schemes.step import Field


class Quotient:
    """The state (x, w, μ, g) on Σ × G × g*: shape, its trivialized momentum, momentum map, group coordinate.

    `k` group coordinates and `s` = n − k of the shape; a step has the velocity ẋ and the vertical part ω_d = hγ.
    """

    def __init__(self, connection: AbstractConnection, n: int):
        self.connection, self.k = connection, len(connection.fibre)
        self.s = n - self.k

    @property
    def state(self) -> Layout:
        """The parts of the state."""
        return Layout(x=self.s, w=self.s, mu=self.k, g=self.k)

    def group_rate(self, x, rate, vertical, h) -> Float[Array, " k"]:
        """ġ = (g1 − g0)/h = γ + h⁰_d(x, x + hẋ)/h."""
        connection = self.connection
        if isinstance(connection, LinearConnection):
            return vertical if connection.horizontal is None else vertical + connection.matrix_at(x) @ rate
        return vertical + connection.lift_of_shapes(x, x + h * rate) / h

    def vertical(self, x, rate, along, h) -> Float[Array, " k"]:
        """γ of a step with group velocity ġ."""
        return along - self.group_rate(x, rate, jnp.zeros(self.k), h)

    def fields(self) -> dict[str, Field]:
        """What is saved of a run on the quotient."""
        s, k = self.s, self.k
        return {
            "x": Field((s,), dims=("shape",)),
            "w": Field((s,), dims=("shape",), description="momentum of the shape, w + h*_{d,Σ}(μ)"),
            "mu": Field((k,), dims=("group",), description="momentum map"),
            "g": Field((k,), dims=("group",), description="group coordinate, by reconstruction"),
            "vertical": Field((k,), "step", ("group",), "discrete connection ω_d(q_k, q_{k+1})", "sum"),
        }
