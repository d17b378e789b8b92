"""StepEquation: the hub. One step of size h as an equation between two states; schemes make it, engines solve it."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.program.memo import Memo
from dirax.schemes.discrete_structure import AbstractDiscreteStructure, AbstractStepForm
from dirax.schemes.labels import Labels
from dirax.schemes.layout import Layout
from dirax.schemes.stage_relation import MeanRelation, StageRelation
from dirax.schemes.step_forms import form_of_steps
from dirax.systems.shape import Shape
from dirax.text.representation import counted, fields_html, module_html, module_text

PLACES = ("node", "step")
"""Where a field is known: at the rows of a trajectory, or between two of them."""

COMPOSED = ("first", "sum", "mean", "each")
"""How the row of a composed step is made of those of its parts."""

CLOCK = "clock"
"""The field of nodes and the part of the state that are the time, where steps have lengths of their own."""

STEP_DENSITY = "step_density"
"""Those that are the step density z, of which the value in the middle of a step sets its length, step/z."""

STEP_LENGTH = "step_length"
"""The field of their steps that is the length, where there are impulses, to divide them by."""

PART = "part_of_step"
"""The field of an impact that says where in its step it is, by `step`, of steps that have lengths of their own."""

WHOLE = 1e-12
"""How far the fractions of the parts of a step may sum up to another number than 1, relative to them."""

SHOWN = 200
"""Equations that are named where a step is shown."""


class Field(eqx.Module):
    """One named array of a trajectory: its shape in a row and whether it belongs to nodes or to steps.

    `place="node"` has steps + 1 rows (q, p, x), `place="step"` has steps rows (multipliers). `dims` names the axes.
    `composed` says how the row of a composed step is made of those of its parts: "first" (the array of the first part, at
    whose point the row is), "sum" (impulses), "mean" (rates, weighted by the parts' fractions of h) or "each" (all of them,
    along a new axis in front). A field of nodes is "first" unless it says otherwise, one of steps "mean".
    `chosen` says that steps may begin with any value of it, and that the one in a row is not what the step before led to: the
    centre of a chart, where a row was not computed in charts. `dx.verify` begins there, and does not expect it.
    Raises `ValueError` for another `place` or `composed`.
    """

    shape: tuple[int, ...] = eqx.field(static=True)
    place: str = eqx.field(static=True, default="node")
    dims: tuple[str, ...] = eqx.field(static=True, default=("coordinate",))
    description: str = eqx.field(static=True, default="")
    composed: str = eqx.field(static=True, default="")
    chosen: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        if self.place not in PLACES:
            raise ValueError(f"place must be {' or '.join(map(repr, PLACES))}, but {self.place!r} was given.")
        if self.composed not in ("", *COMPOSED):
            raise ValueError(f"composed must be one of {', '.join(map(repr, COMPOSED))}, but {self.composed!r} was given.")

    @property
    def rule(self) -> str:
        """How the row of a composed step is made: `composed`, or what stands for it by the field's place."""
        return self.composed or ("mean" if self.place == "step" else "first")

    def weight(self, fraction: float) -> float:
        """What a part that takes this fraction of the step is multiplied by in its row."""
        return fraction if self.rule == "mean" else 1.0


