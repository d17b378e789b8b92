"""A Lie group acting on itself from the left: the symmetry that Euler–Poincaré reduction uses up."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.geometry.lie_group import AbstractLieGroup
from dirax.numerics.tolerances import GROUP_DEFECT
from dirax.program.user_functions import is_traced
from dirax.reduction.actions import AbstractAction


class LeftTranslation(AbstractAction):
    """Φ_ξ(q) = exp(ξ) q for algebra vectors ξ (d,) and elements q (N,) of `group`.

    It is known by its generators ξ_Q(q) = ξ q: `dx.check_invariance` finds with them whether L(q, v) on TG is left-invariant,
    `momentum_map(q, p)` is the spatial momentum Ad*_{g⁻¹}μ, and `generator` serves `dx.verify`.

        left = dx.LeftTranslation(dx.SO3())
        dx.verify(dx.reconstruct(sol), symmetries={"about z": lambda q: left.generator(jnp.array([0.0, 0.0, 1.0]), q)})

    Raises `TypeError` for what is no Lie group of dirax, and `ValueError`, with the defect, for a q that is no element of it.
    """

    group: AbstractLieGroup

    def __check_init__(self):
        if not isinstance(self.group, AbstractLieGroup):
            raise TypeError(f"group must be a Lie group such as dx.SO3(), but {self.group!r} was given.")

    def dimension(self) -> int:
        """d."""
        return self.group.dimension

    def check(self, q: Float[Array, " N"]) -> None:
        """Raise `ValueError` where q is no element of the group."""
        name, size = type(self.group).__name__, self.group.ambient_dimension
        if jnp.shape(q) != (size,):
            raise ValueError(f"an element of {name} has shape ({size},), but q has shape {jnp.shape(q)}.")
        if not is_traced(q) and not float(self.group.defect(q)) < GROUP_DEFECT:
            raise ValueError(f"q = {np.asarray(q)} is no element of {name}: it is off by {float(self.group.defect(q)):.3g}.")

    def __call__(self, g: Float[Array, " d"], q: Float[Array, " N"]) -> Float[Array, " N"]:
        """exp(g) q."""
        return self.group.multiply(self.group.group_exp(g), q)
