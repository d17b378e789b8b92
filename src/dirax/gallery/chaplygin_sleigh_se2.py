"""The Chaplygin sleigh on SE(2): the system of `chaplygin-sleigh`, reduced by all rigid motions of the plane.

ξ = (u, w, ω): the velocity along and across the knife edge, and the turning rate; the centre of mass lies a ahead of the edge.

    l(ξ) = ½ m (u² + (w + a ω)²) + ½ I ω²,   w = 0

x = μ = (m u, m (w + a ω), m a (w + a ω) + I ω). u = c tanh s, κω = ± c sech s with κ² = a² + I/m, s = (a c/κ²) t + s_0;
`dx.reconstruct` gives the motion (cos φ, sin φ, x, y) in the plane.
"""

from dataclasses import replace

import numpy as np

from dirax.gallery import chaplygin_sleigh
from dirax.gallery.chaplygin_sleigh import PARAMS
from dirax.gallery.example import Coordinate, Example
from dirax.geometry.lie_groups import SE2
from dirax.reduction.euler_poincare import EulerPoincare
from dirax.schemes.euler_poincare import DiscreteEulerPoincare
from dirax.show.scene import Scene


def lagrangian(xi, params):
    """½ m (u² + (w + a ω)²) + ½ I ω², a scalar."""
    u, w, turn = xi
    return params["m"] * (u**2 + (w + params["a"] * turn) ** 2) / 2 + params["I"] * turn**2 / 2


def exact(t, x, params=None) -> np.ndarray:
    """μ at times `t` (rows,), shape (rows, 3), from an admissible μ with ω ≠ 0."""
    p = {**PARAMS, **(params or {})}
    m, a = p["m"], p["a"]
    kappa = np.sqrt(a**2 + p["I"] / m)
    u, turn = x[0] / m, x[1] / (m * a)
    c = np.hypot(u, kappa * turn)
    s = a * c / kappa**2 * np.asarray(t, float) + np.arctanh(u / c)
    turns = np.sign(turn) * c / kappa / np.cosh(s)
    return np.stack([m * c * np.tanh(s), m * a * turns, m * kappa**2 * turns], axis=1)


def motion(rows, params):
    """The sleigh in the plane, q = (x, y, φ), by integration of ξ from the origin."""
    m, a, inertia = (float(params[name]) for name in ("m", "a", "I"))
    middle, step = (rows["x"][1:] + rows["x"][:-1]) / 2, np.diff(rows["t"])
    turned = step * middle[:, 2] / (m * a**2 + inertia)
    heading = np.concatenate([[0.0], np.cumsum(turned)])
    along, half = step * middle[:, 0] / m, heading[:-1] + turned / 2
    moved = np.cumsum(along[:, None] * np.stack([np.cos(half), np.sin(half)], axis=1), axis=0)
    return {"q": np.column_stack([np.concatenate([np.zeros((1, 2)), moved]), heading])}


def scene() -> Scene:
    """The same sleigh on its plane."""
    return replace(chaplygin_sleigh.scene(), fields=motion)


EXAMPLE = Example(
    name="chaplygin-sleigh-se2",
    title="Chaplygin sleigh on SE(2)",
    source="Fedorov & Zenkov, Nonlinearity 18 (2005), §5; closed form",
    system=EulerPoincare(SE2(), lagrangian, one_forms=[[0.0, 1.0, 0.0]]),
    params=PARAMS,
    initial={"x": np.array([-0.5, 0.4, 0.66])},
    scheme=DiscreteEulerPoincare(),
    step=0.02,
    steps=1000,
    coordinates=(Coordinate("μ1"), Coordinate("μ2"), Coordinate("μφ")),
    exact=exact,
    scene=scene(),
)
