"""Every system of the gallery: reduced by its symmetry it moves as it does unreduced, or it has none that could be reduced."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax import gallery
from dirax.gallery import heavy_top, planar_n_body
from lie_groups import matrices, run, unreduced

STEPS = 500


def around(points, angle):
    """Points (N, 2) of the plane turned about the origin."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]], axis=1)


def polar(y):
    """(r, α, …) to (x, y, …)."""
    return jnp.concatenate([y[0] * jnp.stack([jnp.cos(y[1]), jnp.sin(y[1])]), y[2:]])


def on_the_table(y):
    """The ball's angle ψ counted from the direction of its centre, so that turns of everything are translations of α."""
    return polar(y).at[2].add(y[1])


def vortices_turned(y):
    """(r, z_2, …, z_N, α): the first vortex on a ray of angle α, the others seen from it."""
    first = jnp.stack([y[0], jnp.zeros(())])[None]
    points = around(jnp.concatenate([first, y[1:-1].reshape(-1, 2)]), y[-1])
    return jnp.concatenate([points[:, 0], points[:, 1]])


def seen_from_the_first(q):
    n = len(q) // 2
    z = q[:n] + 1j * q[n:]
    seen = z[1:] * np.exp(-1j * np.angle(z[0]))
    return np.concatenate([[abs(z[0])], np.stack([seen.real, seen.imag], axis=1).ravel(), [np.angle(z[0])]])


def by_newton(point, q, guess):
    """y with point(y) = q."""
    y, newton = jnp.asarray(guess, float), jax.jit(lambda y: y - jnp.linalg.solve(jax.jacfwd(point)(y), point(y) - q))
    for _ in range(30):
        y = newton(y)
    return np.asarray(y)


OFF_THE_AXIS = {"q": np.array([3.0, 0.4, 0.0, 0.0]), "v": np.array([1.0, 0.0, 1.0, 1.0])}
ADMISSIBLE = {"q": np.array([1.0, 0.0, 0.1]), "v": np.array([0.5, 1.0, -1.0])}
slow = lambda *case: pytest.param(*case, marks=pytest.mark.soak)
CASES: list[Any] = [  # name, fibre, discrete Lagrangian, step, coordinates, initial data
    ("double-spherical-pendulum", [0], "midpoint", 0.01, None, None),
    ("charged-particle", [3], "left", 0.1, None, None),
    slow("charged-particle", [2, 3], "trapezoidal", 0.05, None, None),
    slow("charged-particle", [1, 2, 3], "midpoint", 0.05, polar, OFF_THE_AXIS),
    slow("planar-n-body", [3, 4, 5], "midpoint", 0.01, planar_n_body.from_shape, None),
    ("kepler", [1], "midpoint", 0.05, polar, None),
    ("rolling-disk", [0, 1], "left", 1e-3, None, None),
    slow("heisenberg", [2], "midpoint", 0.01, None, None),
    slow("heisenberg", [1, 2], "trapezoidal", 0.01, polar, ADMISSIBLE),
    ("contact-particle", [2], "midpoint", 0.05, None, None),
    slow("turntable", [4], "midpoint", 0.01, None, None),
    slow("turntable", [1, 4], "midpoint", 0.01, on_the_table, None),
    slow("snakeboard", [0, 1, 3], "midpoint", 0.02, None, None),
    slow("rolling-ball", [1, 4], "midpoint", 0.01, None, None),
    slow("chaplygin-sleigh", [0, 1], "left", 0.02, None, None),
    slow("knife-edge", [1], "midpoint", 0.05, None, None),
    slow("vortices", [7], "midpoint", 0.1, vortices_turned, None),
    slow("chaotic-vortices", [7], "midpoint", 0.05, vortices_turned, None),
]

ON_GROUPS = ("free-top", "heavy-top-so3", "suslov", "chaplygin-sleigh-se2", "underwater-vehicle")
"""Reduced by a whole group, over one point: the only connection is the trivial one."""

MACHINES = (
    *("bicycle", "tippe-top", "chaplygin-sphere", "rattleback", "euler-disk", "flyball-governor"),
    *("snakeboard-gait", "trikke", "n-trailer", "robot-arm"),
)
"""They have translations, and rolling, friction, closed loops or many hinges: no run is made on the quotient."""

WITHOUT = {
    "double-pendulum": "gravity singles out the vertical, and time is not a coordinate",
    "cartesian-double-pendulum": "the same in Cartesian coordinates",
    "henon-heiles": "a threefold symmetry, which is no Lie group of positive dimension",
    "transmission": "x, y and ξ all enter L",
    "lotka-volterra": "one degree of freedom: nothing is left beside the energy",
    "guiding-centre": "s = 2 makes the potential elliptic",
    "pendulum": "on T*Q from the start, one degree of freedom",
    "rigid-body": "a Dirac system on the quotient already: free-top is the one with its group",
    "heavy-top": "a Dirac system on the quotient already: heavy-top-so3 is the one with its group",
    "kirchhoff": "a Dirac system on the quotient already: underwater-vehicle is the one with its group",
    "spherical-pendulums": "in charts of S² × S², which are not those of the quotient: double-spherical-pendulum has its angles",
    "magnetic-spherical-pendulum": "a Dirac system in kinetic momenta, with a constraint",
    "lc-ladder": "a circuit, not a Lagrangian system on Q",
    "dc-motor": "ports, not a Lagrangian system on Q",
    "mass-spring-damper": "ports, not a Lagrangian system on Q",
    "wave-line": "ports, not a Lagrangian system on Q",
    "wave-sheet": "ports, not a Lagrangian system on Q",
    "oscillator-chain": "a large system: the momentum of the ring is one of a thousand coordinates",
    "sine-gordon": "a large system held at its ends",
    "hanging-chain": "a large system held at one end, with holonomic constraints",
    "andrews-squeezer": "a mechanism that hangs on the ground",
    "four-bar": "a mechanism that hangs on the ground",
    "bricard": "a mechanism that hangs on the ground",
    "n-four-bar": "a mechanism that hangs on the ground",
    "car-axis": "constraints and springs that take the time",
    "slider-crank": "driven by a constraint that takes the time",
}
"""Why the others are not here."""


