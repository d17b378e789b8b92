"""Units in which the constraint algorithm measures: of the coordinates x, of the time, of the multipliers u and of the equations.

They are powers of two that bring the numbers of A(x) (ẋ, u) = b(x) at one point near 1, as far as their products go: with e the
logarithms of the entries, of the slopes ∂b/∂x, of b and of x itself,

    A_ij: r_i − x_j + τ,   A_ik: r_i − u_k,   ∂b_i/∂x_j: r_i − x_j,   b_i: r_i,   x_j: x_j

are least squares for the logarithms r, x, u, τ of the units. In other units of the system, by powers of two, all numbers of the
search are the same to the last bit. What these do not determine (a point where all of x is zero) is taken to be near 1.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from dirax.numerics.equilibration import NOISE, ODD
from dirax.program.tracing import jacobian, once
from dirax.program.user_functions import evaluated
from dirax.systems.forms import ImplicitForm

UNDETERMINED = 2.0**-20
"""Weight of a logarithm's being zero, beside what determines it."""

APART = 8.0
"""Coordinates of one letter, q say, have units of their own where their sizes differ by more powers of two; else one: lengths
along two axes are not to be measured differently because of the point."""

MOST = 400
"""Coordinates and multipliers up to which their units are looked for: one matrix of all of them."""


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
    """Those of an implicit form at its point."""
    matrix, right = (np.asarray(a) for a in evaluated(form.equations, form.point, params))
    count, size = matrix.shape[0], form.point.size
    plain = Units(np.ones(size), 1.0, np.ones(matrix.shape[1] - size), np.ones(count))
    if matrix.shape[1] > MOST:
        return plain
    slope = once(lambda x, params: jacobian(lambda x: form.equations(x, params)[1])(x))
    slopes = np.asarray(evaluated(slope, form.point, params))
    if not all(np.all(np.isfinite(a)) for a in (matrix, right, slopes)):
        return plain
    unknowns = matrix.shape[1] + 1  # x, τ and u, before the equations

    def terms(values, *units):
        """The logarithms of values, and the rows for the units, places and powers, that they are products of."""
        rows = np.zeros((len(values), unknowns + count))
        for places, power in units:
            rows[np.arange(len(values)), places] = power
        return np.frexp(np.abs(values))[1].astype(float), rows

    i, j = np.nonzero(matrix)
    (k, l), m, there, rates = np.nonzero(slopes), np.flatnonzero(right), np.flatnonzero(form.point), j < size
    given = [
        terms(matrix[i, j][rates], (unknowns + i[rates], 1.0), (j[rates], -1.0), (size, 1.0)),
        terms(matrix[i, j][~rates], (unknowns + i[~rates], 1.0), (j[~rates] + 1, -1.0)),
        terms(slopes[k, l], (unknowns + k, 1.0), (l, -1.0)),
        terms(right[m], (unknowns + m, 1.0)),
        terms(form.point[there], (there, 1.0)),
    ]
    logarithms, design = (np.concatenate(a) for a in zip(*given, strict=True))
    equation = np.concatenate([i[rates], i[~rates], k, m, np.full(there.size, -1)])
    found = _fitted(design, logarithms)
    left = logarithms - design @ found
    largest = np.array([np.max(left[equation == e], initial=-np.inf) for e in range(count)] + [0.0])  # the last of x
    noise = left < largest[equation] - NOISE
    if np.any(noise):
        found = _fitted(design[~noise], logarithms[~noise])
    found[:size] = _of_kinds(found[:size], form.coordinates)
    units = np.ldexp(1.0, np.round(found - ODD).astype(int))
    return Units(units[:size], float(units[size]), units[size + 1 : unknowns], units[unknowns:])


def _of_kinds(logarithms: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """The same logarithm for coordinates of one letter whose own ones leave no gap: the means."""
    found, letters = logarithms.copy(), np.array([name.rstrip("0123456789") for name in names])
    for letter in dict.fromkeys(letters.tolist()):
        places = np.flatnonzero(letters == letter)
        places = places[np.argsort(logarithms[places], kind="stable")]
        for kind in np.split(places, np.flatnonzero(np.diff(logarithms[places]) > APART) + 1):
            found[kind] = np.mean(logarithms[kind])
    return found


def _fitted(design: np.ndarray, logarithms: np.ndarray) -> np.ndarray:
    size = design.shape[1]
    return np.linalg.lstsq(
        np.concatenate([design, UNDETERMINED * np.eye(size)]), np.concatenate([logarithms, np.zeros(size)]), rcond=None
    )[0]


def in_units(form: ImplicitForm, units: Units) -> ImplicitForm:
    """The form for x, ẋ, u in these units."""
    columns = np.concatenate([units.coordinates / units.time, units.multipliers])

    @once
    def equations(x, params):
        matrix, right = form.equations(x * units.coordinates, params)
        return matrix * columns[None] / units.equations[:, None], right / units.equations

    return form._replace(equations=equations, point=np.asarray(form.point) / units.coordinates)
