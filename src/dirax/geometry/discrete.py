"""The three notions of a discrete Dirac structure, each under its own name.

- `FiniteDifferenceDirac` on a manifold and `InducedFiniteDifferenceDirac` on T*Q: the (±)-discrete Dirac structures of
  [PY] §5, in `finite_difference`. Dirac over one of the two points: D = D^⊥.
- `GeneratingFunctionDirac`: types 2 and 3 of [RL] §2.3, in `generating_functions`. Symplectic maps, not Dirac pointwise.
- `DiscretizationMapDirac`: [BLM] Definition 5.1, here. A Dirac structure seen through a discretization map.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from dirax.geometry.finite_difference import FiniteDifferenceDirac, InducedFiniteDifferenceDirac
from dirax.geometry.generating_functions import GeneratingFunctionDirac
from dirax.geometry.linear import LinearDirac
from dirax.geometry.maps import AbstractDiscretizationMap
from dirax.geometry.structures import DiracStructure
from dirax.geometry.subspaces import AnyArray
from dirax.numerics.tolerances import STRUCTURE_DEFECT

__all__ = [
    "DiscretizationMapDirac",
    "FiniteDifferenceDirac",
    "GeneratingFunctionDirac",
    "InducedFiniteDifferenceDirac",
]

Vector = Float[Array, " N"]
Covector = Float[Array, " N"]


class DiscretizationMapDirac(eqx.Module):
    """The discrete Dirac structure of a Dirac structure D and a discretization map R_d ([BLM] Definition 5.1):

        D_d = {((x0, x1), α) : (R_d⁻¹(x0, x1)/h, α) ∈ D(x)},   x the base point of R_d⁻¹(x0, x1).

    `structure` is D, in the coordinates (N,) of the map; `map` is R_d; `step` is h, 1 in the definition and the step size
    in the discrete Dirac system S_d^h. Raises `TypeError` for other kinds of objects.

        D = DiscretizationMapDirac(DiracStructure.from_bivector(poisson), Midpoint(), step=0.1)
        D.contains(x0, x1, dH((x0 + x1) / 2))  # one step of the midpoint rule
    """

    structure: DiracStructure
    map: AbstractDiscretizationMap
    step: Any = 1.0

    def __check_init__(self):
        if not isinstance(self.structure, DiracStructure):
            raise TypeError(f"structure must be a DiracStructure, but a {type(self.structure).__name__} was given.")
        if not isinstance(self.map, AbstractDiscretizationMap):
            raise TypeError(f"map must be a discretization map such as Midpoint(), but {self.map!r} was given.")

    def velocity(self, x0: Vector, x1: Vector) -> tuple[Vector, Vector]:
        """(x, v): the base point of the pair and the velocity R_d⁻¹(x0, x1)/h there. Raises as `map.inverse` does."""
        x, v = self.map.inverse(x0, x1)
        return x, v / self.step

    def pair(self, x: Vector, v: Vector) -> tuple[Vector, Vector]:
        """(x0, x1) = R_d(x, h v): the pair that stands for the velocity v at x. Raises as `map` does."""
        return self.map(x, self.step * v)

    def at(self, x0: Vector, x1: Vector, params: Any = None) -> LinearDirac:
        """D at the base point of the pair, a linear Dirac structure in (v, α)."""
        return self.structure.at(self.velocity(x0, x1)[0], params)

    def membership_defect(self, x0: Vector, x1: Vector, covector: Covector, params: Any = None) -> Float[AnyArray, " N"]:
        """F(x) v + E(x) α, D = {F v + E α = 0} in the smooth kernel form: zero iff ((x0, x1), α) ∈ D_d."""
        x, v = self.velocity(x0, x1)
        F, E = self.structure.kernel(x, params)
        return F @ v + E @ jnp.asarray(covector, dtype=float)

    def contains(
        self, x0: Vector, x1: Vector, covector: Covector, params: Any = None, tolerance: float = STRUCTURE_DEFECT
    ) -> Bool[AnyArray, ""]:
        """Whether ((x0, x1), α) ∈ D_d: the distance of (v, α) from D is at most `tolerance` of its length."""
        x, v = self.velocity(x0, x1)
        return self.structure.at(x, params).contains(v, covector, tolerance)
