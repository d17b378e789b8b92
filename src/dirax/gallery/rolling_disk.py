"""The vertical rolling disk on a plane ([PY] §8.1), forced by an artificial potential.

Coordinates q = (x, y, θ, φ): contact point, rotation angle, heading.

    L = m (ẋ² + ẏ²)/2 + I θ̇²/2 + J φ̇²/2 − V sin θ,   ẋ = R cos φ θ̇,   ẏ = R sin φ θ̇

φ is free, so φ = φ0 + φ̇0 t and p_φ = J φ̇ is conserved; on the constraint (I + m R²) θ̈ = −V cos θ, and x and y follow
by quadrature. The paper takes m = R = 1, I = .25, J = .5, V = 10 and h = .001, and begins from two points.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.schemes.lagrange_dirac import PlusLagrangeDirac
from dirax.show.scene import Scene, after, disk, plane, turn
from dirax.systems.lagrange_dirac import LagrangeDirac

PARAMS = {"m": 1.0, "R": 1.0, "I": 0.25, "J": 0.5, "V": 10.0}

TWO_POINTS = {"q0": np.array([0.0, 0.0, 0.0, np.pi / 3]), "q1": np.array([0.005, 0.0086603, 0.01, 1.0481976])}
"""The initial data as printed in [PY] §8.1, for h = .001 (rounded there, so off the constraint in the eighth digit)."""

PANEL = 0.02
"""Longest panel of the quadrature of x and y, in units of time in which θ̇ and φ̇ are of order 10 or less."""


def lagrangian(q, v, params):
    """L(q, v) of the forced disk, a scalar."""
    kinetic = params["m"] * (v[0] ** 2 + v[1] ** 2) + params["I"] * v[2] ** 2 + params["J"] * v[3] ** 2
    return kinetic / 2 - params["V"] * jnp.sin(q[2])


def one_forms(q, params):
    """dx − R cos φ dθ and dy − R sin φ dθ: rolling without slipping, [PY] (60); shape (2, 4)."""
    return jnp.array([[1.0, 0.0, -params["R"] * jnp.cos(q[3]), 0.0], [0.0, 1.0, -params["R"] * jnp.sin(q[3]), 0.0]])


def exact(t, q, v, params=None) -> np.ndarray:
    """The continuous solution at times `t` (rows,), increasing from 0 on, shape (rows, 4), to about 1e-12.

    θ from the inverse of t(θ) = ∫ dθ/θ̇ with θ̇² = θ̇0² − 2V (sin θ − sin θ0)/(I + m R²), a Fourier series because θ
    rotates; x and y by Gauss–Legendre quadrature. Raises `ValueError` for a disk that turns back instead of rotating.
    """
    p = {**PARAMS, **(params or {})}
    t = np.atleast_1d(np.asarray(t, float))
    (x0, y0, theta0, phi0), (theta_dot, phi_dot) = q, (v[2], v[3])
    swing = 2 * p["V"] / (p["I"] + p["m"] * p["R"] ** 2)
    theta, rate = _rotation(theta0, theta_dot, swing)
    nodes, weights = np.polynomial.legendre.leggauss(8)
    ends = np.unique(np.concatenate([np.linspace(0, t.max(), int(np.ceil(t.max() / PANEL)) + 1), t]))
    half = np.diff(ends) / 2
    s = ends[:-1, None] + half[:, None] * (nodes + 1)
    speed = p["R"] * rate(theta(s))
    path = np.stack([np.cos(phi0 + phi_dot * s) * speed, np.sin(phi0 + phi_dot * s) * speed])
    sums = np.concatenate([np.zeros((2, 1)), np.cumsum((path @ weights) * half, axis=1)], axis=1)
    x, y = sums[:, np.searchsorted(ends, t)]
    return np.stack([x0 + x, y0 + y, theta(t), phi0 + phi_dot * t], axis=1)


def _rotation(theta0: float, theta_dot: float, swing: float, harmonics: int = 128):
    """θ(t) and θ̇(θ) of a pendulum that rotates."""

    def square(angle):
        return theta_dot**2 - swing * (np.sin(angle) - np.sin(theta0))

    angles = 2 * np.pi * np.arange(harmonics) / harmonics
    if np.min(square(angles)) < 0.02 * theta_dot**2:
        raise ValueError(
            f"the exact solution is written for a disk that rotates, but θ̇ = {theta_dot:g} does not carry it (or barely) "
            "over the top of the potential: give a larger θ̇ or compare with a refined run."
        )
    sign = np.sign(theta_dot)
    rate = lambda angle: sign * np.sqrt(square(angle))
    series = np.fft.rfft(1 / rate(angles)) / harmonics  # dt/dθ = Σ c_k e^{ikθ}
    k = np.arange(1, harmonics // 2)
    integrated = 2 * series[1 : harmonics // 2] / (1j * k)
    mean = float(np.real(series[0]))

    def time_at(angle):
        z, total = np.exp(1j * angle), np.zeros_like(angle, dtype=complex)
        for c in integrated[::-1]:  # Horner's rule
            total = (total + c) * z
        return mean * angle + np.real(total)

    def angle_at(t):
        start = time_at(np.asarray(theta0, float))
        angle = theta0 + t / mean
        for _ in range(8):
            angle = angle - (time_at(angle) - start - t) * rate(angle)
        return angle

    return angle_at, rate


def heading(q):
    """The generator of turns about the vertical, ∂/∂φ; its momentum is p_φ."""
    return jnp.array([0.0, 0.0, 0.0, 1.0])


def scene() -> Scene:
    """The disk on its plane: it leans nowhere, heads along φ and turns by θ."""
    rolled = lambda q: after(turn([0, 0, 1], q[3]), turn([0, 1, 0], q[2]), turn([1, 0, 0], jnp.pi / 2))
    centre = lambda q, params: jnp.stack([q[0], q[1], jnp.asarray(params["R"])])
    return Scene((plane(), disk(centre, rolled, radius=PARAMS["R"], trail=True)))


EXAMPLE = Example(
    name="rolling-disk",
    title="Vertical rolling disk",
    source="Peng & Yoshimura, §8.1",
    system=LagrangeDirac(lagrangian, one_forms),
    params=PARAMS,
    initial={
        "q": np.array([0.0, 0.0, 0.0, np.pi / 3]),
        "v": np.array([10 * np.cos(np.pi / 3), 10 * np.sin(np.pi / 3), 10.0, 1.0]),
    },
    scheme=PlusLagrangeDirac(),
    step=1e-3,
    steps=50_000,
    coordinates=(Coordinate("x"), Coordinate("y"), Coordinate("θ", "rad"), Coordinate("φ", "rad")),
    exact=exact,
    symmetries={"p_φ": heading},
    scene=scene(),
)
