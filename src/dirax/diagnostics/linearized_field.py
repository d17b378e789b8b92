"""The derivative of the vector field of a system at a relative equilibrium, with the spaces that it keeps."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from dirax.numerics.equilibration import power_of_two
from dirax.numerics.tolerances import TINY
from dirax.program.memo import Memo
from dirax.program.rounding import rounding
from dirax.program.tracing import along, gradient, jacobian
from dirax.program.user_functions import evaluated
from dirax.systems.constraint_algorithm import constraint_algorithm
from dirax.systems.lagrange_dirac import LagrangeDirac

RANK = 1e-10
"""Singular values of the constraints, relative to the largest one, that count as zero."""

SLOWEST = 1e-2
"""Eigenvalues of several rows that are zero may come out as such a part of the largest entries."""

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


class Equations:
    """d/dt ∂L/∂v − ∂L/∂q − f + [W; G]ᵀu = 0 and d/dt (W v + b, G v + ∂g/∂t) = 0 as equations of (a, u) at (q, v)."""

    def __init__(self, system: LagrangeDirac, t: float):
        self.system, self.t = system, t

    def __call__(self, q: Any, v: Any, a: Any, u: Any, params: Any) -> Any:
        """(n + k,)."""
        system, t = self.system, jnp.asarray(self.t, float)
        momentum = lambda t, q, v: system.legendre(q, v, params, t)
        rate = along(momentum, (t, q, v), (jnp.ones(()), v, a))
        balance = rate - gradient(lambda q: system.lagrangian.at(t, q, v, params))(q)
        if (forces := system.forces_at(u)) is not None:
            balance = balance - forces(t, q, v, params)
        constraints = system.constraints
        if not constraints.any:
            return balance
        velocity = lambda t, q, v: constraints.velocity_defect(t, q, v, params)
        return jnp.concatenate(
            [balance + constraints.matrix(t, q, params).T @ u, along(velocity, (t, q, v), (jnp.ones(()), v, a))]
        )

    def by_w(self, z: Any, w: Any, params: Any) -> tuple[Any, Any]:
        """The equations at z = (q, v), w = (a, u), with their derivative by w."""
        n = z.shape[0] // 2
        at = lambda w: self(z[:n], z[n:], w[:n], w[n:], params)
        return at(w), jacobian(at)(w)

    def linear(self, z: Any, w: Any, params: Any) -> tuple[Any, Any]:
        """Their derivatives by z and by w."""
        n = z.shape[0] // 2
        at = lambda z, w: self(z[:n], z[n:], w[:n], w[n:], params)
        return jacobian(lambda z: at(z, w))(z), jacobian(lambda w: at(z, w))(w)

    def momentum(self, q: Any, v: Any, params: Any) -> tuple[Any, Any]:
        """The derivatives of ∂L/∂v by q and by v."""
        return jacobian(lambda q, v: self.system.legendre(q, v, params, self.t), (0, 1))(q, v)

    def sizes(self, q: Any, v: Any, u: Any, params: Any) -> tuple[Any, Any, Any]:
        """The sizes of the terms of L, and of the forces (n,) where nothing is accelerated, and ∂²L/∂v²."""
        lagrangian = lambda q, v: jnp.reshape(self.system.lagrangian.at(self.t, q, v, params), ())
        forces = lambda q, v: self(q, v, jnp.zeros_like(q), u, params)[: q.shape[0]]
        of_forces = jnp.maximum(rounding(forces, q, v), jnp.abs(forces(q, v)))
        return rounding(lagrangian, q, v), of_forces, self.momentum(q, v, params)[1]

    def tangent(self, z: Any, params: Any) -> Any:
        """The derivative of all constraints on (q, v)."""
        n = z.shape[0] // 2
        return jacobian(lambda z: self.system.constraints.defect(self.t, z[:n], z[n:], params))(z)


_equations: Memo[Equations] = Memo(64)


def equations_of(system: LagrangeDirac, t: float) -> Equations:
    """The equations of a system at a time, the same object for equal systems, so that they are traced once."""
    return _equations.get((system, t), lambda: Equations(system, t))


def accelerations(system: LagrangeDirac, q: Any, v: Any, params: Any = None, t: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """The accelerations q̈ (n,) at data on the constraints, and the multipliers (k,), whose forces are −[W; G]ᵀu."""
    q, v = (np.asarray(values, float) for values in (q, v))
    w = _solved(equations_of(system, t), np.concatenate([q, v]), params)
    return w[: q.size], w[q.size :]


def _solved(equations: Equations, z: Any, params: Any) -> np.ndarray:
    """w = (a, u) at z = (q, v)."""
    n = z.size // 2
    w = np.zeros(n + sum(equations.system.constraints.sizes(z[:n], params)))
    for _ in range(3):  # affine in (a, u), but for forces that see the multipliers
        missed, by_w = (np.asarray(x) for x in evaluated(equations.by_w, z, w, params))
        w = w - _least_squares(by_w, missed, n)
    return w


def _least_squares(by_w: np.ndarray, right: np.ndarray, n: int) -> np.ndarray:
    """The smallest (a, u) for which by_w (a, u) is nearest to a right-hand side (n + k, …): both measured by the masses of the
    coordinates, and constraints by their rows in these units."""
    masses = np.sqrt(np.abs(np.diag(by_w)[:n]))
    masses = np.where(masses > 0.0, masses, 1.0)
    largest = lambda rows: power_of_two(np.max(np.abs(rows) / masses, axis=1, initial=0.0))
    rows, columns = (np.append(power_of_two(masses), largest(a)) for a in (by_w[n:, :n], by_w[:n, n:].T))
    found = np.linalg.lstsq(by_w / rows[:, None] / columns, (right.T / rows).T, rcond=RANK)[0]
    return (found.T / columns).T


def linearized_lagrangian(system: LagrangeDirac, at: Mapping[str, Any], generators: Sequence[Callable], params: Any) -> FieldAt:
    """Of a Lagrangian with constraints, in z = (q, v)."""
    q, v = (np.asarray(at[name], float) for name in ("q", "v"))
    n, z, equations = q.size, np.concatenate([q, v]), equations_of(system, float(at.get("t", 0.0)))
    w, derivative = _linear(equations, z, params)
    lifted, slopes = [], []
    for generator in generators:
        value, slope, bend = (np.asarray(x) for x in evaluated(_lifts.get(generator, lambda g=generator: Lift(g)).at, q, v))
        lifted.append(np.concatenate([value, slope @ v]))
        slopes.append((slope, bend))
    symmetric = np.stack(lifted, axis=1) if lifted else np.zeros((2 * n, 0))
    energy, forces, metric = (np.asarray(a) for a in evaluated(equations.sizes, q, v, w[n:], params))
    units, rate = _units(energy, forces, metric, v, derivative)
    tangent = _tangent(equations, z, params, units)
    field, symmetric = np.concatenate([v, w[:n]]) / units / rate, symmetric / units[:, None]
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
        changed = _changed(equations, z, params, (derivative, tangent, units, rate)) if np.any(v) else 0.0
        residual = max(np.abs(field[n:]).max() / (1.0 + np.abs(field).max()), changed)
    return FieldAt(scaled_matrix(derivative, units) / rate, tangent, symmetric, residual, units, rate)


def _linear(equations: Equations, z: np.ndarray, params: Any) -> tuple[np.ndarray, np.ndarray]:
    """w = (a, u) at z = (q, v), and the derivative of (v, a) by z."""
    n, w = z.size // 2, _solved(equations, z, params)
    by_z, by_w = (np.asarray(x) for x in evaluated(equations.linear, z, w, params))
    derivative = np.zeros((2 * n, 2 * n))
    derivative[:n, n:] = np.eye(n)
    derivative[n:] = -_least_squares(by_w, by_z, n)[:n]
    return w, derivative


def _tangent(equations: Equations, z: np.ndarray, params: Any, units: np.ndarray) -> np.ndarray:
    """The tangent space of the constraints at z, in these units."""
    if not equations.system.constraints.any:
        return np.eye(z.size)
    return kernel(np.asarray(evaluated(equations.tangent, z, params)) * units)


def _changed(equations: Equations, z: np.ndarray, params: Any, here: tuple) -> float:
    """How much a motion with a constant velocity has changed the linear equations, relative to their terms, and the tangent space
    after some while."""
    derivative, tangent, units, rate = here
    n = z.size // 2
    there = z + np.concatenate([z[n:], np.zeros(n)]) * (WHILE / rate)
    moved = scaled_matrix(_linear(equations, there, params)[1] - derivative, units) / rate
    size = 1.0 + np.abs(scaled_matrix(derivative, units)).max() / rate
    turned = _tangent(equations, there, params, units)
    if turned.shape != tangent.shape:
        return 1.0
    return float(
        max(np.abs(moved @ tangent).max(initial=0.0) / size, np.abs(turned - tangent @ (tangent.T @ turned)).max(initial=0.0))
    )


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


def kernel(rows: np.ndarray) -> np.ndarray:
    """An orthonormal basis of the kernel of rows, each taken relative to its size, as columns."""
    sizes = np.abs(rows).max(axis=1, keepdims=True, initial=0.0)
    _, values, vt = np.linalg.svd(rows / np.where(sizes > 0, sizes, 1.0))
    rank = int(np.sum(values > RANK * values.max(initial=1.0)))
    return vt[rank:].T


def linearized_chain(system: Any, at: Mapping[str, Any], params: Any) -> FieldAt:
    """Of another system, whose field and final manifold the constraint algorithm finds, in x."""
    x = np.asarray(at["x"], float)
    chain = constraint_algorithm(system, x, params=params)
    x = np.asarray(chain.point)
    field = lambda x: chain.field(x)
    value, slope = (np.asarray(a) for a in evaluated(lambda x: (field(x), jacobian(field)(x)), x))
    rows = np.asarray(evaluated(lambda x: jacobian(lambda x: chain.constraints(x))(x), x))
    units = chain.units
    moved, rates = np.abs(value / units).max(initial=0.0), np.abs(scaled_matrix(slope, units)).max(initial=0.0)
    residual = moved / max(moved + rates * (1.0 + np.abs(x / units).max()), TINY)
    tangent = kernel(rows * units) if rows.shape[0] else np.eye(x.size)
    return FieldAt(scaled_matrix(slope, units), tangent, np.zeros((x.size, 0)), residual, units, 1.0)
