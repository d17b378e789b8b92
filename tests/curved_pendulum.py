"""What the tests of holonomic constraints share: a spherical pendulum in curved coordinates y of R³, and its exact motion."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

ANGLES = np.array([1.1, 0.4, 0.3, 0.9])
"""(θ, φ, θ̇, φ̇) at the start, from the downward vertical."""


def slopes(errors) -> np.ndarray:
    """log2 of successive ratios, for halved steps."""
    errors = np.asarray(errors)
    return np.log2(errors[:-1] / errors[1:])


def along(field, start, times):
    """DOP853 at tight tolerance."""
    return solve_ivp(field, (0.0, times[-1]), start, method="DOP853", rtol=1e-13, atol=1e-13, t_eval=times).y


def place(y):
    """Cartesian coordinates of the curved ones y (3,)."""
    return jnp.stack([y[0], y[1] + 0.2 * y[0] ** 2, y[2] + 0.3 * jnp.sin(y[1])])


def unplace(x):
    """The curved coordinates of points x (…, 3)."""
    y1 = x[..., 1] - 0.2 * x[..., 0] ** 2
    return np.stack([x[..., 0], y1, x[..., 2] - 0.3 * np.sin(y1)], -1)


def metric(y):
    jacobian = jax.jacfwd(place)(y)
    return jacobian.T @ jacobian


def sphere(y):
    return jnp.stack([place(y) @ place(y) - 1.0])


def swing(t, z):
    """(θ, φ) with unit length and gravity."""
    s, c = np.sin(z[0]), np.cos(z[0])
    return [z[2], z[3], s * c * z[3] ** 2 - s, -2 * c / s * z[2] * z[3]]


def exact(times):
    """(y, p, λ) at increasing times; 2λx is the force of the rod: λ = −(|ẋ|² − z)/2."""
    z = along(swing, ANGLES, times)
    s, c, u, w = np.sin(z[0]), np.cos(z[0]), np.cos(z[1]), np.sin(z[1])
    x = np.stack([s * u, s * w, -c], -1)
    v = np.stack([c * u * z[2] - s * w * z[3], c * w * z[2] + s * u * z[3], s * z[2]], -1)
    y = unplace(x)
    p = np.stack([v[:, 0] + 0.4 * y[:, 0] * v[:, 1], v[:, 1] + 0.3 * np.cos(y[:, 1]) * v[:, 2], v[:, 2]], -1)  # (D place)ᵀ v
    return y, p, -(np.sum(v * v, -1) - x[:, 2])[:, None] / 2