class StepEquation(eqx.Module):
    """One step of size h of a method, as pure JAX functions on flat float64 vectors.

    - `start(data, h, params) -> (state, u)`: initial state (s,) and first guess (k,) from the initial data, a dict that
      holds one of the pairs `q, v` · `q, p` · `q0, q1` or a single `x`, and the time `t`;
    - `residual(u, state, t, h, params) -> r`: (k,), zero at the step;
    - `advance(u, state, t, h, params) -> state`: the next state (s,);
    - `unpack(state, u, t, h, params) -> dict`: the named arrays to be saved for the row that `state` is at; `u` is the
      step leaving it.

    `state_size` is s and `unknowns` is k, 0 for an explicit method; `state_layout` and `unknown_layout` name their parts, and
    may be given instead. `fields` says what is saved, `labels` names each row of the residual for messages, and `canonical`
    that the state is (q, p) of T*Q, so that its symplecticity can be measured. Optional are

    - `check(data, h, params)`, which raises `ValueError` for initial data, concrete ones with the time `t`, at which a premise
      of the method does not hold;
    - `guess(state, previous, h, params) -> u`: where Newton's method starts, if that is not `previous` (k,), the unknowns
      extrapolated from the steps before;
    - `remark(state, t, h, params) -> str`, what there is to say of a place from which a step fails, or "";
    - `review(fields) -> dict`, which looks at the saved arrays of a run, concrete ones, for what is to stand in its `stats`, and
      warns of what is wrong with them;
    - `resume(data, h, params) -> (state, u)`: where the step that leaves a saved row begins, of which `data` has the fields too,
      and which need not be the first: `start` sets sums since the start to zero, and may choose another chart, or take longer.
      Without it `start` is asked, and a run whose rows it does not lead from one to the next is not looked into between them;
    - `interpolate(theta, u, state, t, h, params) -> dict`, the fields of nodes at t + θh inside the step, 0 ≤ θ ≤ 1, by the
      polynomial of the method, which joins both ends;
    - `between(theta, row, after, h, params) -> dict`, the same of the rows at both ends, which hold the time `t` and the velocity
      `v` too: for methods of second order. Where neither is said, the fields at t + θh are those of a step of length θh;
    - `collocation`, the stage relation or mean relation of which the unknowns are copies: a fact that engines may use or ignore;
    - `weak`, pairs (rows, columns) of entries of the Jacobian that are O(h²) beside the others, so that Newton's method converges
      almost as fast without them: another one that engines may use or ignore.

    Equations are compared by the identity of their functions. One with other functions is made by `dataclasses.replace`.
    Raises `ValueError` where sizes, layouts and labels do not fit.
    """

    start: Callable = eqx.field(static=True)
    residual: Callable = eqx.field(static=True)
    advance: Callable = eqx.field(static=True)
    unpack: Callable = eqx.field(static=True)
    state_size: int = eqx.field(static=True)
    unknowns: int = eqx.field(static=True)
    fields: dict[str, Field]
    labels: Sequence[str] = eqx.field(static=True)
    canonical: bool = eqx.field(static=True)
    check: Callable = eqx.field(static=True)
    remark: Callable = eqx.field(static=True)
    review: Callable = eqx.field(static=True)
    guess: Callable = eqx.field(static=True)
    resume: Callable = eqx.field(static=True)
    interpolate: Callable | None = eqx.field(static=True)
    between: Callable | None = eqx.field(static=True)
    state_layout: Layout = eqx.field(static=True)
    unknown_layout: Layout = eqx.field(static=True)
    collocation: StageRelation | MeanRelation | None = eqx.field(static=True)
    weak: tuple[tuple[range, range], ...] = eqx.field(static=True)

    def __init__(
        self,
        *,
        start: Callable,
        residual: Callable,
        advance: Callable,
        unpack: Callable,
        fields: dict[str, Field],
        state_size: int | None = None,
        unknowns: int | None = None,
        state_layout: Layout | None = None,
        unknown_layout: Layout | None = None,
        labels: Sequence[str] | None = None,
        canonical: bool = False,
        check: Callable | None = None,
        remark: Callable | None = None,
        review: Callable | None = None,
        guess: Callable | None = None,
        resume: Callable | None = None,
        interpolate: Callable | None = None,
        between: Callable | None = None,
        collocation: StageRelation | MeanRelation | None = None,
        weak: tuple[tuple[range, range], ...] = (),
    ):
        self.start, self.residual, self.advance, self.unpack = start, residual, advance, unpack
        self.fields, self.canonical = dict(fields), canonical
        self.state_layout, self.state_size = _layout("state", state_layout, "state_size", state_size)
        self.unknown_layout, self.unknowns = _layout("u", unknown_layout, "unknowns", unknowns)
        self.labels = labels or Labels.numbered("equation {}", self.unknowns)
        self.check = check or nothing_to_check
        self.remark = remark or nothing_to_say
        self.review = review or nothing_to_report
        self.guess = guess or previous_unknowns
        self.resume = resume or start
        self.interpolate, self.between = interpolate, between
        self.collocation, self.weak = collocation, weak
        if len(self.labels) != self.unknowns:
            raise ValueError(f"labels need one entry per unknown ({self.unknowns}), but {len(self.labels)} were given.")

    @property
    def stages(self) -> tuple[tuple["StepEquation", float], ...]:
        """The equations solved one after the other in a step, each with its fraction of h (here: one, the whole)."""
        return ((self, 1.0),)

    def _summary(self) -> dict[str, str]:
        saved = (f"{name}{list(field.shape)}" + " per step" * (field.place == "step") for name, field in self.fields.items())
        return {
            "solves": counted(self.unknowns, "unknown") if self.unknowns else "nothing (explicit)",
            "state": counted(self.state_size, "number") + ", (q, p) on T*Q" * self.canonical,
            "saves": ", ".join(saved),
        }

    def __repr__(self) -> str:
        return f"StepEquation({'; '.join(f'{name} {text}' for name, text in self._summary().items())})"

    def _repr_html_(self) -> str:
        parts = {"state is": repr(self.state_layout), "unknowns are": repr(self.unknown_layout)}
        return fields_html(
            "StepEquation",
            self._summary() | parts | {"equations": ", ".join(self.labels[:SHOWN]) + ", …" * (len(self.labels) > SHOWN)},
        )


