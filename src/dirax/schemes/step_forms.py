"""The forms on the states of schemes: the canonical two-form of T*Q, in charts too, and Lie–Poisson bivectors."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.geometry.charts import RetractionChart
from dirax.geometry.manifolds import AbstractGeodesicManifold
from dirax.geometry.structures import canonical_two_form
from dirax.numerics.arrays import Data
from dirax.program.tracing import jacobian
from dirax.schemes.discrete_structure import AbstractDiscreteStructure, AbstractStepForm, DifferentiatedStep
from dirax.systems.shape import Shape

CONSTANT = 1e-13
"""Relative change of a two-form in one step up to which it is constant."""


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
        row = {name: values[0] for name, values in rows.items()}
        stage, fraction = equation.stages[0]
        return stage.start({**self.system.complete(row, params, False), "t": row["t"]}, fraction * self.step, params)

    def refusal(self, equation: Any, row: Data, params: Any) -> str:
        try:
            jax.eval_shape(lambda row: self.begins(equation, row, params), row)
        except (KeyError, TypeError, ValueError) as error:
            return f"the scheme does not start from a saved row: {error}"
        return ""


def pulled_back(form: Array, jacobian: Array) -> Array:
    """JᵀωJ."""
    return jacobian.T @ form @ jacobian


def with_sizes(change: Array, form: Array, jacobian: Array) -> Float[Array, "2 s s"]:
    """The change of a form JᵀωJ, with the sizes |J|ᵀ|ω||J| of its terms; of two directions no less than the geometric mean of
    those of each with itself, since what is left of a zero in J has no size."""
    sizes = pulled_back(jnp.abs(form), jnp.abs(jacobian))
    lengths = jnp.sqrt(jnp.diagonal(sizes))
    return jnp.stack([change, jnp.maximum(sizes, jnp.outer(lengths, lengths))])


def not_symplectic(theta: float | None) -> str:
    """Why a step of ẋ ⊕ dH ∈ D by a θ map may change the form; "" for the midpoint rule, and where there is no θ."""
    return "" if theta in (0.5, None) else f"; the map with θ = {theta} is not symplectic ([BLM] Remark 6.4)"


class CanonicalForm(RowForm):
    """JᵀΩJ = Ω for J = ∂(q', p')/∂(q, p): the step is symplectic."""

    theta: float | None = eqx.field(static=True, default=None)

    def excuse(self, numbers: Any) -> str:
        return not_symplectic(self.theta)

    @property
    def reads(self) -> tuple[str, ...]:
        return ("q", "p")

    def told(self, numbers: Any, place: str) -> str:
        return f"the worst entry of JᵀΩJ − Ω, {place}"

    def terms(self, step: DifferentiatedStep, equation: Any, rows: Data, params: Any) -> Float[Array, "1 2 s s"]:
        form = canonical_two_form(step.jacobian.shape[0] // 2)
        return with_sizes(pulled_back(form, step.jacobian) - form, form, step.jacobian)[None]


class CanonicalPoints(CanonicalForm):
    """The same where a state is one point x = (q, p)."""

    @property
    def reads(self) -> tuple[str, ...]:
        return ("x",)


class FormOfPoints(RowForm):
    """A form on the points x with which the states begin, that D is the graph of. A base class."""

    form: Callable = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    theta: float | None = eqx.field(static=True, default=None)

    @property
    def reads(self) -> tuple[str, ...]:
        return self.names

    def excuse(self, numbers: Any) -> str:
        if numbers[1] > CONSTANT:
            return "; it changes from point to point, and such methods preserve constant ones ([BLM] Proposition 6.3)"
        return not_symplectic(self.theta)

    def at_both_ends(self, step: DifferentiatedStep, equation: Any, rows: Data, params: Any) -> tuple[Array, Array, Array]:
        """(the form at x, that at Φ(x), ∂Φ/∂x)."""
        (state, _), (after, jacobian, _) = self.begins(equation, rows, params), step
        n = rows[self.names[0]].shape[-1]
        return self.form(state[:n], params), self.form(after[:n], params), jacobian[:n, :n]


class TwoFormOfPoints(FormOfPoints):
    """Jᵀω(Φ(x))J = ω(x) for a two-form ω on points x: of a phase-space Lagrangian dα on its final manifold, which the
    midpoint rule preserves where dα is constant ([BLM] Proposition 6.3, printed: iff α is linear), and no other θ map
    (Remark 6.4)."""

    def told(self, numbers: Any, place: str) -> str:
        return f"the worst entry of Jᵀ(ω∘Φ)J − ω of the two-form ω whose graph D is, {place}"

    def terms(self, step: DifferentiatedStep, equation: Any, rows: Data, params: Any) -> Float[Array, "2 2 s s"]:
        """Those of Jᵀ(ω∘Φ)J − ω, and those of Jᵀ(ω∘Φ − ω)J."""
        before, there, jacobian = self.at_both_ends(step, equation, rows, params)
        pairs = pulled_back(there, jacobian) - before, pulled_back(there - before, jacobian)
        return jnp.stack([with_sizes(change, there, jacobian) for change in pairs])


class BivectorOfPoints(FormOfPoints):
    """JΛ(x)Jᵀ = Λ(Φ(x)) for the bivector Λ whose graph D is: a Poisson map, of a Poisson Λ."""

    def told(self, numbers: Any, place: str) -> str:
        return f"the worst entry of JΛJᵀ − Λ∘Φ of the bivector Λ whose graph D is, {place}"

    def terms(self, step: DifferentiatedStep, equation: Any, rows: Data, params: Any) -> Float[Array, "2 2 s s"]:
        """Those of JΛJᵀ − Λ∘Φ, and those of J(Λ∘Φ − Λ)Jᵀ."""
        before, there, jacobian = self.at_both_ends(step, equation, rows, params)
        pairs = pulled_back(before, jacobian.T) - there, pulled_back(there - before, jacobian.T)
        return jnp.stack([with_sizes(change, before, jacobian.T) for change in pairs])


class LiePoissonForm(BivectorOfPoints):
    """The same for a Lie–Poisson bivector and steps of the group, which preserve it though it is not constant."""

    def told(self, numbers: Any, place: str) -> str:
        return f"the worst entry of JΛJᵀ − Λ of the Lie–Poisson bivector, {place}"

    def excuse(self, numbers: Any) -> str:
        return ""


class ChartedForm(RowForm):
    """The canonical two-form of T*Q of a manifold Q in R^N, of which a state (m, r, p) has coordinates in a chart at m.

    The saved (q, p) pull dq ∧ dp back to the coordinates (r, p), from both ends of the step: K'ᵀΩK' = KᵀΩK with
    K = ∂(q, p)/∂(r, p) and K' = ∂(q', p')/∂(r, p), at a fixed centre m.
    """

    @property
    def reads(self) -> tuple[str, ...]:
        return ("q", "p")

    def told(self, numbers: Any, place: str) -> str:
        return f"the worst entry of K'ᵀΩK' − KᵀΩK of (q, p) by the coordinates of a chart, {place}"

    def ends(self, step: DifferentiatedStep, equation: Any, rows: Data, params: Any) -> tuple[Array, Array]:
        """K at the state that the step starts from, and K'."""
        state, guess = self.begins(equation, rows, params)
        t, size = rows["t"][0], rows["q"].shape[1]
        stage, fraction = equation.stages[0]

        def saved(state):
            row = stage.unpack(state, guess, t, fraction * self.step, params)
            return jnp.concatenate([row["q"], row["p"]])

        by_state = jacobian(saved)
        return by_state(state)[:, size:], (by_state(step.state) @ step.jacobian)[:, size:]

    def terms(self, step: DifferentiatedStep, equation: Any, rows: Data, params: Any) -> Float[Array, "1 2 s s"]:
        first, last = self.ends(step, equation, rows, params)
        form = canonical_two_form(rows["q"].shape[1])
        return with_sizes(pulled_back(form, last) - pulled_back(form, first), form, last)[None]


