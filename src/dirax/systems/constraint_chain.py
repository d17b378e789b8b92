"""ConstraintChain: what the constraint algorithm found, as functions; and the resolved system on the final manifold."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dirax.numerics.arrays import Data, Numbers
from dirax.numerics.tolerances import OFF_MANIFOLD
from dirax.program.roots import nearest_root
from dirax.program.tracing import gradient, jacobian, once
from dirax.program.user_functions import evaluated, is_traced, scalar_program
from dirax.systems.forms import FinalManifold
from dirax.systems.magnitudes import power_of
from dirax.systems.shape import Shape
from dirax.systems.system import AbstractSystem

DETERMINED, GAUGE, EMPTY, IRREGULAR = "determined", "gauge freedom", "empty", "irregular"


@dataclass(frozen=True)
class ConstraintLevel:
    """One manifold M_k of the chain: its dimension, its new constraints `constraints(x, params) -> (count,)`, and remarks."""

    number: int
    dimension: int
    count: int
    rank: int
    constraints: Callable = field(repr=False)
    note: str = ""

    def to_dict(self) -> dict[str, Any]:
        """The level without its functions, as plain Python values."""
        return {key: getattr(self, key) for key in ("number", "count", "dimension", "rank", "note")}


@dataclass(frozen=True, eq=False)
class ConstraintChain:
    """The chain M_0 ⊃ M_1 ⊃ … ⊃ M_f of an implicit system around a point ([BLM] §3); prints as a table.

    - `levels`: the manifolds M_k; `dimension`: that of M_f; `point` (N,): a point of M_f (of the last level reached).
    - `index`: how often constraints are differentiated until (ẋ, u) is determined, or as far as it ever is.
    - `verdict`: "determined", "gauge freedom", "empty" or "irregular", and `explanation` in words.
    - `coordinates` and `multiplier_names`; with a `clock` the last coordinate is the time, which no projection moves. A point x
      may then be given without it too, beside `t=`, by default that of `point`; what comes back is without it as well.
    - `freedom`: the number of undetermined directions of ẋ; `redundant`: that of undetermined multipliers.
    - `units` (N,): the sizes of the coordinates, powers of two, in which distances between points are measured.

    The functions are traceable, inside runs too. Their bases were chosen at `point`; where the pivots of these vanish further
    away, others are taken there.
    """

    levels: tuple[ConstraintLevel, ...]
    point: np.ndarray
    index: int
    verdict: str
    explanation: str
    freedom: int
    redundant: int
    coordinates: tuple[str, ...]
    multiplier_names: tuple[str, ...]
    clock: bool
    params: Any = field(repr=False)
    units: np.ndarray = field(repr=False)
    _constraints: Callable = field(repr=False)
    _solution: Callable | None = field(repr=False)
    _kernel: Callable | None = field(repr=False)
    _energy: Callable = field(repr=False)

    # ------------------------------------------------------------------ the final manifold

    @property
    def dimension(self) -> int:
        """The dimension of M_f, −1 where it is empty; of the last level reached where the search ended irregular."""
        if self.verdict == EMPTY:
            return -1
        return self.levels[-1].dimension if self.levels else len(self.coordinates)

    @property
    def empty(self) -> bool:
        """Whether no point near the given one has a velocity that stays."""
        return self.verdict == EMPTY

    def constraints(self, x: Float[Numbers, " N"], params: Any = None, t: Any = None) -> Float[Numbers, " c"]:
        """All constraint functions of M_f at x, level by level."""
        return self._at(self._constraints, x, params, t)

    def field(self, x: Float[Numbers, " N"], params: Any = None, t: Any = None) -> Float[Numbers, " N"]:
        """The tangent field ẋ on M_f; where it is not unique, the one without a part in the undetermined directions, in `units`.

        Raises `ValueError` for a chain that ended empty or irregular.
        """
        return self._at(self._solved(), x, params, t)[: np.shape(x)[0]]

    def multipliers(self, x: Float[Numbers, " N"], params: Any = None, t: Any = None) -> Float[Numbers, " m"]:
        """The multipliers u that keep x on M_f, in the order of `multiplier_names`. Raises as `field`."""
        return self._at(self._solved(), x, params, t)[len(self.coordinates) :]

    def gauge(self, x: Float[Numbers, " N"], params: Any = None, t: Any = None) -> Float[Numbers, "N freedom"]:
        """A basis, by columns, of the directions of ẋ that the equations leave free. Raises as `field`."""
        if self._kernel is None:
            raise ValueError(f"this constraint chain has no final manifold: {self.explanation}")
        return self._at(self._free_directions, x, params, t)[: np.shape(x)[0]]

    def project(self, x: Float[Numbers, " N"], params: Any = None, t: Any = None) -> Float[Numbers, " N"]:
        """The point y of M_f nearest to x in `units` U: y + U²Dφ(y)ᵀσ = x, φ(y) = 0. Differentiable."""
        self._solved()
        return self._at(self._nearest, x, params, t)[: np.shape(x)[0]]

    def normal(self, covector: Float[Numbers, " N"]) -> Float[Numbers, " N"]:
        """The vector that a combination of the dφ pushes points along: normal to M_f in `units`, without the time's part."""
        vector = covector * self.units**2
        return vector.at[-1].set(0.0) if self.clock else vector

    def check(self, x: Float[Numbers, " N"], params: Any = None, t: Any = None) -> None:
        """Raise `ValueError` for a point off M_f, with the first level it is off, the values, and its projection."""
        if not is_traced(x, self._with(params), t) and (text := self.off(x, params, t)):
            raise ValueError(f"{text}: start from chain.project(x).")

    def off(self, x: Float[Numbers, " N"], params: Any = None, t: Any = None) -> str:
        """The first level that x is off, the values of its constraints and the nearest point of M_f, in words; "" on M_f."""
        if not (off := self.off_level(x, params, t)):
            return ""
        where = np.asarray(self.project(x, params, t))
        distance = np.linalg.norm(where - np.asarray(x))
        return f"{off}. The nearest point of M_f is {np.array2string(where, precision=6)}, at distance {distance:.3g}"

    def off_level(self, x: Float[Numbers, " N"], params: Any = None, t: Any = None) -> str:
        """The first level that x is off and the values of its constraints, in words; "" on M_f."""
        params, x = self._with(params), self._whole(x, t)
        for level in self.levels:
            value, slope = map(np.asarray, self._at(once(_with_slope, level.constraints), x, params))
            slope, size = np.abs(slope * self.units).max(initial=0.0), np.abs(np.asarray(x) / self.units).max()
            if np.abs(value).max(initial=0.0) > OFF_MANIFOLD * slope * (1.0 + size):
                return (
                    f"x is off M_{level.number}: its {level.count} new constraint{'s' * (level.count > 1)} there "
                    f"{'have the values' if level.count > 1 else 'has the value'} {np.array2string(value, precision=4)}"
                )
        return ""

    def resolved(self) -> "ResolvedSystem":
        """The system ẋ = field(x) on M_f, for Method 2: `dx.simulate(chain.resolved(), dx.DiscreteDirac(), x=…)`.

        Raises as `field`; with gauge freedom it is the field that `field` chooses.
        """
        self._solved()
        return ResolvedSystem(self)

    def _solved(self) -> Callable:
        if self._solution is None:
            raise ValueError(f"this constraint chain has no final manifold: {self.explanation}")
        return self._solution

    def _with(self, params):
        return self.params if params is None else params

    def _whole(self, x, t) -> Any:
        """x with all its coordinates. Raises `ValueError`."""
        given, size = np.shape(x), len(self.coordinates)
        if given == (size,) and t is None:
            return x
        if self.clock and given == (size - 1,):
            end = self.point[-1] if t is None else t
            return jnp.append(x, end) if is_traced(x, end) else np.append(x, end)
        without = f", or ({size - 1},) without t" if self.clock else ""
        beside = f" beside t={t!r:.20}" if t is not None else ""
        raise ValueError(
            f"x must have shape ({size},) = ({', '.join(self.coordinates)}){without}, but it has shape {given}{beside}."
        )

    def _at(self, function: Callable, x, params, t=None):
        """A function of (x, params), at concrete values without a compiler."""
        params, x = self._with(params), self._whole(x, t)
        traced = is_traced(x, params)
        return scalar_program(function, x, params) if traced else evaluated(function, np.asarray(x, dtype=float), params)

    def _nearest(self, x, params):
        multipliers = jnp.zeros(sum(level.count for level in self.levels))

        def residual(u):
            y, sigma = u[: x.shape[0]] * self.units, u[x.shape[0] :]
            pull = gradient(lambda y: self.constraints(y, params) @ sigma)(y)
            return jnp.concatenate([(y + self.normal(pull) - x) / self.units, self.constraints(y, params)])

        return nearest_root(residual, jnp.concatenate([x / self.units, multipliers]))[: x.shape[0]] * self.units

    def _free_directions(self, x, params):
        """A basis of them that is orthonormal in `units`."""
        assert self._kernel is not None
        units = self.units[:, None]
        kernel = self._at(self._kernel, x, params)[: len(self.coordinates)] / units
        return jnp.linalg.svd(kernel, full_matrices=False)[0][:, : self.freedom] * units

    # ------------------------------------------------------------------ how it shows itself

    def to_dict(self) -> dict[str, Any]:
        """The table as plain Python values."""
        rows = [level.to_dict() for level in self.levels]
        keys = ("index", "verdict", "explanation", "freedom", "redundant", "dimension")
        return {"levels": rows, **{key: getattr(self, key) for key in keys}}

    def __str__(self) -> str:
        header = ("level", "new constraints", "dim M_k", "rank of the equations of (ẋ, u)", "")
        rows = [(f"M_{v.number}", str(v.count), str(v.dimension), str(v.rank), v.note) for v in self.levels]
        widths = [max(len(row[i]) for row in (header, *rows)) for i in range(4)]
        cells = lambda row: (*(cell.ljust(w) for cell, w in zip(row, widths, strict=False)), row[4])
        lines = ["  ".join(cells(row)).rstrip() for row in (header, *rows)]
        end = f"{self.verdict}, index {self.index}: {self.explanation}"
        return "\n".join([lines[0], "─" * (sum(widths) + 6), *lines[1:], end])