class StepSequence(eqx.Module):
    """Several StepEquations solved one after the other, each with its own fraction of h: a composition."""

    stages: tuple[tuple[StepEquation, float], ...]

    @property
    def first(self) -> StepEquation:
        """The equation of the first part."""
        return self.stages[0][0]

    @property
    def fields(self) -> dict[str, Field]:
        """The named arrays of a row: those of the first part, at which every row is."""
        return self.first.fields

    def __repr__(self) -> str:
        fractions = ", ".join(f"{fraction:.6g}" for _, fraction in self.stages)
        return f"StepSequence({counted(len(self.stages), 'stage')} of h·({fractions}); first {self.first!r})"


class RowAtState(dict):
    """Data from which a step is resumed at a state that is no saved row: what is not among them is asked of its row."""

    def __init__(self, data: dict[str, Any], row: Callable[[], dict[str, Any]]):
        super().__init__(data)
        self._row = row

    def __missing__(self, name: str) -> Any:
        return self._row()[name]


def first_of_each(stages: Sequence[tuple[StepEquation, float]]) -> list[int]:
    """The number of the first stage with each of the equations."""
    return [i for i, (stage, _) in enumerate(stages) if all(stage is not other for other, _ in stages[:i])]


def needs_every_part(equation: "StepEquation | StepSequence") -> bool:
    """Whether a row takes more than the first part of a step."""
    return len(equation.stages) > 1 and any(field.rule != "first" for field in equation.fields.values())


def composed_row(equation: "StepEquation | StepSequence", rows: Sequence[dict[str, Array]]) -> dict[str, Array]:
    """The row of a whole step, of those of its parts in order; of the first one alone where that is all there is."""
    if len(rows) == 1:
        return rows[0]

    def whole(name: str, field: Field):
        if field.rule == "first":
            return rows[0][name]
        arrays = [field.weight(fraction) * row[name] for row, (_, fraction) in zip(rows, equation.stages, strict=True)]
        return jnp.stack(arrays) if field.rule == "each" else sum(arrays[1:], arrays[0])

    return {name: whole(name, field) for name, field in equation.fields.items()}


