"""The forms on the states of schemes: the canonical two-form of T*Q, in charts too, and Lie–Poisson bivectors."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.geometry.structures import canonical_two_form
from dirax.numerics.arrays import Data
from dirax.schemes.discrete_structure import AbstractDiscreteStructure, AbstractStepForm, DifferentiatedStep, nonzero

CONSTANT = 1e-13
"""Relative change of a two-form in one step up to which it is constant."""


def started(system: Any, step: Any, equation: Any, rows: Data, params: Any) -> tuple[Array, Array]:
    """(state, first guess) of the first part of a step that starts from a saved row, the only one of `rows`."""
    row = {name: values[0] for name, values in rows.items()}
    stage, fraction = equation.stages[0]
    return stage.start({**system.complete(row, params, False), "t": row["t"]}, fraction * step, params)


class RowForm(AbstractStepForm):
    """A form at the state that a step starts from at a saved row. A base class."""

    system: Any
    step: Any

    @property
    def name(self) -> str:
        return "symplecticity of one step"

    @property
    def points(self) -> int:
        return 1

    def begins(self, equation: Any, rows: Data, params: Any) -> tuple[Float[Array, " s"], Float[Array, " k"]]:
        return started(self.system, self.step, equation, rows, params)

    def refusal(self, equation: Any, row: Data, params: Any) -> str:
        try:
            jax.eval_shape(lambda row: self.begins(equation, row, params), row)
        except (KeyError, TypeError, ValueError) as error:
            return f"the scheme does not start from a saved row: {error}"
        return ""


class CanonicalForm(RowForm):
    """JᵀΩJ = Ω for J = ∂(q', p')/∂(q, p): the step is symplectic.

    Relative to ‖|J|ᵀ|Ω||J|‖; entries are the largest ones after q and p were brought to balanced units, q → q√s, p → p/√s.
    """

    @property
    def reads(self) -> tuple[str, ...]:
        return ("q", "p")

    def told(self, numbers: Any, place: str) -> str:
        return f"‖JᵀΩJ − Ω‖/‖JᵀΩJ‖, {place}"

    def defect(self, step: DifferentiatedStep, equation: Any, rows: Data, params: Any) -> Float[Array, "2"]:
        """(‖JᵀΩJ − Ω‖/‖JᵀΩJ‖, condition number)."""
        _, jacobian, condition = step
        n = jacobian.shape[0] // 2
        form = canonical_two_form(n)
        by_momentum, by_position = jnp.max(jnp.abs(jacobian[:n, n:])), jnp.max(jnp.abs(jacobian[n:, :n]))
        both = (by_momentum > 0) & (by_position > 0)
        unit = jnp.where(both, (nonzero(by_position) / nonzero(by_momentum)) ** 0.25, 1.0)
        units = jnp.concatenate([jnp.full(n, unit), jnp.full(n, 1 / unit)])
        jacobian = jacobian * units[:, None] / units[None, :]
        defect = jnp.max(jnp.abs(jacobian.T @ form @ jacobian - form))
        size = jnp.max(jnp.abs(jacobian).T @ jnp.abs(form) @ jnp.abs(jacobian))
        return jnp.stack([defect / size, condition])


class CanonicalPoints(CanonicalForm):
    """The same where a state is one point x = (q, p)."""

    @property
    def reads(self) -> tuple[str, ...]:
        return ("x",)


class TwoFormOfPoints(RowForm):
    """Jᵀω(Φ(x))J = ω(x) for a two-form ω on the points x of a final manifold: of a phase-space Lagrangian dα, which the
    midpoint rule preserves where dα is constant ([BLM] Proposition 6.3, printed: iff α is linear), and no other θ map
    (Remark 6.4). Relative to ‖|J|ᵀ|ω||J|‖. The state is x.
    """

    two_form: Callable = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    theta: float = eqx.field(static=True)

    @property
    def reads(self) -> tuple[str, ...]:
        return self.names

    def told(self, numbers: Any, place: str) -> str:
        return f"‖Jᵀ(ω∘Φ)J − ω‖/‖JᵀωJ‖ of the two-form ω of the final manifold, {place}"

    def excuse(self, numbers: Any) -> str:
        if numbers[1] > CONSTANT:
            return "; ω changes from point to point, and the midpoint rule preserves constant ones ([BLM] Proposition 6.3)"
        return "" if self.theta == 0.5 else f"; the map with θ = {self.theta} is not symplectic ([BLM] Remark 6.4)"

    def defect(self, step: DifferentiatedStep, equation: Any, rows: Data, params: Any) -> Float[Array, "3"]:
        """(‖Jᵀ(ω∘Φ)J − ω‖/‖JᵀωJ‖, ‖ω∘Φ − ω‖/‖ω‖, condition number)."""
        (state, _), (after, jacobian, condition) = self.begins(equation, rows, params), step
        before, there = self.two_form(state, params), self.two_form(after, params)
        size = jnp.max(jnp.abs(jacobian).T @ jnp.abs(there) @ jnp.abs(jacobian))
        moved = jnp.max(jnp.abs(there - before)) / nonzero(jnp.max(jnp.abs(there)))
        return jnp.stack([jnp.max(jnp.abs(jacobian.T @ there @ jacobian - before)) / nonzero(size), moved, condition])


class LiePoissonForm(RowForm):
    """JΛJᵀ = Λ∘Φ for the bivector Λ of a dual: the step Φ is a Poisson map. The state begins with the point x.

    Relative to ‖|J||Λ||J|ᵀ‖.
    """

    @property
    def reads(self) -> tuple[str, ...]:
        return ("x",)

    def told(self, numbers: Any, place: str) -> str:
        return f"‖JΛJᵀ − Λ‖/‖JΛJᵀ‖ of the Lie–Poisson bivector, {place}"

    def defect(self, step: DifferentiatedStep, equation: Any, rows: Data, params: Any) -> Float[Array, "2"]:
        """(‖JΛJᵀ − Λ∘Φ‖/‖JΛJᵀ‖, condition number)."""
        (state, _), (after, jacobian, condition) = self.begins(equation, rows, params), step
        bivector = self.system.dual.bivector
        n = self.system.dual.size
        jacobian, before = jacobian[:n, :n], bivector(state[:n])
        defect = jnp.max(jnp.abs(jacobian @ before @ jacobian.T - bivector(after[:n])))
        size = jnp.max(jnp.abs(jacobian) @ jnp.abs(before) @ jnp.abs(jacobian).T)
        return jnp.stack([defect / nonzero(size), condition])


class ChartedForm(RowForm):
    """The canonical two-form of T*Q of a manifold Q in R^N, of which a state (m, r, p) has coordinates in a chart at m.

    The saved (q, p) pull dq ∧ dp back to the coordinates (r, p), from both ends of the step: K'ᵀΩK' = KᵀΩK with
    K = ∂(q, p)/∂(r, p) and K' = ∂(q', p')/∂(r, p), at a fixed centre m. Relative to ‖|K'|ᵀ|Ω||K'|‖.
    """

    @property
    def reads(self) -> tuple[str, ...]:
        return ("q", "p")

    def told(self, numbers: Any, place: str) -> str:
        return f"‖K'ᵀΩK' − KᵀΩK‖/‖K'ᵀΩK'‖ of (q, p) by the coordinates of a chart, {place}"

    def defect(self, step: DifferentiatedStep, equation: Any, rows: Data, params: Any) -> Float[Array, "2"]:
        """(‖K'ᵀΩK' − KᵀΩK‖/‖K'ᵀΩK'‖, condition number)."""
        (state, guess), (after, jacobian, condition) = self.begins(equation, rows, params), step
        t, size = rows["t"][0], rows["q"].shape[1]
        stage, fraction = equation.stages[0]

        def saved(state):
            row = stage.unpack(state, guess, t, fraction * self.step, params)
            return jnp.concatenate([row["q"], row["p"]])

        first = jax.jacfwd(saved)(state)[:, size:]
        last = (jax.jacfwd(saved)(after) @ jacobian)[:, size:]
        form = canonical_two_form(size)
        change = last.T @ form @ last - first.T @ form @ first
        return jnp.stack([jnp.max(jnp.abs(change)) / jnp.max(jnp.abs(last).T @ jnp.abs(form) @ jnp.abs(last)), condition])


def form_of_steps(system: Any, step: Any, equation: Any, structure: AbstractDiscreteStructure | str) -> AbstractStepForm | str:
    """The form of the steps of an equation by what the system and the equation say of themselves, or why none is known."""
    if not isinstance(structure, str):
        if structure.own_states:
            return structure.step_form
        if structure.two_form is not None:
            return TwoFormOfPoints(system, step, *structure.two_form)
    fields = equation.stages[0][0].fields
    constrained = "multipliers" in fields
    if system.dual is not None and not constrained:
        return LiePoissonForm(system, step)
    if not all(stage.canonical for stage, _ in equation.stages):
        return "the state of this scheme is not (q, p) on T*Q"
    if constrained:
        return structure if isinstance(structure, str) else structure.step_form
    return (CanonicalPoints if "x" in fields else CanonicalForm)(system, step)