def test_every_system_is_accounted_for():
    cases = {getattr(case, "values", case)[0] for case in CASES}
    others = set(ON_GROUPS) | set(WITHOUT) | set(MACHINES)
    assert cases | others == set(gallery.names()) and not cases & others


LONG = "andrews-squeezer", "n-four-bar"


@pytest.mark.parametrize(
    "name",
    [slow(name) if name in LONG else name for name in WITHOUT if isinstance(gallery.get(name).system, dx.LagrangeDirac)],
)
@pytest.mark.soak_of("oscillator-chain", "four-bar", "bricard")
def test_systems_without_translations(name):
    example = gallery.get(name)
    assert len(dx.translation_symmetries(example.system, example.initial["q"], params=example.params, radius=0.3)) == 0


def in_own_coordinates(example, point, start):
    """The system where its symmetry is a translation, and the initial data there."""
    system: Any = example.system
    if isinstance(system, dx.PhaseSpaceLagrangian):
        system = system.lagrange_dirac()
    if point is None:
        return system, start
    q, v = np.asarray(start["q"], float), start["v"]
    if point is planar_n_body.from_shape:
        y, w = jax.jvp(lambda q: planar_n_body.to_shape(q, example.params), (q,), (v,))
        return planar_n_body.SYMMETRIC, {"q": y, "v": w}
    angle = np.arctan2(q[1], q[0])
    guess = seen_from_the_first(q) if point is vortices_turned else np.concatenate([[np.hypot(*q[:2]), angle], q[2:]])
    y = by_newton(point, q, guess)
    return dx.in_coordinates(system, point), {"q": y, "v": np.linalg.solve(jax.jacfwd(point)(y), v)}


@pytest.mark.parametrize(("name", "fibre", "rule", "step", "point", "start"), CASES)
@pytest.mark.soak
def test_gallery_on_the_quotient(name, fibre, rule, step, point, start):
    """500 steps, for a twisted connection, here and there the zero one, lifted back; and by Routh where nothing moves the
    momentum."""
    example = gallery.get(name)
    system, start = in_own_coordinates(example, point, dict(start or example.initial))
    n = len(start["q"])
    assert set(fibre) <= set(dx.cyclic_coordinates(system, start["q"], params=example.params, radius=0.1))
    settings = {**start, "params": example.params, "step": step, "steps": STEPS, "engine": "native"}
    constrained = system.constraints.any
    scheme = dx.LagrangeDAlembert(rule) if constrained else dx.PlusLagrangeDirac(rule)
    whole = dx.simulate(system, scheme, **settings)
    zero = dx.reduce(system, dx.LinearConnection(fibre))
    twist = np.random.default_rng(n).uniform(-0.4, 0.4, (len(fibre), n - len(fibre)))
    twisted = dx.reduce(system, dx.LinearConnection(fibre, twist))
    regular = not constrained and "vortices" not in name  # ∂²L/∂ġ² = 0 for those
    others = [(twisted, dx.DiscreteRouth(rule))] if regular else []
    untwisted = [(zero, scheme)] if name in ("kepler", "rolling-disk") else []
    for reduced, chosen in (*untwisted, (twisted, scheme), *others):
        quotient = dx.simulate(reduced, chosen, **settings)
        lifted = dx.reconstruct(quotient)
        assert whole.ok and quotient.ok and quotient.x.shape == (STEPS + 1, n - len(fibre))
        assert np.abs(lifted.q - whole.q).max() < 1e-10
        assert np.abs(lifted.p - whole.p).max() < 1e-10 * max(1.0, np.abs(whole.p).max())
        if constrained:
            assert np.abs(lifted.multipliers - whole.multipliers).max() < 1e-10 * max(1.0, np.abs(whole.multipliers).max())
        else:
            assert np.all(quotient.mu == quotient.mu[0])


@pytest.mark.parametrize("name", [name if name == "suslov" else pytest.param(name, marks=pytest.mark.soak) for name in ON_GROUPS])
@pytest.mark.soak
def test_gallery_on_groups(name):
    """The discrete Euler–Lagrange and Lagrange–d'Alembert equations of L_d on the group, solved on its matrices."""
    example, h = gallery.get(name), 0.02
    system: Any = example.system
    group, d = system.space.group, system.space.dimension
    sol = run(system, "cayley", h, STEPS, params=example.params, **example.initial)
    a0 = jnp.asarray(sol.x[0, d:])
    if name == "heavy-top-so3":  # Π = IΩ
        inertia = jnp.array([heavy_top.PARAMS[key] for key in ("I1", "I2", "I3")])
        l = lambda xi, a: xi @ (inertia * xi) / 2 - heavy_top.PARAMS["mgl"] * a[2]
    else:
        l = lambda xi, a: system.value(xi, a, example.params)
    forms = None if not hasattr(sol, "multipliers") else np.asarray(system.constraint_forms(a0, example.params))
    g, unknowns = unreduced(group, l, h, jnp.asarray(sol.xi[0]), a0, STEPS, forms)
    lifted = dx.reconstruct(sol)
    assert np.abs(matrices(group, lifted.q) - g).max() < 1e-10
    assert np.abs(sol.xi[1:] - unknowns[:, :d]).max() < 1e-10
    if forms is not None:
        assert np.abs(sol.multipliers[1:] - unknowns[:, d:]).max() < 1e-11
