"""The motion by equations derived apart from dirax: the saddle-point system of the Lagrangian's own derivatives, by DOP853."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from fuzz.systems import RandomSystem

KEPT = 4096
"""Motions that are remembered."""


@functools.lru_cache(maxsize=64)
def field_of(system: RandomSystem):
    """(t, y, params) ↦ ẏ for y = (q, v, work, ∫λ): M v̇ − Cᵀλ = F and the derivative of C v + d along the motion is zero."""
    n, lagrangian = system.kind.n, system.lagrangian

    def field(t, y, params):
        q, v = y[:n], y[n : 2 * n]
        slope = jax.grad(lagrangian, 2)
        mass = jax.jacfwd(slope, 2)(t, q, v, params)
        drift = jax.jacfwd(slope, 1)(t, q, v, params) @ v + jax.jacfwd(slope, 0)(t, q, v, params)
        force = system.force(t, q, v, params) if system.kind.forced else jnp.zeros(n)
        right = jax.grad(lagrangian, 1)(t, q, v, params) + force - drift
        defect = lambda t, q: (lambda rows: rows[0] @ v + rows[1])(system.velocity_rows(t, q, params))
        c = system.velocity_rows(t, q, params)[0]
        bend = jax.jacfwd(defect, 1)(t, q) @ v + jax.jacfwd(defect, 0)(t, q)
        k = len(c)
        found = jnp.linalg.solve(jnp.block([[mass, -c.T], [c, jnp.zeros((k, k))]]), jnp.concatenate([right, -bend]))
        return jnp.concatenate([v, found[:n], (force @ v)[None], found[n:]])

    momentum = lambda t, q, v, params: jax.grad(lagrangian, 2)(t, q, v, params)
    return jax.jit(field), jax.jit(jax.vmap(momentum, in_axes=(0, 0, 0, None)))


@functools.lru_cache(maxsize=64)
def rows_of(system: RandomSystem):
    """((t, q, params) ↦ the independent rows, and all rows that multipliers of dirax belong to), over rows of (t, q)."""

    def every(t, q, params):
        rows = [jnp.zeros((0, system.kind.n))]
        if system.kind.m:
            rows.append(system.one_forms(q, params))
        if system.kind.c:
            rows.append(jax.jacfwd(lambda q: system.position(t, q, params))(q))
        return jnp.concatenate(rows)

    both = lambda t, q, params: (system.velocity_rows(t, q, params)[0], every(t, q, params))
    return jax.jit(jax.vmap(both, in_axes=(0, 0, None)))


_known: dict[tuple, dict[str, np.ndarray]] = {}
"""The motions of a kind, at the times that schemes of one sort ask for."""


def motion(system: RandomSystem, params: dict, start: dict, t: np.ndarray) -> dict[str, np.ndarray]:
    """q, p, work and the multipliers λ at the times."""
    key = id(system), t.tobytes(), *(np.asarray(a).tobytes() for a in jax.tree.leaves((params, start)))
    if key not in _known:
        if len(_known) > KEPT:
            _known.clear()
        _known[key] = _motion(system, params, start, t)
    return _known[key]


def _motion(system: RandomSystem, params: dict, start: dict, t: np.ndarray) -> dict[str, np.ndarray]:
    n, k = system.kind.n, int(system.kind.m > 0) + int(system.kind.c > 0)
    field, momentum = field_of(system)
    y0 = np.concatenate([start["q"], start["v"], np.zeros(1 + k)])
    call = lambda t, y: np.asarray(field(t, y, params))
    y = solve_ivp(call, (0.0, float(t[-1])), y0, method="DOP853", rtol=3e-13, atol=3e-14, t_eval=t).y.T
    rates = np.stack([call(s, row) for s, row in zip(t, y, strict=True)])
    p = np.asarray(momentum(t, y[:, :n], y[:, n : 2 * n], params))
    return {"q": y[:, :n], "p": p, "work": y[:, 2 * n], "multipliers": rates[:, 2 * n + 1 :]}
