"""Group actions on configuration spaces, their generators, lifts and momentum maps ([RL] §2)."""

from abc import abstractmethod
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.numerics.tolerances import ACTION_DEFECT
from dirax.program.linear_solves import solve
from dirax.program.user_functions import UserFunction, evaluated
from dirax.reduction.connection import check_fibre, fibre_indices


class AbstractAction(eqx.Module):
    """A Lie group acting on Q ⊂ R^n, in coordinates g (k,) of the group in which 0 is the identity: Φ_0 = id, and
    t ↦ Φ_{tξ} is the flow of a generator ξ_Q for every ξ (k,).

    In `Translations` and `GroupAction` the group is abelian, Φ_{g+h} = Φ_g ∘ Φ_h; in `LeftTranslation` g is an algebra vector
    of any Lie group, and Φ_g the translation by exp(g).
    """

    @abstractmethod
    def dimension(self) -> int:
        """k."""

    @abstractmethod
    def check(self, q: Float[Array, " n"]) -> None:
        """Raise `ValueError` where it does not act on points like q."""

    @abstractmethod
    def __call__(self, g: Float[Array, " k"], q: Float[Array, " n"]) -> Float[Array, " n"]:
        """Φ_g(q)."""

    def generator(self, xi: Float[Array, " k"], q: Float[Array, " n"]) -> Float[Array, " n"]:
        """The infinitesimal generator ξ_Q(q) = d/dε Φ_{εξ}(q) at ε = 0."""
        return jax.jvp(lambda g: self(g, q), (jnp.zeros_like(xi),), (xi,))[1]

    def tangent_lift(self, g: Float[Array, " k"], q: Float[Array, " n"], v: Float[Array, " n"]) -> tuple[Array, Array]:
        """TΦ_g(q, v)."""
        return jax.jvp(lambda q: self(g, q), (q,), (v,))

    def cotangent_lift(self, g: Float[Array, " k"], q: Float[Array, " n"], p: Float[Array, " n"]) -> tuple[Array, Array]:
        """(Φ_g(q), (D Φ_g(q))^{−T} p): the pairing with lifted velocities stays the same."""
        derivative = jax.jacfwd(lambda q: self(g, q))(q)
        return self(g, q), solve(derivative.T, p)

    def momentum_map(self, q: Float[Array, " n"], p: Float[Array, " n"]) -> Float[Array, " k"]:
        """J(q, p), with ⟨J, ξ⟩ = ⟨p, ξ_Q(q)⟩."""
        return jax.vjp(lambda g: self(g, q), jnp.zeros(self.dimension()))[1](p)[0]


class Translations(AbstractAction):
    """The abelian action by addition to the coordinates `fibre` of q: a vector subgroup, or a torus where they are angles."""

    fibre: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, fibre: Sequence[int]):
        self.fibre = fibre_indices(fibre)

    def dimension(self) -> int:
        """k."""
        return len(self.fibre)

    def check(self, q: Float[Array, " n"]) -> None:
        """Raise `ValueError` for an index that q does not have."""
        check_fibre(self.fibre, q.shape[-1])

    def __call__(self, g: Float[Array, " k"], q: Float[Array, " n"]) -> Float[Array, " n"]:
        """q with g added in the fibre."""
        return jnp.asarray(q).at[np.array(self.fibre)].add(g)


BESIDE = 2.0**-4
"""How far beside a point an action is looked at, relative to its coordinates."""


class GroupAction(AbstractAction):
    """An abelian action, of R^k or a torus, by a function `action(g, q) -> (n,)`, g of shape (k,).

    That Φ_0 is the identity and Φ_{g+h} = Φ_g ∘ Φ_h is checked at random g as soon as a point is known, there and beside it;
    `ValueError` tells the defect.

        turn = dx.GroupAction(lambda g, q: jnp.array([[jnp.cos(g[0]), -jnp.sin(g[0])], [jnp.sin(g[0]), jnp.cos(g[0])]]) @ q, 1)
    """

    action: UserFunction
    size: int = eqx.field(static=True)

    def __init__(self, action: Callable, dimension: int):
        self.action, self.size = UserFunction(action, "action", ("g", "q")), int(dimension)

    def dimension(self) -> int:
        """k."""
        return self.size

    def __call__(self, g: Float[Array, " k"], q: Float[Array, " n"]) -> Float[Array, " n"]:
        """action(g, q)."""
        return self.action(g, q, None)

    def check(self, q: Float[Array, " n"]) -> None:
        """Raise `ValueError` where the function is no action of an abelian group at q, or near it: a fixed point shows no law."""
        random, act = np.random.default_rng(0), lambda g, q: np.asarray(evaluated(self.__call__, g, np.asarray(q)))
        shape = self.action.shape(jnp.zeros(self.size), q, None).shape
        if shape != q.shape:
            raise ValueError(f"action(g, q) must return a point like q, of shape {q.shape}, but it returned shape {shape}.")
        g, h = random.normal(size=(2, self.size))
        here = np.asarray(q, float)
        away = BESIDE * (float(np.max(np.abs(here))) or 1.0) * random.uniform(-1.0, 1.0, here.shape)
        beside = act(0 * g, here + away)  # on the manifold, where the action is one of points of a manifold
        for point in (here, beside):
            for law, found, wanted in (
                ("action(0, q) = q", act(0 * g, point), point),
                ("action(g + h, q) = action(g, action(h, q))", act(g + h, point), act(g, act(h, point))),
            ):
                defect = float(np.max(np.abs(found - wanted)))
                if point is beside and not np.isfinite(defect):
                    continue
                if not defect <= ACTION_DEFECT * (1 + float(np.max(np.abs(wanted)))):
                    raise ValueError(
                        f"the function is no action of an abelian group: {law} fails by {defect:.3g} at q = {point}."
                    )
