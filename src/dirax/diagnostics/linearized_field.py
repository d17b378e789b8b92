"""The derivative of the vector field of a system at a relative equilibrium, with the spaces that it keeps."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from dirax.diagnostics.equations_of_motion import RANK, Equations, equations_of, kernel, linear
from dirax.numerics.equilibration import power_of_two
from dirax.numerics.tolerances import TINY
from dirax.program.memo import Memo
from dirax.program.tracing import along, jacobian
from dirax.program.user_functions import evaluated
from dirax.systems.constraint_algorithm import constraint_algorithm
from dirax.systems.constraint_chain import DETERMINED
from dirax.systems.lagrange_dirac import LagrangeDirac

SLOWEST = 1e-2
"""Eigenvalues of several rows that are zero may come out as such a part of the largest entries."""

NO_SYMMETRY, ROUNDOFF = 1e-6, 1e-9
"""Change of a Lagrangian along a generator, relative to its terms, from which on it is no symmetry, and what is nothing but
roundoff, relative to its changes along coordinates."""

OFF = 1e-6
"""How far from its final manifold, relative to its size, a place may be."""

WHILE = 0.75
"""How long a constant velocity is followed, in units of the time of small motions."""


class FieldAt(NamedTuple):
    """The matrix (N, N) of the linear equations in the frame that moves with the motion, and the columns that span the tangent
    space of the constraints and the directions of the symmetries; how far the place is from a relative equilibrium.

    All of it is in `units` (N,) of the coordinates, and with times of 1/`rate`. `error`: what rounding may have made of the
    entries of the matrix, relative to the largest one, where that is known."""

    matrix: np.ndarray
    tangent: np.ndarray
    symmetric: np.ndarray
    residual: float
    units: np.ndarray
    rate: float
    error: float = 0.0


def linearized_lagrangian(system: LagrangeDirac, at: Mapping[str, Any], generators: Sequence[Callable], params: Any) -> FieldAt:
    """Of a Lagrangian with constraints, in z = (q, v)."""
    q, v = (np.asarray(at[name], float) for name in ("q", "v"))
    n, z, equations = q.size, np.concatenate([q, v]), equations_of(system, float(at.get("t", 0.0)))
    w, unmoved = linear(equations, z, params)
    derivative, flow = unmoved.copy(), np.concatenate([v, w[:n]])
    lifted, slopes = [], []
    for generator in generators:
        moved, slope, bend = _lifted(generator, q, v)
        lifted.append(moved)
        slopes.append((slope, bend))
    symmetric = np.stack(lifted, axis=1) if lifted else np.zeros((2 * n, 0))
    energy, forces, metric = (np.asarray(a) for a in evaluated(equations.sizes, q, v, w[n:], params))
    units, rate = _units(energy, forces, metric, v, derivative)
    tangent = _tangent(equations, z, params, units)
    field, symmetric = flow / units / rate, symmetric / units[:, None]
    if lifted:
        sizes = power_of_two(np.abs(symmetric).max(axis=0))
        symmetric = symmetric / sizes
        shares = np.linalg.lstsq(symmetric, field, rcond=RANK)[0]
        residual = np.abs(field - symmetric @ shares).max() / (1.0 + np.abs(field).max())
        for share, (slope, bend) in zip(shares / sizes * rate, slopes, strict=True):
            derivative[:n, :n] -= share * slope
            derivative[n:, n:] -= share * slope
            derivative[n:, :n] -= share * bend
    else:
        residual = np.abs(field[n:]).max() / (1.0 + np.abs(field).max())
    if lifted and system.constraints.holonomic is None:
        _refuse_no_symmetry(equations, z, units, generators, params)
    if system.depends_on_time or (np.any(v) and not lifted):
        later = equations_of(system, equations.t + WHILE / rate) if system.depends_on_time else equations
        there = z if lifted else z + np.concatenate([v, np.zeros(n)]) * (WHILE / rate)
        residual = max(residual, _changed(later, there, params, (flow, unmoved, tangent, units, rate)))
    return FieldAt(scaled_matrix(derivative, units) / rate, tangent, symmetric, residual, units, rate)


def _tangent(equations: Equations, z: np.ndarray, params: Any, units: np.ndarray) -> np.ndarray:
    """The tangent space of the constraints at z, in these units."""
    if not equations.system.constraints.any:
        return np.eye(z.size)
    return kernel(np.asarray(evaluated(equations.tangent, z, params)) * units)


def _refuse_no_symmetry(equations: Equations, z: np.ndarray, units: np.ndarray, generators: Sequence, params: Any) -> None:
    """Raise `ValueError` for a generator along which the Lagrangian changes near z."""
    q, v = np.split(z + units * np.random.default_rng(z.size).uniform(0.2, 0.6, z.size), 2)
    by_q, by_v = (np.asarray(a) for a in evaluated(equations.slopes, q, v, params))
    for number, generator in enumerate(generators):
        moved, by = _lifted(generator, q, v)[0], np.concatenate([by_q, by_v])
        terms, roundoff = by * moved, ROUNDOFF * (np.abs(by) @ units) * np.max(np.abs(moved) / units)
        if abs(np.sum(terms)) > max(NO_SYMMETRY * np.sum(np.abs(terms)), roundoff):
            raise ValueError(
                f"the generators must be symmetries of the system, but along number {number} the Lagrangian changes by "
                f"{abs(np.sum(terms)):.3g} near the place, where its terms change by {np.sum(np.abs(terms)):.3g}."
            )


def _changed(equations: Equations, there: np.ndarray, params: Any, here: tuple) -> float:
    """How much other equations are at another place than those `here`: the field, the linear equations, relative to their terms,
    and the tangent space of the constraints."""
    field, derivative, tangent, units, rate = here
    n = there.size // 2
    w, slopes = linear(equations, there, params)
    found = np.concatenate([there[n:], w[:n]])
    moved, accelerated = scaled_matrix(slopes - derivative, units) / rate, np.abs(found - field) / units / rate
    size = 1.0 + np.abs(scaled_matrix(derivative, units)).max() / rate
    turned = _tangent(equations, there, params, units)
    if turned.shape != tangent.shape:
        return 1.0
    out = np.abs(turned - tangent @ (tangent.T @ turned)).max(initial=0.0)
    along = accelerated.max() / (1.0 + np.max(np.abs(field) / units / rate))
    return float(max(along, np.abs(moved @ tangent).max(initial=0.0) / size, out))


def _units(
    energy: np.ndarray, forces: np.ndarray, metric: np.ndarray, v: np.ndarray, derivative: np.ndarray
) -> tuple[np.ndarray, float]:
    """Units (2n,) of (q, v), and a rate: that of the fastest small motion, but no less than a SLOWEST part of those that the
    matrix is made of, since where all eigenvalues are zero it is roundoff; and the speeds at which a motion along each coordinate
    has the `energy` that L has terms of, or that `forces` of these sizes give in that time, with the distances that it goes
    then. They do not depend on how near to zero the place happens to be; where nothing has a size, one energy is as good as
    another.
    """
    n, sizes = v.size, np.abs(np.diag(metric))
    roots = np.where(sizes > 0.0, np.sqrt(sizes), 1.0)
    springs, dampers = (scaled_matrix(part, 1.0 / roots) for part in (derivative[n:, :n], derivative[n:, n:]))
    of_parts = max(np.sqrt(np.abs(springs).max(initial=0.0)), np.abs(dampers).max(initial=0.0))
    rate = max(np.abs(np.linalg.eigvals(derivative)).max(initial=0.0), SLOWEST * of_parts)
    rate = float(power_of_two(np.asarray(rate))) if rate > 0.0 else 1.0
    over_masses = lambda a: np.divide(a, sizes, out=np.zeros(n), where=sizes > 0.0)
    whole = float(energy + np.abs(v) @ np.abs(metric) @ np.abs(v) + np.max(over_masses((forces / rate) ** 2), initial=0.0))
    if whole == 0.0:
        whole = next(iter(sizes[sizes > 0.0].tolist()), 0.0)
    speeds = np.sqrt(over_masses(whole))
    return filled(np.concatenate([speeds / rate, speeds]), derivative / rate), rate


def filled(units: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Units, powers of two; those that are 0 such that the entries of the matrix are about 1 at most, and 1 where these are 0."""
    moved = np.max(np.abs(matrix) * units, axis=1)
    units = np.where(units > 0.0, units, moved)
    return np.where(units > 0.0, power_of_two(units), 1.0)


