"""Products of manifolds."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from dirax.geometry.manifolds import AbstractGeodesicManifold, Vector
from dirax.geometry.squared_angles import norm
from dirax.program.tracing import once


class Product(AbstractGeodesicManifold):
    """The product M1 × M2 × …, its ambient coordinates, vectors and metric joined in this order.

    Raises `TypeError` for a factor that is not a geodesic manifold.
    """

    factors: tuple[AbstractGeodesicManifold, ...]
    dimension: int = eqx.field(static=True)
    ambient_dimension: int = eqx.field(static=True)

    def __init__(self, *factors: AbstractGeodesicManifold):
        for factor in factors:
            if not isinstance(factor, AbstractGeodesicManifold):
                raise TypeError(f"The factors of Product must be manifolds such as Sphere(3), but {factor!r} came.")
        flat = [factor.factors if isinstance(factor, Product) else (factor,) for factor in factors]
        self.factors = tuple(factor for group in flat for factor in group)
        self.dimension = sum(factor.dimension for factor in factors)
        self.ambient_dimension = sum(factor.ambient_dimension for factor in factors)

    def split(self, x: Vector) -> list[Array]:
        """The ambient blocks of x, one a factor."""
        return jnp.split(x, np.cumsum([factor.ambient_dimension for factor in self.factors])[:-1].tolist())

    def _blocks(self, method: str, *arguments):
        """The method of every factor on its blocks; factors that are equal are traced once where that can be."""
        rows = zip(self.factors, *(self.split(argument) for argument in arguments), strict=True)
        return [once(getattr(type(factor), method), factor)(*blocks) for factor, *blocks in rows]

    def defect(self, x):
        """The largest of the factors."""
        return jnp.max(jnp.stack(self._blocks("defect", x)))

    def nearest(self, x):
        """That of each factor."""
        return jnp.concatenate(self._blocks("nearest", x))

    def projection(self, x, v):
        """That of each factor."""
        return jnp.concatenate(self._blocks("projection", x, v))

    def representative(self, x, near):
        """That of each factor."""
        return jnp.concatenate(self._blocks("representative", x, near))

    def local_parametrization(self, x):
        """That of each factor, r in blocks of their dimensions."""
        maps = [factor.local_parametrization(block) for factor, block in zip(self.factors, self.split(x), strict=True)]
        ends = np.cumsum([factor.dimension for factor in self.factors])[:-1].tolist()
        return lambda r: jnp.concatenate([f(block) for f, block in zip(maps, jnp.split(r, ends), strict=True)])

    def frame(self, x):
        """Those of the factors along the diagonal."""
        return jax.scipy.linalg.block_diag(*self._blocks("frame", x))

    def coordinates(self, x, v):
        """Those of the factors, one after the other."""
        return jnp.concatenate(self._blocks("coordinates", x, v))

    def exp(self, x, v):
        """That of each factor."""
        return jnp.concatenate(self._blocks("exp", x, v))

    def geodesic(self, x, v, t):
        """That of each factor, all at time t."""
        rows = zip(self.factors, self.split(x), self.split(v), strict=True)
        points, velocities = zip(*(once(type(f).geodesic, f)(*blocks, t) for f, *blocks in rows), strict=True)
        return jnp.concatenate(points), jnp.concatenate(velocities)

    def log(self, x, y):
        """That of each factor."""
        return jnp.concatenate(self._blocks("log", x, y))

    def distance(self, x, y):
        """The root of the sum of the squares of the factors’ distances."""
        return norm(jnp.stack(self._blocks("distance", x, y)))

    def transport(self, x, v, y):
        """That of each factor."""
        return jnp.concatenate(self._blocks("transport", x, v, y))

    def retraction(self, x, v):
        """That of each factor."""
        return jnp.concatenate(self._blocks("retraction", x, v))

    def inverse_retraction(self, x, y):
        """That of each factor."""
        return jnp.concatenate(self._blocks("inverse_retraction", x, y))

    def exp_reach(self, x, v):
        """The largest of the factors."""
        return jnp.max(jnp.stack(self._blocks("exp_reach", x, v)))

    def retraction_reach(self, x, v):
        """The largest of the factors."""
        return jnp.max(jnp.stack(self._blocks("retraction_reach", x, v)))