class AbstractScheme(eqx.Module):
    """How time is cut: turns a system of known sizes into a StepEquation."""

    def __repr__(self) -> str:
        return module_text(self)

    def _repr_html_(self) -> str:
        return module_html(self)

    @abstractmethod
    def step_equation(self, system: Any, shape: Shape) -> StepEquation | StepSequence:
        """The equation of one step; raises `TypeError` for a system that the scheme does not discretize."""

    def adjoint(self, system: Any) -> "AbstractScheme | None":
        """The adjoint Φ*_h = (Φ_{−h})⁻¹ on this system as a scheme of its own; None where it is the inverse map as such,
        whose equation `dx.Adjoint` makes of the scheme's. A scheme that is self-adjoint returns itself. Raises `TypeError`
        where there is none."""
        return None

    def composed_order(self, system: Any, shape: Shape) -> int | None:
        """The order that compositions of it have at most; None where that of their coefficients is had."""
        return None

    def part(self, system: Any, shape: Shape) -> "AbstractScheme":
        """The scheme as a part of a composed step: itself, or one with the same q whose saved p has the order of q there."""
        return self

    def discrete_structure(self, system: Any, shape: Shape, step: Any) -> AbstractDiscreteStructure | str:
        """The discrete Dirac structure that consecutive rows belong to, for steps of size `step`; or why there is none."""
        return f"{type(self).__name__} states no discrete Dirac structure"

    def step_form(self, system: Any, shape: Shape, step: Any) -> AbstractStepForm | str:
        """The form on its states whose change in one step is known; or why none is."""
        if self.keeps_no_form:
            return self.keeps_no_form
        equation = make_step_equation(self, system, shape)
        return form_of_steps(system, shape, step, equation, self.discrete_structure(system, shape, step))

    @property
    def keeps_no_form(self) -> str:
        """Why its steps keep no two-form and no bivector, whatever the system; empty for those that may."""
        return ""

    @property
    def constraints_at_rows(self) -> bool:
        """Whether the constraints hold at the saved rows to roundoff, and not inside the steps alone."""
        return True


def _checked(scheme: AbstractScheme, equation: Any) -> "StepEquation | StepSequence":
    """What a scheme returned. Raises `TypeError` for something else, and `ValueError` for parts that make no whole step."""
    if not isinstance(equation, StepEquation | StepSequence):
        raise TypeError(
            f"step_equation of {type(scheme).__name__} must return a dx.StepEquation or a dx.StepSequence, but it returned "
            f"{type(equation).__name__}."
        )
    fractions = [fraction for _, fraction in equation.stages]
    if not abs(sum(fractions) - 1.0) <= WHOLE * sum(map(abs, fractions)):
        raise ValueError(
            f"the fractions of the stages of {type(scheme).__name__} must sum up to 1, a whole step, but their sum is "
            f"{sum(fractions):.9g}."
        )
    return equation


def _layout(part: str, layout: Layout | None, name: str, size: int | None) -> tuple[Layout, int]:
    """The layout and the size of the state or of the unknowns, of which one at least is given."""
    if layout is None:
        if size is None:
            raise ValueError(f"a StepEquation needs {name}=, or a layout instead.")
        layout = Layout(**{part: size})
    if size not in (None, layout.size):
        raise ValueError(f"{name} = {size} does not fit {layout!r}, which has {layout.size} numbers.")
    return layout, layout.size


def previous_unknowns(state, previous, h, params):
    """The default guess: the unknowns extrapolated from the steps before."""
    return previous


def nothing_to_check(data, h, params) -> None:
    """The default check of initial data."""


def nothing_to_say(state, t, h, params) -> str:
    """The default remark on a place where a step fails."""
    return ""


def nothing_to_report(fields) -> dict[str, Any]:
    """The default review of saved arrays."""
    return {}


def explicit_step(u, state, t, h, params) -> Float[Array, "0"]:
    """The residual of an explicit method: nothing to solve."""
    return jnp.zeros((0,))


_equations: Memo[StepEquation | StepSequence] = Memo(256)


def make_step_equation(scheme: AbstractScheme, system: Any, shape: Shape) -> StepEquation | StepSequence:
    """`scheme.step_equation(system, shape)`, the same object for equal arguments, so that compiled code is reused. Raises
    `TypeError` for a system that the scheme does not step, with what the system says of those that do."""

    def made() -> StepEquation | StepSequence:
        try:
            with jax.ensure_compile_time_eval():  # arrays that it makes are numbers in whatever trace it is made first
                return _checked(scheme, scheme.step_equation(system, shape))
        except TypeError as error:
            advice = getattr(system, "stepped_by", "")
            if not advice or type(scheme).__name__ in advice:
                raise
            raise TypeError(f"{str(error).rstrip('.')}. {advice}") from error

    return _equations.get((scheme, system, shape), made)
