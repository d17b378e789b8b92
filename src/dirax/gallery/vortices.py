"""Point vortices in the plane ([BLM] §6), the paper's four.

q = (x_1, …, x_N, y_1, …, y_N), circulations Γ_j. L = ½ Σ Γ_j (x_j ẏ_j − y_j ẋ_j) − H with

    H = (1/4π) Σ_{j<k} Γ_j Γ_k log |z_j − z_k|²,   ẋ_j = −(1/2π) Σ Γ_k (y_j − y_k)/l²,   ẏ_j = (1/2π) Σ Γ_k (x_j − x_k)/l².

(The paper's (9) sums over ordered pairs, which is twice this H.) α is linear, so Method 2, the midpoint rule on q, keeps
the symplectic form dα (Prop 6.3).
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.schemes.discrete_dirac import DiscreteDirac
from dirax.show.scene import Scene, plane, point
from dirax.systems.phase_space import PhaseSpaceLagrangian

CIRCULATIONS = (1.0, 1.0, -1.0, -1.0)
FOUR = np.array([-1.0, 1.0, -1.0, 1.0, 2.0, 2.0, -2.0, -2.0])
"""The paper's initial points (x, y): two pairs that leapfrog past each other."""


def point_vortices(circulations: Sequence[float]) -> PhaseSpaceLagrangian:
    """N point vortices with the given circulations; raises `ValueError` for fewer than two, or one without circulation."""
    gamma = tuple(float(g) for g in circulations)
    n = len(gamma)
    if n < 2 or 0.0 in gamma:
        raise ValueError(f"point vortices need at least two circulations, none of them zero, but {gamma} were given.")
    pairs = [(j, k) for j in range(n) for k in range(j)]

    def one_form(q):
        strength = jnp.array(gamma)
        return jnp.concatenate([-strength * q[n:], strength * q[:n]]) / 2

    def hamiltonian(q):
        square = lambda j, k: (q[j] - q[k]) ** 2 + (q[n + j] - q[n + k]) ** 2
        return sum(gamma[j] * gamma[k] * jnp.log(square(j, k)) for j, k in pairs) / (4 * jnp.pi)

    return PhaseSpaceLagrangian(one_form, hamiltonian)


def velocity(q, circulations: Sequence[float] = CIRCULATIONS):
    """q̇ written out ([BLM] (10)), shape (2N,); works on numpy and on JAX arrays."""
    n = len(circulations)
    x, y = q[:n], q[n:]
    across, up = x[:, None] - x[None, :], y[:, None] - y[None, :]
    strength = np.tile(circulations, (n, 1))
    rate = strength / (across**2 + up**2 + np.eye(n))
    return jnp.concatenate([-(rate * up).sum(1), (rate * across).sum(1)]) / (2 * np.pi)


def runge_kutta_step(q, h: float, circulations: Sequence[float] = CIRCULATIONS):
    """RK2, the explicit midpoint rule, which the paper compares with and which starts its Method 1."""
    return q + h * velocity(q + h / 2 * velocity(q, circulations), circulations)


def scene() -> Scene:
    """Four vortices in their plane."""
    places = [lambda q, k=k: jnp.stack([q[k], q[k + 4]]) for k in range(4)]
    return Scene((plane(), *(point(place, trail=True, colour=k) for k, place in enumerate(places))), view="tilted")


EXAMPLE = Example(
    name="vortices",
    title="Four point vortices",
    source="Barbero Liñán, López Medel & Martín de Diego, §6",
    system=point_vortices(CIRCULATIONS),
    initial={"q": FOUR, "v": np.zeros(8)},
    scheme=DiscreteDirac(constraints="resolve"),
    step=1.0,
    steps=300,
    coordinates=tuple(Coordinate(f"{letter}{j}") for letter in "xy" for j in range(1, 5)),
    plane=(0, 4),
    scene=scene(),
)
