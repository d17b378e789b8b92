"""Lotka–Volterra as a phase-space Lagrangian with a one-form that is not linear.

q = (prey x, predator y) > 0: ẋ = x (a − b y), ẏ = y (c x − d) are the equations of L = ⟨α, q̇⟩ − H with

    α = (−log y/(2x), log x/(2y)),   H = c x − d log x + b y − a log y.

dα = dx∧dy/(xy) is not constant, so the midpoint rule (Method 2 of [BLM]) does not keep it (Prop 6.3).
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.schemes.discrete_dirac import DiscreteDirac
from dirax.show.scene import Scene, path, plane, point, rod
from dirax.systems.phase_space import PhaseSpaceLagrangian

PARAMS = {"a": 1.0, "b": 1.0, "c": 1.0, "d": 1.0}


def one_form(q, params):
    """α(q), shape (2,)."""
    return jnp.stack([-jnp.log(q[1]) / q[0], jnp.log(q[0]) / q[1]]) / 2


def hamiltonian(q, params):
    """H(q), the conserved quantity, a scalar."""
    return params["c"] * q[0] - params["d"] * jnp.log(q[0]) + params["b"] * q[1] - params["a"] * jnp.log(q[1])


def scene() -> Scene:
    """The two populations as rods along the axes, and the point that they make."""
    both = lambda q: q
    prey, predator = (lambda q: q * jnp.array([1.0, 0.0])), (lambda q: q * jnp.array([0.0, 1.0]))
    rods = rod((0.0, 0.0), prey, radius=0.03, colour=1), rod((0.0, 0.0), predator, radius=0.03, colour=2)
    return Scene((plane(), path(both), *rods, point(both, trail=True)), view="tilted")


EXAMPLE = Example(
    name="lotka-volterra",
    title="Lotka–Volterra",
    source="phase-space Lagrangian of [BLM] §6 with a nonlinear one-form",
    system=PhaseSpaceLagrangian(one_form, hamiltonian),
    params=PARAMS,
    initial={"q": np.array([0.5, 1.2]), "v": np.zeros(2)},
    scheme=DiscreteDirac(constraints="resolve"),
    step=0.05,
    steps=2000,
    coordinates=(Coordinate("x"), Coordinate("y")),
    scene=scene(),
)