def scaled_matrix(matrix: np.ndarray, units: np.ndarray) -> np.ndarray:
    """A matrix from coordinates to coordinates, in units of these."""
    return matrix * units / units[:, None]


class Lift:
    """An infinitesimal generator ξ, lifted to velocities: (ξ(q), Dξ(q) v)."""

    def __init__(self, generator: Callable):
        self.generator = generator

    def at(self, q: Any, v: Any) -> tuple[Any, Any, Any]:
        """ξ(q), Dξ(q), and the derivative of Dξ(q) v by q."""
        bend = jacobian(lambda q: along(self.generator, (q,), (v,)))
        return self.generator(q), jacobian(self.generator)(q), bend(q)


_lifts: Memo[Lift] = Memo(256)


def _lifted(generator: Callable, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(ξ(q), Dξ(q) v) side by side, Dξ(q), and the derivative of Dξ(q) v by q."""
    value, slope, bend = (np.asarray(x) for x in evaluated(_lifts.get(generator, lambda: Lift(generator)).at, q, v))
    return np.concatenate([value, slope @ v]), slope, bend


def linearized_chain(system: Any, at: Mapping[str, Any], params: Any) -> FieldAt:
    """Of another system, or of a singular Lagrangian, whose field and final manifold the constraint algorithm finds, in x: near
    the x, or the (q, v) of a Lagrangian, that is given. Raises `ValueError` where it finds no field."""
    chain = constraint_algorithm(system, at.get("x", at), params=params)
    if chain.verdict != DETERMINED:
        raise ValueError(f"there are no linear equations here ({chain.verdict}): {chain.explanation}")
    x = np.asarray(chain.point)
    field = lambda x: chain.field(x)
    value, slope = (np.asarray(a) for a in evaluated(lambda x: (field(x), jacobian(field)(x)), x))
    rows = np.asarray(evaluated(lambda x: jacobian(lambda x: chain.constraints(x))(x), x))
    units = chain.units
    moved, rates = np.abs(value / units).max(initial=0.0), np.abs(scaled_matrix(slope, units)).max(initial=0.0)
    residual = moved / max(moved + rates * (1.0 + np.abs(x / units).max()), TINY)
    place = np.asarray(at["x" if "x" in at else "q"], float)
    if (off := np.abs((place - x[: place.size]) / units[: place.size])).max(initial=0.0) > OFF * (1.0 + np.abs(x / units).max()):
        raise ValueError(
            f"the place is off the final constraint manifold, the nearest point found on it by {off.max():.3g} of its units: "
            f"x = {np.array2string(x, precision=6)}."
        )
    tangent = kernel(rows * units) if rows.shape[0] else np.eye(x.size)
    return FieldAt(scaled_matrix(slope, units), tangent, np.zeros((x.size, 0)), residual, units, 1.0)
