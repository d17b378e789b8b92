"""The snakeboard: a board on two wheel axles that its rider turns, and a rotor that the rider swings.

q = (x, y, θ, ψ, φ): centre and heading of the board, angle of the rotor, and of the axles (φ at the back, −φ in front).

    L = ½ m (ẋ² + ẏ²) + ½ m r² θ̇² + J_r θ̇ψ̇ + ½ J_r ψ̇² + J_w φ̇²
    −sin(θ ± φ) ẋ + cos(θ ± φ) ẏ ∓ r cos φ θ̇ = 0

No axle moves sideways. Where both stand across, at cos φ = 0, these two one-forms depend on each other, while the motion passes
there smoothly: their sum has the factor 2 cos φ. Without it, and with half their difference, they are independent everywhere:

    −sin θ ẋ + cos θ ẏ = 0,   sin φ (cos θ ẋ + sin θ ẏ) + r cos φ θ̇ = 0

The momenta of ψ and φ are conserved, J_r (θ̇ + ψ̇) and 2 J_w φ̇; that along the board is not: this is how one rides it.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.schemes.discrete_dirac import DiscreteDirac
from dirax.show.scene import Scene, blade, box, plane, turn
from dirax.systems.nonholonomic import NonholonomicMechanics

PARAMS = {"m": 1.0, "r": 1.0, "J_r": 0.3, "J_w": 0.1}


def metric(q, params):
    """g of L, shape (5, 5), constant."""
    m, rotor = params["m"], params["J_r"]
    diagonal = jnp.diag(jnp.stack([jnp.asarray(v, float) for v in (m, m, m * params["r"] ** 2, rotor, 2 * params["J_w"])]))
    return diagonal + rotor * jnp.zeros((5, 5)).at[2, 3].set(1.0).at[3, 2].set(1.0)


def potential(q, params):
    """0, a scalar."""
    return jnp.zeros(())


def one_forms(q, params):
    """No sideways motion of the centre, and the turn of the board as the axles stand, shape (2, 5)."""
    zero, c, s = jnp.zeros(()), jnp.cos(q[2]), jnp.sin(q[2])
    turning = jnp.sin(q[4]) * jnp.stack([c, s])
    return jnp.stack([jnp.stack([-s, c, zero, zero, zero]), jnp.stack([*turning, params["r"] * jnp.cos(q[4]), zero, zero])])


def scene() -> Scene:
    """The board, its two axles and its rotor."""
    heading = lambda angle: turn([0, 0, 1], angle)
    ahead = lambda q: jnp.stack([jnp.cos(q[2]), jnp.sin(q[2]), jnp.zeros(())])
    at = lambda along, height: lambda q: jnp.stack([q[0], q[1], jnp.asarray(height)]) + along * ahead(q)
    r = PARAMS["r"]
    return Scene(
        (
            plane(),
            box(at(0.0, 0.2), lambda q: heading(q[2]), size=(2 * r, 0.3, 0.06), trail=True),
            blade(at(-r, 0.0), lambda q: heading(q[2] + q[4]), length=0.6, colour=1),
            blade(at(r, 0.0), lambda q: heading(q[2] - q[4]), length=0.6, colour=1),
            box(at(0.0, 0.3), lambda q: heading(q[2] + q[3]), size=(0.9, 0.12, 0.08), colour=2),
        )
    )


EXAMPLE = Example(
    name="snakeboard",
    title="Snakeboard",
    source="nonholonomic mechanics of [BLM] §8",
    system=NonholonomicMechanics(metric, potential, one_forms),
    params=PARAMS,
    initial={"q": np.array([0.0, 0.0, 0.0, 0.0, 0.5]), "v": np.array([0.5, 0.0, 0.2, -0.8, 0.05]), "project": True},
    scheme=DiscreteDirac(constraints="resolve"),
    step=0.02,
    steps=1000,
    coordinates=tuple(Coordinate(name, unit) for name, unit in zip("xyθψφ", ("", "", "rad", "rad", "rad"), strict=True)),
    symmetries={"p_ψ": lambda q: jnp.eye(5)[3], "p_φ": lambda q: jnp.eye(5)[4]},
    scene=scene(),
)
