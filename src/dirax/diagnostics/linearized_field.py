"""The derivative of the vector field of a system at a relative equilibrium, with the spaces that it keeps."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from dirax.program.memo import Memo
from dirax.program.tracing import along, gradient, jacobian
from dirax.program.user_functions import evaluated
from dirax.systems.constraint_algorithm import constraint_algorithm
from dirax.systems.lagrange_dirac import LagrangeDirac

RANK = 1e-10
"""Singular values of the constraints, relative to the largest one, that count as zero."""


class FieldAt(NamedTuple):
    """The matrix (N, N) of the linear equations in the frame that moves with the motion, and the columns that span the tangent
    space of the constraints and the directions of the symmetries; how far the place is from a relative equilibrium."""

    matrix: np.ndarray
    tangent: np.ndarray
    symmetric: np.ndarray
    residual: float


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
        w = w - np.linalg.lstsq(by_w, missed, rcond=RANK)[0]
    return w


def linearized_lagrangian(system: LagrangeDirac, at: Mapping[str, Any], generators: Sequence[Callable], params: Any) -> FieldAt:
    """Of a Lagrangian with constraints, in z = (q, v)."""
    q, v = (np.asarray(at[name], float) for name in ("q", "v"))
    n, z, equations = q.size, np.concatenate([q, v]), equations_of(system, float(at.get("t", 0.0)))
    w = _solved(equations, z, params)
    by_z, by_w = (np.asarray(x) for x in evaluated(equations.linear, z, w, params))
    derivative = np.zeros((2 * n, 2 * n))
    derivative[:n, n:] = np.eye(n)
    derivative[n:] = -np.linalg.lstsq(by_w, by_z, rcond=RANK)[0][:n]
    lifted, slopes = [], []
    for generator in generators:
        value, slope, bend = (np.asarray(x) for x in evaluated(_lifts.get(generator, lambda g=generator: Lift(g)).at, q, v))
        lifted.append(np.concatenate([value, slope @ v]))
        slopes.append((slope, bend))
    symmetric = np.stack(lifted, axis=1) if lifted else np.zeros((2 * n, 0))
    field = np.concatenate([v, w[:n]])
    terms = 1.0 + np.abs(v).max(initial=0.0)
    if lifted:
        shares = np.linalg.lstsq(symmetric, field, rcond=RANK)[0]
        residual = np.abs(field - symmetric @ shares).max() / (terms + np.abs(field).max())
        for share, (slope, bend) in zip(shares, slopes, strict=True):
            derivative[:n, :n] -= share * slope
            derivative[n:, n:] -= share * slope
            derivative[n:, :n] -= share * bend
    else:
        changed = derivative @ np.concatenate([v, np.zeros(n)])
        changed = changed / (terms * (1.0 + np.abs(derivative).max()))
        residual = max(np.abs(w[:n]).max() / (terms + np.abs(w).max()), np.abs(changed).max())
    tangent = np.eye(2 * n)
    if system.constraints.any:
        tangent = kernel(np.asarray(evaluated(equations.tangent, z, params)))
    return FieldAt(derivative, tangent, symmetric, residual)


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
    residual = np.abs(value).max(initial=0.0) / (1.0 + np.abs(slope).max() * (1.0 + np.abs(x).max()))
    tangent = kernel(rows) if rows.shape[0] else np.eye(x.size)
    return FieldAt(slope, tangent, np.zeros((x.size, 0)), residual)
