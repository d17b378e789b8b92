"""The problem of Suslov: a rigid body that must not turn about one of its own axes, ω_3 = 0, as equations on SO(3).

l(ω) = ½ ω·Iω with I = [[I1, 0, I13], [0, I2, I23], [I13, I23, I3]]; x = μ = Iω. With θ on the ellipse of energy,
ω = √(2E) (cos θ/√I1, sin θ/√I2, 0), the motion is θ̇ = k cos(θ − θ0): from one steady rotation to the opposite one. Where
I13 = I23 = 0, every ω is steady. (Suslov 1902; Fedorov & Zenkov, Nonlinearity 18 (2005), §3.)
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.gallery.heavy_top import along
from dirax.geometry.lie_groups import SO3
from dirax.reduction.euler_poincare import EulerPoincare
from dirax.schemes.euler_poincare import DiscreteEulerPoincare
from dirax.show.scene import Scene, arrow, attitudes, axes, box, point

PARAMS = {"I1": 1.0, "I2": 1.5, "I3": 2.0, "I13": 0.3, "I23": 0.2}


def inertia(params):
    """I, shape (3, 3)."""
    i = {name: jnp.asarray(value, float) for name, value in params.items()}
    zero = jnp.zeros(())
    rows = ((i["I1"], zero, i["I13"]), (zero, i["I2"], i["I23"]), (i["I13"], i["I23"], i["I3"]))
    return jnp.stack([jnp.stack(row) for row in rows])


def lagrangian(xi, params):
    """½ ω·Iω, a scalar."""
    return xi @ inertia(params) @ xi / 2


def exact(t, x, params=None) -> np.ndarray:
    """μ at times `t` (rows,), shape (rows, 3), from μ = Iω with ω_3 = 0: θ − θ0 is the Gudermannian of kt + c."""
    p = {**PARAMS, **(params or {})}
    matrix = np.asarray(inertia(p))
    roots = np.sqrt([p["I1"], p["I2"]])
    along = np.linalg.solve(matrix, np.asarray(x, float))[:2] * roots  # √(2E) (cos θ, sin θ)
    pull = np.array([p["I13"], p["I23"]]) / roots
    rate, first = np.hypot(*along) * np.hypot(*pull) / np.prod(roots), np.arctan2(pull[1], pull[0])
    start = np.arctan2(along[1], along[0]) - first
    turns = np.round(start / np.pi)  # cos(θ − θ0) keeps its sign
    s = (1 - 2 * (turns % 2)) * rate * np.asarray(t, float) + np.arctanh(np.sin(start - turns * np.pi))
    angle = turns * np.pi + 2 * np.arctan(np.tanh(s / 2))
    omega = np.hypot(*along) * np.stack([np.cos(angle + first) / roots[0], np.sin(angle + first) / roots[1]], axis=1)
    return omega @ matrix[:, :2].T


def motion(rows, params):
    """The attitude by integration of ω = I⁻¹μ from the identity."""
    omega = np.linalg.solve(np.asarray(inertia(params), float), rows["x"].T).T
    return {"attitude": attitudes(rows["t"], omega), "omega": omega}


def scene() -> Scene:
    """The body, its forbidden axis with its trail, and the angular velocity."""
    tip = lambda attitude: along(attitude, jnp.array([0.0, 0.0, 0.9]))
    speed = lambda attitude, omega: along(attitude, omega)
    bodies = (
        box([0.0, 0.0, 0.0], lambda attitude: attitude, size=(1.2, 1.0, 0.5)),
        point(tip, radius=0.05, trail=True, colour=1),
    )
    return Scene((axes(length=1.0), *bodies, arrow([0.0, 0.0, 0.0], speed)), fields=motion)


EXAMPLE = Example(
    name="suslov",
    title="Suslov's problem",
    source="Fedorov & Zenkov, Nonlinearity 18 (2005), §3; closed form",
    system=EulerPoincare(SO3(), lagrangian, one_forms=[[0.0, 0.0, 1.0]]),
    params=PARAMS,
    initial={"x": np.array([-1.0, 0.15, -0.28])},
    scheme=DiscreteEulerPoincare(),
    step=0.05,
    steps=1000,
    coordinates=(Coordinate("μ1"), Coordinate("μ2"), Coordinate("μ3")),
    exact=exact,
    scene=scene(),
)
