"""The constraints of a Lagrangian system: W(t, q) q̇ + b(t, q) = 0 and g(t, q) = 0, which may depend on each other."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dirax.numerics.arrays import Data, Numbers
from dirax.program.linear_solves import scaled_pseudo_inverse
from dirax.program.roots import nearest_root
from dirax.program.rounding import rounding, sizes_of_terms
from dirax.program.tracing import along, jacobian
from dirax.program.user_functions import UserFunction

LARGEST = 2**18
"""Entries of a matrix of the constraints up to which the sizes of their terms are found from it."""


def no_constraint() -> Float[Numbers, "0"]:
    """The value of the constraints of a system without any."""
    return jnp.zeros((0,))


class Constraints(eqx.Module):
    """Nonholonomic constraints W q̇ + b = 0 (m of them) and holonomic ones g = 0 (c of them), at one point at a time.

    Together they are the affine constraints [W; G] q̇ + [b; ∂g/∂t] = 0 with G = ∂g/∂q, whose linear part has the kernel
    Δ = ker W ∩ ker G: the distribution of the Dirac structure of the system.
    """

    one_forms: UserFunction | None
    affine: UserFunction | None
    holonomic: UserFunction | None

    @classmethod
    def of(cls, one_forms: Callable | None, affine: Callable | None, holonomic: Callable | None) -> "Constraints":
        """The constraints of a user's functions; raises `ValueError` for `affine` without `one_forms`."""
        if affine is not None and one_forms is None:
            raise ValueError("affine is the b(q) of W(q) q̇ + b(q) = 0, but no one_forms were given: give W(q) too.")
        named = {"one_forms": one_forms, "affine": affine, "holonomic": holonomic}
        return cls(*(None if f is None else UserFunction(f, name, ("q",), timed=True) for name, f in named.items()))

    @property
    def names(self) -> str:
        """The names of the functions that are there, for messages."""
        named = {"one_forms": self.one_forms, "affine": self.affine, "holonomic": self.holonomic}
        return " or ".join(name for name, function in named.items() if function is not None)

    @property
    def any(self) -> bool:
        """Whether there are constraints."""
        return self.one_forms is not None or self.holonomic is not None

    def sizes(self, q: Float[Numbers, " n"], params: Any) -> tuple[int, int]:
        """(m, c); raises `ValueError` where a function returns a wrong shape."""
        n, t = q.shape[0], np.zeros(())
        m = c = 0
        if self.one_forms is not None:
            out = self.one_forms.shape(*self.one_forms.given(t, q, params))
            if len(out.shape) != 2 or out.shape[1] != n or out.shape[0] > n:
                raise ValueError(
                    f"one_forms(q) must return an array of shape (m, n) = (m, {n}) with m ≤ {n}, one row a one-form, but it "
                    f"returned shape {out.shape}{': put it in another pair of brackets' if len(out.shape) == 1 else ''}."
                )
            m = out.shape[0]
        if self.affine is not None:
            out = self.affine.shape(*self.affine.given(t, q, params))
            if out.shape != (m,):
                raise ValueError(
                    f"affine(q) must return shape ({m},), one number a row of W(q) of shape ({m}, {n}), but it returned "
                    f"shape {out.shape}."
                )
        if self.holonomic is not None:
            out = self.holonomic.shape(*self.holonomic.given(t, q, params))
            if len(out.shape) != 1 or not out.shape[0]:
                hint = ": put it in a pair of brackets" if out.shape == () else ""
                hint = ": leave holonomic out where there are none" if out.shape == (0,) else hint
                raise ValueError(
                    f"holonomic({', '.join(self.holonomic.arguments)}) must return an array of shape (c,), one number a "
                    f"constraint g = 0, but it returned shape {out.shape}{hint}."
                )
            c = out.shape[0]
        return m, c

    def one_forms_at(self, t: Any, q: Float[Numbers, " n"], params: Any) -> Float[Numbers, "m n"]:
        """W(t, q)."""
        return jnp.zeros((0, q.shape[0])) if self.one_forms is None else self.one_forms.at(t, q, params)

    def holonomic_matrix(self, t: Any, q: Float[Numbers, " n"], params: Any) -> Float[Numbers, "c n"]:
        """G(t, q) = ∂g/∂q."""
        if self.holonomic is None:
            return jnp.zeros((0, q.shape[0]))
        return jacobian(lambda q: self.position_defect(t, q, params), reverse=True)(q)

    def matrix(self, t: Any, q: Float[Numbers, " n"], params: Any) -> Float[Numbers, "k n"]:
        """[W; G], the one-forms that vanish on Δ."""
        w = self.one_forms_at(t, q, params)
        return w if self.holonomic is None else jnp.concatenate([w, self.holonomic_matrix(t, q, params)])

    def position_defect(self, t: Any, q: Float[Numbers, " n"], params: Any) -> Float[Numbers, " c"]:
        """g(t, q)."""
        return no_constraint() if self.holonomic is None else self.holonomic.at(t, q, params)

    def nonholonomic_defect(self, t: Any, q: Float[Numbers, " n"], v: Float[Numbers, " n"], params: Any) -> Float[Numbers, " m"]:
        """W v + b."""
        rate = self.one_forms_at(t, q, params) @ v
        return rate if self.affine is None else rate + self.affine.at(t, q, params)

    def hidden_defect(self, t: Any, q: Float[Numbers, " n"], v: Float[Numbers, " n"], params: Any) -> Float[Numbers, " c"]:
        """G v + ∂g/∂t, the rate of change of g."""
        if self.holonomic is None:
            return no_constraint()
        g = lambda t, q: self.position_defect(t, q, params)
        if self.holonomic.takes_time:
            return along(g, (jnp.asarray(t, float), q), (jnp.ones(()), v))
        return along(lambda q: g(t, q), (q,), (v,))

    def velocity_defect(self, t: Any, q: Float[Numbers, " n"], v: Float[Numbers, " n"], params: Any) -> Float[Numbers, " k"]:
        """(W v + b, G v + ∂g/∂t)."""
        first = self.nonholonomic_defect(t, q, v, params)
        return first if self.holonomic is None else jnp.concatenate([first, self.hidden_defect(t, q, v, params)])

    def defect(self, t: Any, q: Float[Numbers, " n"], v: Float[Numbers, " n"], params: Any) -> Float[Numbers, " k"]:
        """(W v + b, g, G v + ∂g/∂t)."""
        first = self.nonholonomic_defect(t, q, v, params)
        if self.holonomic is None:
            return first
        return jnp.concatenate([first, self.position_defect(t, q, params), self.hidden_defect(t, q, v, params)])

    def terms(
        self,
        t: Any,
        q: Float[Numbers, " n"],
        v: Float[Numbers, " n"],
        speed: Float[Numbers, " n"],
        params: Any,
        size: Float[Numbers, " n"] | None = None,
    ) -> Float[Numbers, " k"]:
        """The sizes of the terms of `defect` at velocities as large as |v| + `speed`: a coordinate that does not move, of a
        system that does, misses its constraint by a rounding of how fast it could, and one that is zero by one of its `size`."""
        at = jnp.asarray(t, float)
        fastest, w = jnp.abs(v) + speed, self.one_forms_at(t, q, params)
        first = jnp.abs(w) @ fastest
        if self.affine is not None:
            first = first + jnp.abs(self.affine.at(t, q, params))
        if self.holonomic is None:
            return first
        position = rounding(lambda t, q: self.position_defect(t, q, params), at, q)
        moved = jnp.abs(self.hidden_defect(t, q, jnp.zeros_like(v), params))
        rows = jnp.abs(self.holonomic_matrix(t, q, params))
        position = position if size is None else position + rows @ size
        return jnp.concatenate([first, position, rows @ fastest + moved])

    def initial_terms(self, data: Data, params: Any, terms: Callable) -> Float[Numbers, " k"]:
        """The sizes of the terms of `defect` at initial data q, v, by `terms`(t, q, v, params); of two points q0, q1 with the
        velocity v between them those of g(q0), and of the constraints (W v + b, g) of their step."""
        t, v = data.get("t", 0.0), data["v"]
        if jax.eval_shape(lambda: self.defect(t, v, v, params)).size * v.size > LARGEST:
            terms = self._terms_of_many
        if "q0" not in data:
            return terms(t, data["q"], v, params)
        first, step = (terms(t, data[q], v, params) for q in ("q0", "q1"))
        m, c = self.sizes(v, params)
        return jnp.concatenate([first[m : m + c], step[: m + c]])

    def _terms_of_many(self, t, q, v, params):
        """The same of many coordinates, which count as moving as fast as the fastest of them."""
        fastest = jnp.broadcast_to(jnp.max(jnp.abs(v)), v.shape)
        return sizes_of_terms(lambda q, v: self.defect(t, q, v, params), q, v, errors=(jnp.abs(q), fastest))

    def nearest_velocity(
        self, t: Any, q: Float[Numbers, " n"], v: Float[Numbers, " n"], lifted: Float[Numbers, "n k"], params: Any
    ) -> Float[Numbers, " n"]:
        """The velocity with W v + b = 0 and G v + ∂g/∂t = 0 that differs from v by a combination of the columns of `lifted`."""
        inverse = scaled_pseudo_inverse(self.matrix(t, q, params) @ lifted)
        return v - lifted @ (inverse @ self.velocity_defect(t, q, v, params))

    def nearest_position(
        self, t: Any, q: Float[Numbers, " n"], lifted: Float[Numbers, "n c"], params: Any
    ) -> Float[Numbers, " n"]:
        """The point with g = 0 near q that differs from q by a combination of the columns of `lifted`."""
        g = lambda s: self.position_defect(t, q + lifted @ s, params)
        return q + lifted @ nearest_root(g, jnp.zeros(lifted.shape[1]))
