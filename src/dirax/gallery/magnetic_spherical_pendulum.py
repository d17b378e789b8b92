"""A charged spherical pendulum in a magnetic field: a Hamiltonian system with a holonomic constraint, no Lagrangian.

x = (q, v) in R⁶ with kinetic momenta v, unit mass and charge: H = |v|²/2 + g q₃ with the brackets {q_i, v_j} = δ_ij and
{v_i, v_j} = ε_ijk b_k, so that q̈ = v × b − g e₃ + 2λq, and (|q|² − l²) = 0. The rod pulls with −2λ l. For b along e₃ the
angular momentum q₁v₂ − q₂v₁ + b(q₁² + q₂²)/2 is conserved.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.geometry.structures import DiracStructure
from dirax.schemes.discrete_dirac import DiscreteDirac
from dirax.show.scene import Scene, arrow, point, sphere
from dirax.show.scene import rod as straight
from dirax.systems.dirac_system import DiracSystem

PARAMS = {"b": np.array([0.3, -0.2, 0.8]), "g": 1.0, "l": 1.0}


def bivector(x, params):
    """Λ with (q̇, v̇) = Λ dH, (6, 6): the force of the field is v × b."""
    b1, b2, b3 = params["b"]
    zero, one = jnp.zeros((3, 3)), jnp.eye(3)
    turn = jnp.zeros((3, 3)).at[0, 1].set(b3).at[1, 2].set(b1).at[2, 0].set(b2)
    return jnp.block([[zero, one], [-one, turn - turn.T]])


def hamiltonian(x, params):
    """|v|²/2 + g q₃."""
    return x[3:] @ x[3:] / 2 + params["g"] * x[2]


def rod(x, params):
    """(|q|² − l²), shape (1,)."""
    return jnp.stack([x[:3] @ x[:3] - params["l"] ** 2])


def scene() -> Scene:
    """The bob on its sphere, and the field."""
    bob, pivot = (lambda x: x[:3]), [0.0, 0.0, 0.0]
    field = arrow(pivot, lambda params: params["b"], colour="accent")
    return Scene((sphere(radius=PARAMS["l"]), straight(pivot, bob), point(bob, radius=0.06, trail=True), field))


EXAMPLE = Example(
    name="magnetic-spherical-pendulum",
    title="Charged spherical pendulum in a magnetic field",
    source="a Poisson bracket with a magnetic term and a constraint: Dirac's brackets on T S²",
    system=DiracSystem(DiracStructure.from_bivector(bivector), hamiltonian, holonomic=rod),
    params=PARAMS,
    initial={"x": np.array([0.6, 0.0, -0.8, 0.4, 0.9, 0.3])},
    scheme=DiscreteDirac(constraints="resolve"),
    step=0.02,
    steps=10_000,
    coordinates=tuple(Coordinate(name) for name in ("q1", "q2", "q3", "v1", "v2", "v3")),
    scene=scene(),
)
