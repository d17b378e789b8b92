"""AbstractStep: one step of a scheme as a class, whose methods are the functions of its StepEquation."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

from jaxtyping import Array, Float

from dirax.numerics.arrays import Data
from dirax.schemes.layout import Layout
from dirax.schemes.step import Field, StepEquation


class AbstractStep(ABC):
    """One step of a scheme on one system of known sizes; `equation` makes a StepEquation of it, whose docstring says what
    the methods are.

    A subclass is a frozen record of the system and of the settings, compared by identity:

        @dataclass(frozen=True, eq=False)
        class StepOfMine(AbstractStep):
            system: LagrangeDirac
            shape: Shape
    """

    @property
    @abstractmethod
    def state(self) -> Layout:
        """The parts of the state."""

    @property
    @abstractmethod
    def unknowns(self) -> Layout:
        """The parts of the unknowns."""

    @property
    @abstractmethod
    def fields(self) -> dict[str, Field]:
        """What is saved, by name."""

    @property
    @abstractmethod
    def labels(self) -> Sequence[str]:
        """The name of each row of the residual, for messages."""

    @property
    def canonical(self) -> bool:
        """Whether the state is (q, p) of T*Q."""
        return False

    @abstractmethod
    def start(self, data: Data, h: Any, params: Any) -> tuple[Float[Array, " s"], Float[Array, " k"]]:
        """The first state and a first guess of the unknowns."""

    @abstractmethod
    def residual(self, u: Float[Array, " k"], state: Float[Array, " s"], t: Any, h: Any, params: Any) -> Float[Array, " k"]:
        """Zero at the step."""

    @abstractmethod
    def advance(self, u: Float[Array, " k"], state: Float[Array, " s"], t: Any, h: Any, params: Any) -> Float[Array, " s"]:
        """The next state."""

    @abstractmethod
    def unpack(self, state: Float[Array, " s"], u: Float[Array, " k"], t: Any, h: Any, params: Any) -> dict[str, Array]:
        """The arrays that are saved of the row that `state` is at."""

    def check(self, data: Data, h: Any, params: Any) -> None:
        """Raise `ValueError` for initial data, with the time `t`, at which a premise of the method does not hold."""
        return None

    def remark(self, state: Float[Array, " s"], t: Any, h: Any, params: Any) -> str:
        """What there is to say of a place from which a step fails."""
        return ""

    def review(self, fields: Data) -> dict[str, Any]:
        """What the saved arrays of a run say for its `stats`; warns of what is wrong with them."""
        return {}

    def guess(self, state: Float[Array, " s"], previous: Float[Array, " k"], h: Any, params: Any) -> Float[Array, " k"]:
        """Where Newton's method starts: at the unknowns extrapolated from the steps before."""
        return previous

    def resume(self, data: dict[str, Array], h: Any, params: Any) -> tuple[Float[Array, " s"], Float[Array, " k"]]:
        """Where the step that leaves a saved row begins: the state and a first guess of the unknowns."""
        return self.start(data, h, params)

    @property
    def interpolation(self) -> Callable | None:
        """`interpolate` of the StepEquation, for a method with a polynomial."""
        return None

    @property
    def weak(self) -> tuple[tuple[range, range], ...]:
        """Entries of the Jacobian, as (rows, columns), that Newton's method may leave out."""
        return ()

    @property
    def hermite(self) -> Callable | None:
        """`between` of the StepEquation, for a method of second order in coordinates."""
        return None

    def equation(self) -> StepEquation:
        """The StepEquation of the step."""
        return StepEquation(
            start=self.start,
            residual=self.residual,
            advance=self.advance,
            unpack=self.unpack,
            state_layout=self.state,
            unknown_layout=self.unknowns,
            fields=self.fields,
            labels=self.labels,
            canonical=self.canonical,
            check=self.check,
            remark=self.remark,
            review=self.review,
            guess=self.guess,
            resume=self.resume,
            interpolate=self.interpolation,
            between=self.hermite,
            weak=self.weak,
        )
