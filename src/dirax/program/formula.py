"""Functions of numbers that know their own derivatives, written once for arrays of JAX and for scalar graphs."""

from abc import ABC, abstractmethod
from functools import partial
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.interpreters import ad
from jaxtyping import Array, Float

from dirax.program.primitives import binds, plain_primitive

Slope: TypeAlias = "tuple[float, Formula] | None"


class Formula(ABC):
    """A function of numbers; subclasses are frozen dataclasses, so that equal ones are traced once."""

    @abstractmethod
    def value(self, xp: Any, x: tuple) -> Any:
        """The function by operators and `xp.where`, `xp.sqrt`, `xp.sin`, `xp.cos` and `xp.arctan2`."""

    @abstractmethod
    def slopes(self) -> tuple[Slope, ...]:
        """The derivative by each argument as (factor, function of the same arguments), None for zero."""

    @property
    def is_restricted(self) -> bool:
        """Whether it is a function only where its arguments belong together: written out, it moves in another way than its slopes
        say where they do not."""
        return None in self.slopes()

    def __call__(self, *x: Float[Array, ""]) -> Float[Array, ""]:
        """The formula at x, differentiable any number of times."""
        if binds(*x) and not any(map(jnp.ndim, x)):
            return formula_p.bind(*map(jnp.asarray, x), formula=self)[0]
        return _by_jax(self, *x)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _by_jax(formula: Formula, *x):
    return formula.value(jnp, x)


@_by_jax.defjvp
def _value_and_tangent(formula, primals, tangents):
    slopes = zip(formula.slopes(), tangents, strict=True)
    parts = [slope[0] * slope[1](*primals) * along for slope, along in slopes if slope is not None]
    return formula(*primals), sum(parts[1:], parts[0])


def _formula_p_tangents(primals, tangents, *, formula: Formula):
    value, along = _value_and_tangent(formula, primals, tuple(map(ad.instantiate_zeros, tangents)))
    return [value], [along]


formula_p = plain_primitive(
    "dirax_formula", lambda *x, formula: [_by_jax(formula, *x)], lambda x, *_, formula: [ShapedArray((), x.dtype)]
)
ad.primitive_jvps[formula_p] = _formula_p_tangents
