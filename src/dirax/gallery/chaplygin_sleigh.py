"""The Chaplygin sleigh: a rigid body on a plane with a knife edge behind its centre of mass.

q = (x, y, φ): the edge's contact point and heading; the centre of mass lies a ahead of it.

    L = ½ m ((ẋ − a φ̇ sin φ)² + (ẏ + a φ̇ cos φ)²) + ½ I φ̇²,   sin φ ẋ = cos φ ẏ

With u the speed along the edge, ω = φ̇ and κ² = a² + I/m: u̇ = a ω², ω̇ = −(a/κ²) u ω. Every motion ends straight, in the
direction in which the edge trails: no flow with an invariant measure on its energy surfaces does that.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.schemes.discrete_dirac import DiscreteDirac
from dirax.show.scene import Scene, blade, plane, point, rod, turn
from dirax.systems.nonholonomic import NonholonomicMechanics

PARAMS = {"m": 1.0, "I": 0.5, "a": 0.4}


def metric(q, params):
    """g(q) of L, shape (3, 3)."""
    m, a = params["m"], params["a"]
    s, c = m * a * jnp.sin(q[2]), m * a * jnp.cos(q[2])
    return jnp.stack(
        [
            jnp.stack([m + 0.0 * s, 0.0 * s, -s]),
            jnp.stack([0.0 * s, m + 0.0 * s, c]),
            jnp.stack([-s, c, params["I"] + m * a**2 + 0.0 * s]),
        ]
    )


def potential(q, params):
    """0, a scalar."""
    return jnp.zeros(())


def one_forms(q, params):
    """sin φ dx − cos φ dy, shape (1, 3)."""
    return jnp.stack([jnp.sin(q[2]), -jnp.cos(q[2]), jnp.zeros(())])[None]


def exact(t, q, v, params=None) -> np.ndarray:
    """The solution at times `t` (rows,), increasing from 0, shape (rows, 3), from an admissible velocity with φ̇ ≠ 0.

    u = c tanh(s), κω = ± c sech(s) with s = (a c/κ²) t + s_0, φ by the Gudermannian, x and y by Gauss–Legendre quadrature.
    """
    p = {**PARAMS, **(params or {})}
    t, (x0, y0, heading), turn = np.atleast_1d(np.asarray(t, float)), np.asarray(q, float), float(v[2])
    kappa = np.sqrt(p["a"] ** 2 + p["I"] / p["m"])
    u0 = np.cos(heading) * v[0] + np.sin(heading) * v[1]
    c = np.hypot(u0, kappa * turn)
    start, rate, sign = np.arctanh(u0 / c), p["a"] * c / kappa**2, np.sign(turn)
    gudermann = lambda s: 2 * np.arctan(np.tanh(s / 2))
    angle = lambda t: heading + sign * kappa / p["a"] * (gudermann(rate * t + start) - gudermann(start))
    nodes, weights = np.polynomial.legendre.leggauss(10)
    ends = np.unique(np.concatenate([np.linspace(0, t.max(), int(np.ceil(20 * t.max())) + 1), t]))
    half = np.diff(ends) / 2
    s = ends[:-1, None] + half[:, None] * (nodes + 1)
    speed = c * np.tanh(rate * s + start)
    path = np.stack([np.cos(angle(s)) * speed, np.sin(angle(s)) * speed])
    sums = np.concatenate([np.zeros((2, 1)), np.cumsum((path @ weights) * half, axis=1)], axis=1)
    x, y = sums[:, np.searchsorted(ends, t)]
    return np.stack([x0 + x, y0 + y, angle(t)], axis=1)


def scene() -> Scene:
    """The edge, and the centre of mass ahead of it."""
    edge = lambda q: q[:2]
    lifted = lambda q: jnp.stack([q[0], q[1], jnp.asarray(0.15)])
    ahead = lambda q, params: lifted(q) + params["a"] * jnp.stack([jnp.cos(q[2]), jnp.sin(q[2]), jnp.zeros(())])
    blades = (blade(edge, lambda q: turn([0, 0, 1], q[2]), length=0.5, trail=True), rod(lifted, ahead))
    return Scene((plane(), *blades, point(ahead, radius=0.09, colour=1)))


EXAMPLE = Example(
    name="chaplygin-sleigh",
    title="Chaplygin sleigh",
    source="nonholonomic mechanics of [BLM] §8; solution by quadrature",
    system=NonholonomicMechanics(metric, potential, one_forms),
    params=PARAMS,
    initial={"q": np.zeros(3), "v": np.array([-0.5, 0.0, 1.0])},
    scheme=DiscreteDirac(constraints="resolve"),
    step=0.02,
    steps=1000,
    coordinates=(Coordinate("x"), Coordinate("y"), Coordinate("φ", "rad")),
    exact=exact,
    scene=scene(),
)
