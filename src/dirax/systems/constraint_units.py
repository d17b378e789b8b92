"""Units in which the constraint algorithm measures: of the coordinates x, of the time, of the multipliers u and of the equations.

They are powers of two that bring the numbers of A(x) (ẋ, u) = b(x) at one point near 1, as far as their products go: with e the
logarithms of the entries, of the slopes ∂A/∂x and ∂b/∂x, of b and of x itself,

    A_ij: r_i − x_j + τ,   A_ik: r_i − u_k,   ∂A_ij/∂x_k: r_i − x_j + τ − x_k,   ∂b_i/∂x_j: r_i − x_j,   b_i: r_i,   x_j: x_j

are least squares for the logarithms r, x, u, τ of the units. In other units of the system, by powers of two, all numbers of the
search are the same to the last bit. What these do not determine is like coordinates of the same letter, and where all of them
are undetermined (a point where all of x is zero) near 1.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from dirax.numerics.equilibration import NOISE, ODD
from dirax.program.tracing import gradient, jacobian, once
from dirax.program.user_functions import evaluated
from dirax.systems.forms import ImplicitForm
from dirax.systems.magnitudes import MOST as MOST_OF_ENERGY
from dirax.systems.magnitudes import as_large_as_energy

UNDETERMINED = 2.0**-24
"""Weight of a logarithm's being zero, beside what determines it."""

ALIKE = 2.0**-14
"""That of the difference of those of two coordinates of one letter: one that nothing else determines is like the others."""

APART = 8.0
"""Coordinates of one letter, q say, have units of their own where their sizes differ by more powers of two; else one: lengths
along two axes are not to be measured differently because of the point."""

MOST = 400
"""Coordinates and multipliers up to which their units are looked for: one matrix of all of them."""


FEW = 2**16
"""Slopes of the entries of A up to which they are looked at."""


ROUNDOFF = 2.0**-40
"""Of a size, what counts as zero."""


class Units(NamedTuple):
    """Sizes of the coordinates (N,), of the time, of the multipliers (k,) and of the equations (r,)."""

    coordinates: np.ndarray
    time: float
    multipliers: np.ndarray
    equations: np.ndarray

    def of_x(self, function: Callable, unit: np.ndarray | float = 1.0) -> Callable:
        """A function of (x, params) with x in these units, and values in the given ones, as one of the system's own x."""
        return once(lambda x, params: function(x / self.coordinates, params) * unit)


def natural_units(form: ImplicitForm, params) -> Units:
    """Those of an implicit form at its point, in which coordinates that are the roundoff of zero have no size."""
    form = form._replace(point=_without_roundoff(form, params))
    matrix, right = (np.asarray(a) for a in evaluated(form.equations, form.point, params))
    count, size = matrix.shape[0], form.point.size
    plain = Units(np.ones(size), 1.0, np.ones(matrix.shape[1] - size), np.ones(count))
    if matrix.shape[1] > MOST:
        return plain
    first = 0 if matrix.size * size <= FEW else matrix.shape[1]
    columns = lambda x, params: jnp.column_stack(form.equations(x, params))[:, first:]
    slope = once(lambda x, params: jacobian(lambda x: columns(x, params))(x))
    both = np.asarray(evaluated(slope, form.point, params))
    turning, slopes = both[:, :-1], both[:, -1]
    if not all(np.all(np.isfinite(a)) for a in (matrix, right, both)):
        return plain
    unknowns = matrix.shape[1] + 1  # x, τ and u, before the equations
    i, j = np.nonzero(matrix)
    (k, l), m, there, rates = np.nonzero(slopes), np.flatnonzero(right), np.flatnonzero(form.point), j < size
    terms = Terms(unknowns + count)
    terms.add(matrix[i, j][rates], i[rates], (unknowns + i[rates], 1.0), (j[rates], -1.0), (size, 1.0))
    terms.add(matrix[i, j][~rates], i[~rates], (unknowns + i[~rates], 1.0), (j[~rates] + 1, -1.0))
    for of_rates in (True, False):  # an angle may stand in A alone
        e, f, g = np.nonzero(turning[:, :size] if of_rates else turning[:, size:])
        unit = ((f, -1.0), (size, 1.0)) if of_rates else ((size + 1 + f, -1.0),)
        terms.add(turning[e, f if of_rates else size + f, g], e, (unknowns + e, 1.0), *unit, (g, -1.0))
    terms.add(slopes[k, l], k, (unknowns + k, 1.0), (l, -1.0))
    terms.add(right[m], m, (unknowns + m, 1.0))
    terms.add(form.point[there], None, (there, 1.0))
    units = terms.units((slice(0, size), form.coordinates))
    return Units(units[:size], float(units[size]), units[size + 1 : unknowns], units[unknowns:])


