"""The constraints that one step imposes: those of the system without the redundant ones."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.program.tracing import pulled_back
from dirax.schemes.labels import Labels
from dirax.schemes.step import Field, Shape
from dirax.systems.system import AbstractSystem


class ConstraintRows:
    """The rows of [W; G] that enter the equations of a step, with their multipliers: `count` of them, the first
    `nonholonomic` from W and the last `holonomic` from G. Saved arrays have all m + c entries."""

    def __init__(self, system: AbstractSystem, shape: Shape):
        self.constraints, self.shape, self.m, self.c = system.constraints, shape, shape.m, shape.c
        self.kept = shape.kept
        self.count = len(self.kept)
        self.nonholonomic = sum(i < shape.m for i in self.kept)
        self.holonomic = self.count - self.nonholonomic

    def matrix(self, t: Any, q: Float[Array, " n"], params: Any) -> Float[Array, "k n"]:
        """The kept rows of [W; G]."""
        return self.pick(self.constraints.matrix(t, q, params))

    def holonomic_matrix(self, t: Any, q: Float[Array, " n"], params: Any) -> Float[Array, "r n"]:
        """The kept rows of G."""
        return self.pick(self.constraints.holonomic_matrix(t, q, params), self.m)

    def force(self, t: Any, q: Float[Array, " n"], multipliers: Float[Array, " k"], params: Any) -> Float[Array, " n"]:
        """[W; G]ᵀ·multipliers of the kept rows."""
        return self._pulled(t, q, multipliers, params) if self.m == 0 else self.matrix(t, q, params).T @ multipliers

    def holonomic_force(self, t: Any, q: Float[Array, " n"], multipliers: Float[Array, " r"], params: Any) -> Float[Array, " n"]:
        """Gᵀ·multipliers of the kept rows."""
        return self._pulled(t, q, multipliers, params)

    def _pulled(self, t, q, multipliers, params):
        """Without the matrix G, which has c·n entries."""
        if self.holonomic < self.c or not self.c:
            return self.holonomic_matrix(t, q, params).T @ multipliers
        return pulled_back(lambda q: self.constraints.position_defect(t, q, params), q, multipliers)

    def position(self, t: Any, q: Float[Array, " n"], params: Any) -> Float[Array, " r"]:
        """The kept entries of g."""
        return self.pick(self.constraints.position_defect(t, q, params), self.m)

    def hidden(self, t: Any, q: Float[Array, " n"], v: Float[Array, " n"], params: Any) -> Float[Array, " r"]:
        """The kept entries of G v + ∂g/∂t."""
        return self.pick(self.constraints.hidden_defect(t, q, v, params), self.m)

    def velocity_defect(self, t: Any, q: Float[Array, " n"], v: Float[Array, " n"], params: Any) -> Float[Array, " k"]:
        """The kept entries of (W v + b, G v + ∂g/∂t)."""
        return self.pick(self.constraints.velocity_defect(t, q, v, params))

    def pick(self, values: Array, first: int = 0) -> Array:
        """The kept ones of all constraints from number `first` on."""
        return self.shape.pick(values, first)

    def all(self, multipliers: Float[Array, " k"]) -> Float[Array, " multipliers"]:
        """The multipliers of all constraints: zero for the redundant ones."""
        return self.shape.spread(multipliers)

    def fields(self) -> dict[str, Field]:
        """What a constrained run saves of each step."""
        if not self.m + self.c:
            return {}
        size = (self.m + self.c,)
        about = (
            "discrete constraint w_d(q_k, q_{k+1})" if not self.c else "constraints of the step: w_d(q_k, q_{k+1}), g(q_{k+1})"
        )
        return {
            "multipliers": Field(size, "step", ("constraint",), "Lagrange multipliers of the constraints", "sum"),
            "constraint": Field(size, "step", ("constraint",), about),
        }

    def labels(self) -> Labels:
        """The names of the constraint equations."""
        if self.count == self.m + self.c:
            return Labels.numbered("discrete constraint {}", self.m) + Labels.numbered("holonomic constraint {}", self.c)
        of = lambda i: f"discrete constraint {i}" if i < self.m else f"holonomic constraint {i - self.m}"
        return Labels() + tuple(of(i) for i in self.kept)


def step_constraints(rows: ConstraintRows, wd: Callable) -> Callable:
    """(w_d(q0, q1), g(q1)/unit) as a function (t0, q0, v, h, params, unit=1) with q1 = q0 + h v, all m + c of them."""

    def both(t, q, v, h, params, unit=1.0):
        if not rows.c:
            return wd(t, q, v, h, params)
        end = rows.constraints.position_defect(t + h, q + h * v, params) / unit
        return jnp.concatenate([wd(t, q, v, h, params), end]) if rows.m else end

    return both
