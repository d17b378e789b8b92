"""Lagrangian submanifolds 𝓛 of T*M by Morse families: dH, what a Lagrangian makes on T*Q, and any other ([BLM] §3, §6)."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.geometry.structures import canonical_two_form
from dirax.numerics.arrays import is_whole
from dirax.program.tracing import gradient
from dirax.program.user_functions import UserFunction, evaluated


class LagrangianSubmanifold(eqx.Module):
    """𝓛 = {(x, ∂F/∂x(x, s)) : ∂F/∂s(x, s) = 0} ⊂ T*M of a Morse family F(x, s), x (N,) and s (k,).

    F is a Morse family where [∂²F/∂s∂x, ∂²F/∂s∂s] has rank k at the points with ∂F/∂s = 0; every Lagrangian submanifold has
    one around each of its points (Hörmander). Made by

        dx.LagrangianSubmanifold.from_hamiltonian(H)             # the graph of dH, k = 0
        dx.LagrangianSubmanifold.from_lagrangian(L, n)           # (q, ∂L/∂v; −∂L/∂q, v), F = ⟨p, v⟩ − L(q, v), s = v
        dx.LagrangianSubmanifold.from_morse_family(F, k)

    and used by `dx.GeneralizedDiracSystem`. All functions may take a trailing `params`.
    """

    family: UserFunction
    parameters: int = eqx.field(static=True)
    lagrangian: UserFunction | None

    def __init__(self, family: Callable, parameters: int, lagrangian: UserFunction | None = None):
        if not is_whole(parameters) or parameters < 0:
            raise ValueError(f"parameters must be the number k of the entries of s, 0 or more, but {parameters!r} was given.")
        self.family, self.parameters = UserFunction(family, "morse_family", ("x", "s")), int(parameters)
        self.lagrangian = lagrangian

    @classmethod
    def from_hamiltonian(cls, hamiltonian: Callable) -> "LagrangianSubmanifold":
        """The graph {(x, dH(x))} of `hamiltonian(x[, params])`, a scalar."""
        function = UserFunction(hamiltonian, "hamiltonian", ("x",))
        return cls(lambda x, s, params: function(x, params), 0)

    @classmethod
    def from_lagrangian(cls, lagrangian: Callable, n: int) -> "LagrangianSubmanifold":
        """{(q, p; P_q, P_p) : p = ∂L/∂v, P_q = −∂L/∂q, P_p = v} ⊂ T*(T*Q) of `lagrangian(q, v[, params])`, a scalar, singular or
        not, on Q = R^n: the image of its Dirac differential ([BLM] §3)."""
        function = UserFunction(lagrangian, "lagrangian", ("q", "v"))
        return cls(lambda x, s, params: x[n:] @ s - function(x[:n], s, params), n, function)

    @classmethod
    def from_morse_family(cls, family: Callable, parameters: int) -> "LagrangianSubmanifold":
        """That of `family(x, s[, params])`, a scalar, with s of shape (`parameters`,)."""
        return cls(family, parameters)

    def covector(self, x: Float[Array, " N"], s: Float[Array, " k"], params: Any = None) -> Float[Array, " N"]:
        """∂F/∂x(x, s). Raises `ValueError` for another number of parameters s than the family has, as the others do."""
        x, s = self._point(x, s)
        return gradient(lambda x: self.family(x, s, params))(x)

    def defect(self, x: Float[Array, " N"], s: Float[Array, " k"], params: Any = None) -> Float[Array, " k"]:
        """∂F/∂s(x, s): (x, ∂F/∂x) is in 𝓛 where it vanishes."""
        x, s = self._point(x, s)
        return gradient(lambda s: self.family(x, s, params))(s)

    def _point(self, x: Any, s: Any) -> tuple[Array, Array]:
        x, s = jnp.asarray(x, float), jnp.asarray(s, float)
        if s.shape != (self.parameters,):
            raise ValueError(f"s must have shape ({self.parameters},), the parameters of the family, but its shape is {s.shape}.")
        return x, s

    def morse_rank(self, x: Float[Array, " N"], s: Float[Array, " k"], params: Any = None) -> int:
        """The rank of [∂²F/∂s∂x, ∂²F/∂s∂s] at a concrete point, k for a Morse family."""
        if not self.parameters:
            return 0
        return int(jnp.linalg.matrix_rank(self.slopes(*self._point(x, s), params)))

    def slopes(self, x: Float[Array, " N"], s: Float[Array, " k"], params: Any = None) -> Float[Array, "k N+k"]:
        """[∂²F/∂s∂x, ∂²F/∂s∂s]."""
        return jnp.concatenate(jax.jacfwd(lambda x, s: self.defect(x, s, params), argnums=(0, 1))(x, s), axis=1)

    def tangent(self, x: Float[Array, " N"], s: Float[Array, " k"], params: Any = None) -> Float[Array, "two_N N"]:
        """A basis, by columns, of the tangent space of 𝓛 at a point of it: (δx, δα) with δ(∂F/∂s) = 0."""
        x, s = self._point(x, s)
        N = x.shape[0]
        both = lambda z: (jnp.concatenate([z[:N], self.covector(z[:N], z[N:], params)]), self.defect(z[:N], z[N:], params))
        of_point, of_defect = jax.jacfwd(both)(jnp.concatenate([x, s]))
        return of_point @ jnp.linalg.svd(of_defect)[2][self.parameters :].T if self.parameters else of_point

    def lagrangian_defect(self, x: Float[Array, " N"], s: Float[Array, " k"], params: Any = None) -> Float[Array, ""]:
        """The largest value of the canonical two-form of T*M on the basis `tangent`: 0 up to roundoff."""
        return jnp.asarray(evaluated(self._defect, *self._point(x, s), params))

    def _defect(self, x: Array, s: Array, params: Any) -> Array:
        basis = self.tangent(x, s, params)
        return jnp.max(jnp.abs(basis.T @ canonical_two_form(basis.shape[0] // 2) @ basis))
