"""Shape: the sizes of a system, and which of its constraints enter the equations of a run."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from dirax.numerics.arrays import Numbers


class Shape(eqx.Module):
    """Sizes of a system: n coordinates, m constraints on velocities and c holonomic ones.

    `redundant`: those of the m + c constraints that follow from the others where a run begins, and are left out of its
    equations.
    """

    n: int = eqx.field(static=True)
    m: int = eqx.field(static=True, default=0)
    c: int = eqx.field(static=True, default=0)
    redundant: tuple[int, ...] = eqx.field(static=True, default=(), kw_only=True)

    @property
    def kept(self) -> tuple[int, ...]:
        """The numbers of the constraints that enter the equations."""
        return tuple(i for i in range(self.m + self.c) if i not in self.redundant)

    def pick(self, values: Numbers, first: int = 0) -> Numbers:
        """The kept ones of values that belong to the constraints from number `first` on."""
        kept = [i - first for i in self.kept if i >= first]
        return values if len(kept) == values.shape[0] else jnp.stack([values[i] for i in kept])

    def spread(self, multipliers: Float[Numbers, " k"]) -> Float[Numbers, " m_and_c"]:
        """The multipliers of all constraints: zero for the redundant ones."""
        if len(self.kept) == self.m + self.c:
            return multipliers
        of = {row: multipliers[number] for number, row in enumerate(self.kept)}
        return jnp.stack([of.get(i, jnp.zeros(())) for i in range(self.m + self.c)])