class AmbientForm(ChartedForm):
    """The same where states begin with (q, p) themselves: K is the derivative of (q, p) by coordinates in the chart at q, and
    K' = JK."""

    def ends(self, step: DifferentiatedStep, equation: Any, rows: Data, params: Any) -> tuple[Array, Array]:
        manifold, q, p = self.system.manifold_form().manifold, rows["q"][0], rows["p"][0]
        chart, size = RetractionChart(manifold, q, manifold.frame(q)), 2 * q.shape[0]
        local = jnp.concatenate(chart.momentum_to_local(q, p))
        first = jacobian(lambda z: jnp.concatenate(chart.momentum_to_manifold(*jnp.split(z, 2))))(local)
        return first, step.jacobian[:size, :size] @ first


def form_of_steps(
    system: Any, shape: Shape, step: Any, equation: Any, structure: AbstractDiscreteStructure | str
) -> AbstractStepForm | str:
    """The form of the steps of an equation by what the system and the equation say of themselves, or why none is known."""
    if not isinstance(structure, str) and structure.own_states:
        return structure.step_form
    first = equation.stages[0][0]
    fields, constrained = first.fields, "multipliers" in first.fields
    canonical = all(stage.canonical for stage, _ in equation.stages)
    if system.dual is not None:
        if constrained:
            return "the forces of the constraints change the Lie–Poisson bivector"
        # steps of the group are Poisson maps, others preserve bivectors that are constant
        kind = LiePoissonForm if "g" in fields else BivectorOfPoints
        return kind(system, step, lambda x, params: system.dual.bivector(x), ("x",))
    if constrained:
        return structure if isinstance(structure, str) else structure.step_form
    if canonical and shape.m + shape.c:
        return "steps under constraints may be symplectic on the manifold of these alone, of which the rows hold no multipliers"
    if canonical:
        lifted = isinstance(structure, str) or system.lagrangian_form() is not None  # by the lift of the map to T*Q
        return (CanonicalPoints if "x" in fields else CanonicalForm)(system, step, None if lifted else structure.theta)
    if (on_manifold := system.manifold_form()) is not None:
        if "chart" in fields:
            return ChartedForm(system, step)
        if not isinstance(on_manifold.manifold, AbstractGeodesicManifold):
            return f"dq ∧ dp is measured in the chart of a retraction, and {on_manifold.manifold} has none"
        if list(first.state_layout)[:2] == ["q", "p"]:
            return AmbientForm(system, step)
    if not isinstance(structure, str) and structure.curved(shape.n):
        return "the points x are on a curved submanifold of R^N, and the derivative of a step is one by all of R^N"
    return _form_of_points(system, shape, step, first, None if isinstance(structure, str) else structure.theta)


def _form_of_points(system: Any, shape: Shape, step: Any, equation: Any, theta: float | None) -> AbstractStepForm | str:
    """That of the points x of a relation, whose D is the graph of one."""
    relation = system.final_relation(shape) or system.relation_form(shape)
    if relation is None or not set(relation.names) <= set(equation.fields):
        if list(equation.state_layout)[:2] == ["q", "p"] and equation.state_size == 2 * shape.n:
            return (
                "the equation of this scheme does not say that its state is (q, p) on T*Q: give dx.StepEquation(canonical=True)"
            )
        return f"the state of this scheme is {equation.state_layout!r}, not (q, p) on T*Q"
    if relation.two_form is not None:
        return TwoFormOfPoints(system, step, relation.two_form, relation.names, theta)
    if relation.bivector is not None:
        return BivectorOfPoints(system, step, relation.bivector, relation.names, theta)
    if not relation.dirac:
        return "an implicit system states no two-form or bivector that a step could preserve"
    return "D is the graph neither of a two-form nor of a bivector, which a step could preserve"