def _without_roundoff(form: ImplicitForm, params: Any) -> np.ndarray:
    """The point, with 0 for coordinates that are roundoff beside what they would be with all the energy there, and beside others
    of their letter: one that hardly has any energy could be large."""
    point = np.asarray(form.point, float)
    if point.size > MOST_OF_ENERGY:
        return point
    slope = gradient(lambda x: form.energy(x, params))
    possible = np.asarray(evaluated(lambda x: as_large_as_energy(slope, x), point))
    letters = np.array([name.rstrip("0123456789") for name in form.coordinates])
    others = np.max(np.where(letters[:, None] == letters, np.abs(point), 0.0), axis=1, initial=0.0)
    return np.where(np.abs(point) <= ROUNDOFF * np.minimum(possible, others), 0.0, point)  # of no energy NaN: none is


class Terms:
    """Numbers that are products of so many units and of numbers near 1."""

    def __init__(self, count: int):
        self.count = count
        self.logarithms: list[np.ndarray] = []
        self.rows: list[np.ndarray] = []
        self.equations: list[np.ndarray] = []

    def add(self, values: np.ndarray, equations: np.ndarray | None, *units: tuple[Any, float | np.ndarray]) -> None:
        """Values, the equations in which they stand, if in any, and for each the units, as places and powers, it is made of."""
        rows = np.zeros((len(values), self.count))
        for places, power in units:
            rows[np.arange(len(values)), places] += power
        self.logarithms.append(np.frexp(np.abs(values))[1].astype(float))
        self.rows.append(rows)
        self.equations.append(np.full(len(values), -1) if equations is None else equations)

    def units(self, *named: tuple[slice, tuple[str, ...]]) -> np.ndarray:
        """The units, powers of two; those in `named` places belong to coordinates of these names."""
        logarithms, design, equations = (np.concatenate(a) for a in (self.logarithms, self.rows, self.equations))
        ties = self._ties(named)
        found = _fitted(design, logarithms, ties)
        left = logarithms - design @ found
        last = np.max(equations, initial=-1)
        largest = np.array([np.max(left[equations == e], initial=-np.inf) for e in range(last + 1)] + [0.0])  # those in none
        noise = left < largest[equations] - NOISE
        if np.any(noise):
            found = _fitted(design[~noise], logarithms[~noise], ties)
        for places, names in named:
            found[places] = _of_kinds(found[places], names)
        return np.ldexp(1.0, np.round(found - ODD).astype(int))

    def _ties(self, named: tuple[tuple[slice, tuple[str, ...]], ...]) -> np.ndarray:
        """Rows for the differences of coordinates of one letter."""
        rows = [np.zeros((0, self.count))]
        for places, names in named:
            letters = np.array([name.rstrip("0123456789") for name in names])
            for letter in dict.fromkeys(letters.tolist()):
                own = places.start + np.flatnonzero(letters == letter)
                rows.append(np.eye(self.count)[own[1:]] - np.eye(self.count)[own[:-1]])
        return np.concatenate(rows)


def _of_kinds(logarithms: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """The same logarithm for coordinates of one letter whose own ones leave no gap: the means."""
    found, letters = logarithms.copy(), np.array([name.rstrip("0123456789") for name in names])
    for letter in dict.fromkeys(letters.tolist()):
        places = np.flatnonzero(letters == letter)
        places = places[np.argsort(logarithms[places], kind="stable")]
        for kind in np.split(places, np.flatnonzero(np.diff(logarithms[places]) > APART) + 1):
            found[kind] = np.mean(logarithms[kind])
    return found


def _fitted(design: np.ndarray, logarithms: np.ndarray, ties: np.ndarray) -> np.ndarray:
    size = design.shape[1]
    rows = np.concatenate([design, ALIKE * ties, UNDETERMINED * np.eye(size)])
    return np.linalg.lstsq(rows, np.concatenate([logarithms, np.zeros(len(ties) + size)]), rcond=None)[0]


def in_units(form: ImplicitForm, units: Units) -> ImplicitForm:
    """The form for x, ẋ, u in these units."""
    columns = np.concatenate([units.coordinates / units.time, units.multipliers])

    @once
    def equations(x, params):
        matrix, right = form.equations(x * units.coordinates, params)
        return matrix * columns[None] / units.equations[:, None], right / units.equations

    own = form.hessian
    hessian = None if own is None else lambda x, params: own(x * units.coordinates, params)
    return form._replace(equations=equations, point=np.asarray(form.point) / units.coordinates, hessian=hessian)
