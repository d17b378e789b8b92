"""linearize(): the linear equations of small motions about a relative equilibrium, of a system or of a scheme."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dirax.diagnostics.equations_of_motion import determine, equations_of
from dirax.diagnostics.linearized_field import FieldAt, linearized_chain, linearized_lagrangian
from dirax.diagnostics.linearized_step import linearized_step
from dirax.numerics.eigenvalues import RANK, clusters, is_defective, with_errors
from dirax.numerics.tolerances import CONSTRAINT_DEFECT, TINY
from dirax.program.captured import functions_in, refuse_changed
from dirax.program.user_functions import refuse_traced
from dirax.run.final_manifold import is_singular, refuse_off_final_manifold
from dirax.run.own_equation import shape_of
from dirax.run.start import completed
from dirax.run.validate import Case, validated_case
from dirax.schemes.step import AbstractScheme
from dirax.systems.system import AbstractSystem
from dirax.text.tables import text_table

AT_REST = 1e-7
"""Size of the acceleration in the moving frame, relative to its terms, that an equilibrium may have."""

TANGENT = 1e-6
"""How far the linearized equations may lead out of a space that they keep, relative to their size."""

OF_STEPS = (
    "the scheme's relative equilibrium may be another one than that of the system, and symmetries that turn are taken as shifts "
    "in a step: leave scheme= and step= out for the equations of the system."
)
"""Why a relative equilibrium of a system may be none of a step, and the way out."""

ROUNDOFF = 2e-14
"""Error of an entry of the linear equations, relative to the largest one, where nothing is known of more."""

MULTIPLE = 1e-6
"""Error of eigenvalues of which several are one, relative to the largest one, at most."""


@dataclass(frozen=True, eq=False)
class Linearization:
    """ẏ = A y, or y_{k+1} = M y_k: small motions on the constraints, modulo the given symmetries.

    - `matrix` (d, d): A of the system, M of a scheme; `basis` (N, d): the directions y in the coordinates of the state, (q, v)
      or x, and of a scheme its own, orthonormal in natural units of these;
    - `eigenvalues` (d,): of A, or log(μ)/h for the eigenvalues μ of M, by real part, largest first; `multipliers`: μ, None of A;
    - `residual`: how far the place is from a relative equilibrium, relative to the terms of the equations; `error`: how far the
      entries of the matrix may be off, relative to the largest one.
    """

    matrix: np.ndarray
    basis: np.ndarray = field(repr=False)
    residual: float
    step: float | None = None
    error: float = field(default=ROUNDOFF, repr=False)

    @property
    def multipliers(self) -> np.ndarray | None:
        """The eigenvalues of a step; None of a continuous system."""
        return None if self.step is None else _sorted(np.linalg.eigvals(self.matrix))

    @property
    def eigenvalues(self) -> np.ndarray:
        """Rates of growth with frequencies, complex numbers per unit of time."""
        values = np.linalg.eigvals(self.matrix)
        return _sorted(values if self.step is None else np.log(values.astype(complex)) / self.step)

    def __str__(self) -> str:
        """The eigenvalues, one a row, the multipliers of a step beside them, and whether no small motion grows."""
        rows, header = [(_complex(value),) for value in self.eigenvalues], ("eigenvalue",)
        if self.step is not None:
            multipliers = np.exp(self.eigenvalues * self.step)
            rows = [(*row, _complex(value), f"{abs(value):.6g}") for row, value in zip(rows, multipliers, strict=True)]
            header = ("eigenvalue", "multiplier", "its size")
        of = "" if self.step is None else f" of a step of {self.step:.6g}"
        title = f"{len(self.matrix)} linear equations of small motions{of}: {self._verdict}"
        return text_table(header, rows, f"{title}, at a place with the residual {self.residual:.2g}")

    __repr__ = __str__

    @property
    def _verdict(self) -> str:
        if not self.stable:
            return "unstable"
        return "none grows exponentially, but some may grow like t" if self.defective else "stable"

    @property
    def _groups(self) -> tuple[float, np.ndarray, np.ndarray, list[np.ndarray]]:
        """The error of entries of the matrix, its eigenvalues with theirs, and the numbers of those that may be one."""
        error = self.error * np.abs(self.matrix).max(initial=0.0)
        values, errors = with_errors(self.matrix, error)
        return error, values, errors, clusters(values, errors)

    @property
    def defective(self) -> bool:
        """Whether eigenvalues that are one, to their error, have fewer eigenvectors than they are: then some small motions grow
        like t times what the eigenvalue says, as those of a free particle do at rest, q = v t."""
        error, values, _, groups = self._groups
        several = (np.mean(values[together]) for together in groups if len(together) > 1)
        return any(is_defective(self.matrix, complex(value), error) for value in several)

    @property
    def modes(self) -> np.ndarray:
        """The eigenvectors (N, d), in the coordinates of the state and in the order of `eigenvalues`."""
        values, vectors = np.linalg.eig(self.matrix)
        rates = values if self.step is None else np.log(values.astype(complex)) / self.step
        return (self.basis @ vectors)[:, _order(rates)]

    @property
    def stable(self) -> bool:
        """Whether no small motion grows by more than its own eigenvalue may be off: the `error` of the matrix times the condition
        number of the eigenvalue, but at most 1e-6 of the largest one. Eigenvalues that are one grow as their mean."""
        if not len(self.matrix):
            return True
        error, values, errors, groups = self._groups
        for together in groups:
            values[together] = np.mean(values[together])
        most = MULTIPLE * (np.abs(self.matrix) if self.step is None else np.abs(self.eigenvalues)).max()
        rates = np.real(values)
        if self.step is not None:
            with np.errstate(divide="ignore"):
                rates, errors = np.log(np.abs(values)) / self.step, errors / (np.abs(values) * self.step)
                error = error / self.step
        return bool(np.all(rates <= np.fmin(errors, max(most, error))))


def _complex(value: complex) -> str:
    if value.imag == 0:
        return f"{value.real:.6g}"
    return f"{value.real:.6g} {'+' if value.imag > 0 else '−'} {abs(value.imag):.6g}i"


def _order(values: Any) -> np.ndarray:
    return np.lexsort((-values.imag, -np.round(values.real / np.abs(values).max(initial=TINY), 9)))


def _sorted(values: np.ndarray) -> np.ndarray:
    return values[_order(values)]


def linearize(
    system: AbstractSystem,
    at: Mapping[str, Any],
    scheme: AbstractScheme | None = None,
    *,
    step: float | None = None,
    symmetries: Any = (),
    params: Any = None,
) -> Linearization:
    """The linearization of a system at an equilibrium or a relative equilibrium, on its constraints.

    - `at`: the place, {"q": …, "v": …} of a system with a Lagrangian, {"x": …} of another one, the time as "t".
    - `scheme` and `step`: the linearization of this scheme's step instead.
    - `symmetries`: infinitesimal generators ξ(q) -> (n,), in a list or by name. A relative equilibrium moves along a combination
      of them; the linear equations are those in the frame that moves with it, on the quotient by all of them. Without any, it
      may move with a constant velocity along which the equations do not change, and nothing is divided out.

    The equations are Ẋ = X − ξ with the vector field X of the system, restricted to the tangent space of the final manifold
    {W v = 0, g = 0, G v = 0}: for nonholonomic systems the constraint forces depend on the place, and are differentiated too.

        dx.linearize(bicycle.MODEL.system, bicycle.straight(5.0), symmetries=bicycle.SYMMETRIES).eigenvalues

    A singular Lagrangian is linearized on its final manifold, in the coordinates x of the constraint algorithm.

    Raises `ValueError` for a place of other names, one off the constraints or that is no relative equilibrium, where the velocity
    is not determined, and for generators that are no symmetries; `TypeError` for systems on manifolds and on Lie algebras, and
    for those without a Lagrangian where symmetries or a scheme are given.
    """
    generators = list(symmetries.values()) if isinstance(symmetries, Mapping) else list(symmetries)
    if (scheme is None) != (step is None):
        raise ValueError("a scheme is linearized with its step: give scheme= and step= together, or neither.")
    refuse_traced("dx.linearize", at, params, step)
    refuse_changed(functions_in([system, scheme]))
    if system.linearized_as:
        raise TypeError(f"a {type(system).__name__} is not linearized: {system.linearized_as}.")
    wanted = ("x",) if system.lagrangian_form() is None else ("q", "v")
    if not isinstance(at, Mapping) or not set(wanted) <= set(at):
        given = f"{', '.join(map(str, at)) or 'nothing'} was given" if isinstance(at, Mapping) else f"{at!r:.80} was given"
        place = ", ".join(f'"{name}": …' for name in wanted)
        raise ValueError(f"the place at which a {type(system).__name__} is linearized is {{{place}}}, but {given}.")
    at, params, case = _one_place(system, at, params)
    singular = case is not None and _is_singular(system, case)
    if singular and (scheme is not None or generators):
        raise ValueError(
            "the Lagrangian is singular at the place (∂²L/∂v²): its equations are linearized on its final manifold, without "
            "scheme= and symmetries=."
        )
    if singular:
        return _reduced(linearized_chain(system.lagrangian_form(), at, params), None)
    if system.lagrangian_form() is None:
        if scheme is not None or generators:
            raise TypeError(
                f"schemes and symmetries are linearized of systems with a Lagrangian, but this is a {type(system).__name__}."
            )
        return _reduced(linearized_chain(system, at, params), None)
    found = linearized_lagrangian(system.lagrangian_form(), at, generators, params)
    if scheme is None:
        return _reduced(found, None)
    _reduced(found, None)  # the premises are those of the system
    return _reduced(linearized_step(system, scheme, step, at, found, params), step)


def _one_place(system: AbstractSystem, at: Mapping[str, Any], params: Any) -> tuple[dict[str, Any], Any, Case | None]:
    """The place and the params as arrays, and as initial data of a Lagrangian. Raises `ValueError` for several places, and for
    numbers that are none of the system."""
    case = validated_case({name: a for name, a in at.items() if name != "t"}, params, False, 1.0, at.get("t", 0.0))
    if case.batch is not None:
        shapes = ", ".join(f"{name} has shape {np.shape(a)}" for name, a in case.data.items())
        raise ValueError(f"a system is linearized at one place, but {shapes}: give that of one.")
    system.sizes(*case.first)
    place = {**case.data, **({"t": at["t"]} if "t" in at else {})}
    return place, case.params, case if "q" in case.data else None


def _is_singular(system: AbstractSystem, case: Case) -> bool:
    """Whether ∂²L/∂v² is singular at the place, and the constraints do not make it regular. Raises `ValueError` where the place
    is off the constraints, or no motion passes it."""
    form = system.lagrangian_form()
    initial = completed(form, case, False)
    defect, size = np.ravel(initial.defect), np.ravel(initial.size)[: np.size(initial.defect)]
    if np.any(np.abs(defect) > CONSTRAINT_DEFECT * size):
        raise ValueError(
            f"the place is off the constraint, whose residual is {np.array2string(defect, precision=4)} (largest "
            f"{np.abs(defect).max():.3g}): a motion is linearized that keeps them."
        )
    if not is_singular(form, shape_of(form, *case.first), case, initial):
        return False
    if determine(equations_of(form, case.t0), np.concatenate([case.data["q"], case.data["v"]]), case.params):
        return False
    refuse_off_final_manifold(form, case, initial)
    return True


def _reduced(found: FieldAt, step: float | None) -> Linearization:
    if step is not None and not found.residual <= AT_REST:
        raise ValueError(
            f"the place is no relative equilibrium of the step, which leaves {found.residual:.3g} of its terms: {OF_STEPS}"
        )
    if not found.residual <= AT_REST:
        raise ValueError(
            f"the place is no relative equilibrium: in the frame that moves with it the equations leave {found.residual:.3g} of "
            "their terms. Give initial data that stay as they are, or the symmetries= along which they move."
        )
    tangent = _orthonormal(found.tangent)
    size = np.abs(found.matrix).max(initial=0.0)
    for name, space in (("the constraints", tangent), ("the symmetries", _orthonormal(found.symmetric))):
        image = found.matrix @ space
        outside = np.abs(image - space @ (space.T @ image)).max(initial=0.0)
        if outside > TANGENT * size:
            way = "the generators must be symmetries of the system" if name == "the symmetries" else "report this"
            way = f"{way}." if step is None else OF_STEPS
            raise ValueError(f"the linear equations lead out of {name} by {outside:.3g}: {way}")
    across = tangent - _project(found.symmetric, tangent)
    basis = _orthonormal(across)
    matrix = found.rate * (basis.T @ found.matrix @ basis)
    largest = np.abs(matrix).max(initial=0.0)  # which may be roundoff of what was there before
    error = (ROUNDOFF + float(found.residual) + found.error) * max(1.0, found.rate * size / largest if largest > 0.0 else 1.0)
    return Linearization(matrix, found.units[:, None] * basis, float(found.residual), step, error)


def _project(space: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    basis = _orthonormal(space)
    return basis @ (basis.T @ vectors)


def _orthonormal(vectors: np.ndarray) -> np.ndarray:
    """An orthonormal basis of the span of the columns, without any where all of them are roundoff of unit vectors."""
    if not vectors.size:
        return vectors.reshape(len(vectors), -1)[:, :0]
    u, values, _ = np.linalg.svd(vectors, full_matrices=False)
    return u[:, values > RANK * (values[0] if values[0] > RANK else 1.0)]