def _with_slope(constraints: Callable, x, params):
    return constraints(x, params), jacobian(lambda x: constraints(x, params))(x)


class ResolvedSystem(AbstractSystem):
    """ẋ = X(x) on the final manifold M_f = {φ = 0} of a constraint chain; made by `ConstraintChain.resolved`."""

    chain: ConstraintChain = eqx.field(static=True)

    def sizes(self, data: Data, params: Any) -> tuple[int, int]:
        size = len(self.chain.coordinates)
        if "x" not in data or data["x"].shape != (size,):
            raise ValueError(f"the resolved system starts from x= of shape ({size},) = {', '.join(self.chain.coordinates)}.")
        return size, sum(level.count for level in self.chain.levels)

    def complete(self, data: Data, params: Any, project: bool) -> Data:
        x = self.chain.project(data["x"], params) if project else data["x"]
        return {"x": x, "velocity": self.chain.field(x, params)}

    @property
    def has_clock(self) -> bool:
        return self.chain.clock

    def clock(self, data: Mapping[str, Any]) -> Any:
        return data["x"][..., -1]

    def initial_defect(self, data: Data, params: Any) -> Float[Numbers, " m"]:
        """φ(x)."""
        return self.chain.constraints(data["x"], params)

    def initial_terms(self, data: Data, params: Any) -> Float[Numbers, " m"]:
        """The largest derivative of each in the units of the chain, times the size of x in them, as in `ConstraintChain.off`."""
        x, units = data["x"], self.chain.units
        slopes = jacobian(lambda x: self.chain.constraints(x, params))(x) * units[None]
        return jnp.max(jnp.abs(slopes), axis=1, initial=0.0) * (1.0 + jnp.max(jnp.abs(x) / units))

    def final_manifold(self, shape: Shape) -> FinalManifold:
        """M_f, projected onto by the nearest point."""
        chain = self.chain
        count, forces = sum(level.count for level in chain.levels), len(chain.multiplier_names)
        nearest = lambda x, covector, params: chain.normal(covector)
        return FinalManifold(chain.constraints, count, chain.field, chain.multipliers, forces, nearest)

    def explain(self, x: Float[Numbers, " N"]) -> str:
        """Which manifold of the chain a point is off, and the nearest point of M_f."""
        return self.chain.off(x)

    def energy_at(self, row: Data, params: Any) -> Float[Numbers, ""]:
        """The energy of the system that the chain came from."""
        return self.chain._energy(row["x"], self.chain._with(params))

    @property
    def has_power(self) -> bool:
        return True

    def power_at(self, row: Data, params: Any) -> Float[Numbers, " 2"]:
        return power_of(self.chain._energy, row["x"], self.chain.field(row["x"], params), self.chain._with(params))

    def constraint_at(self, row: Data, params: Any) -> Float[Numbers, " m"]:
        return self.chain.constraints(row["x"], params)

    @property
    def has_constraint_sizes(self) -> bool:
        return True

    def constraint_sizes_at(self, row: Data, params: Any) -> Float[Numbers, " m"]:
        """Those of `initial_terms`: a constraint of one term, that a current is zero, has no other size."""
        return self.initial_terms(row, params)
