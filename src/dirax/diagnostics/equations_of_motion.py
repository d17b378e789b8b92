"""The equations of motion of a Lagrangian with constraints at a point: accelerations, multipliers, and derivatives."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from dirax.numerics.equilibration import power_of_two
from dirax.program.memo import Memo
from dirax.program.rounding import rounding
from dirax.program.tracing import along, gradient, jacobian
from dirax.program.user_functions import evaluated
from dirax.systems.lagrange_dirac import LagrangeDirac

RANK = 1e-10
"""Singular values of the constraints, relative to the largest one, that count as zero."""

FREE = 1e-6
"""Share of accelerations in a direction along which the equations say nothing, from which on they are not determined."""


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

    def slopes(self, q: Any, v: Any, params: Any) -> tuple[Any, Any]:
        """∂L/∂q and ∂L/∂v."""
        return gradient(lambda q, v: self.system.lagrangian.at(self.t, q, v, params), (0, 1))(q, v)

    def tangent(self, z: Any, params: Any) -> Any:
        """The derivative of all constraints on (q, v)."""
        n = z.shape[0] // 2
        return jacobian(lambda z: self.system.constraints.defect(self.t, z[:n], z[n:], params))(z)


_equations: Memo[Equations] = Memo(64)


def equations_of(system: LagrangeDirac, t: float) -> Equations:
    """The equations of a system at a time, the same object for equal systems, so that they are traced once."""
    return _equations.get((system, t), lambda: Equations(system, t))


def accelerations(system: LagrangeDirac, q: Any, v: Any, params: Any = None, t: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """The accelerations q̈ (n,) at data on the constraints, and the multipliers (k,), whose forces are −[W; G]ᵀu. Raises
    `ValueError` where the equations do not determine accelerations."""
    q, v = (np.asarray(values, float) for values in (q, v))
    equations, z, n = equations_of(system, t), np.concatenate([q, v]), q.size
    if not determine(equations, z, params):
        raise ValueError(
            "the equations do not determine the accelerations: ∂²L/∂v² is singular at the data, as where a part has no mass. "
            'dx.constraint_algorithm(system, near={"q": …, "v": …}) finds the motions that there are.'
        )
    w = _solved(equations, z, params)
    return w[:n], w[n:]


def determine(equations: Equations, z: np.ndarray, params: Any) -> bool:
    """Whether the equations at z = (q, v) determine the accelerations: ∂²L/∂v² is regular, or the constraints make it so."""
    n = z.size // 2
    by_w = np.asarray(evaluated(equations.by_w, z, _solved(equations, z, params), params)[1])
    rows, columns = _scales(by_w, n)
    return bool(np.max(np.abs(kernel(by_w / rows[:, None] / columns)[:n]), initial=0.0) <= FREE)


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
    rows, columns = _scales(by_w, n)
    found = np.linalg.lstsq(by_w / rows[:, None] / columns, (right.T / rows).T, rcond=RANK)[0]
    return (found.T / columns).T


def _scales(by_w: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """What the rows and columns of by_w are measured by."""
    masses = np.sqrt(np.abs(np.diag(by_w)[:n]))
    masses = np.where(masses > 0.0, masses, 1.0)
    largest = lambda rows: power_of_two(np.max(np.abs(rows) / masses, axis=1, initial=0.0))
    rows, columns = (np.append(power_of_two(masses), largest(a)) for a in (by_w[n:, :n], by_w[:n, n:].T))
    return rows, columns


def linear(equations: Equations, z: np.ndarray, params: Any) -> tuple[np.ndarray, np.ndarray]:
    """w = (a, u) at z = (q, v), and the derivative of (v, a) by z."""
    n, w = z.size // 2, _solved(equations, z, params)
    by_z, by_w = (np.asarray(x) for x in evaluated(equations.linear, z, w, params))
    derivative = np.zeros((2 * n, 2 * n))
    derivative[:n, n:] = np.eye(n)
    derivative[n:] = -_least_squares(by_w, by_z, n)[:n]
    return w, derivative


def kernel(rows: np.ndarray) -> np.ndarray:
    """An orthonormal basis of the kernel of rows, each taken relative to its size, as columns."""
    sizes = np.abs(rows).max(axis=1, keepdims=True, initial=0.0)
    _, values, vt = np.linalg.svd(rows / np.where(sizes > 0, sizes, 1.0))
    rank = int(np.sum(values > RANK * values.max(initial=1.0)))
    return vt[rank:].T
