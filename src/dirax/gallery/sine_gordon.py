"""The sine-Gordon equation φ_tt = φ_xx − sin φ on a line of sites, and its kink, which moves without changing its shape.

    L = Δ Σ [φ̇_i²/2 − (1 − cos φ_i)] − Σ (φ_{i+1} − φ_i)²/(2Δ),   φ = 4 arctan exp(γ(x − x₀ − vt)),   γ = 1/√(1 − v²)

with φ = 0 beyond the left end and 2π beyond the right one. T. H. R. Skyrme, Proc. R. Soc. A 262 (1961) 237. The sites follow the
equation to the order Δ². Written in arrays: any number of sites.
"""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.show.scene import Scene, point, rod
from dirax.systems.lagrange_dirac import LagrangeDirac

SITES, LENGTH, SPEED = 16, 16.0, 0.5


def line(length: float = LENGTH) -> LagrangeDirac:
    """The sites between −length/2 and length/2, as many as the data have, between a wall at 0 and one at 2π."""

    def lagrangian(q, v):
        spacing = length / (q.shape[0] + 1)
        d = jnp.diff(jnp.concatenate([jnp.zeros(1), q, jnp.full(1, 2 * jnp.pi)]))
        return spacing * jnp.sum(v**2 / 2 - (1 - jnp.cos(q))) - jnp.sum(d**2) / (2 * spacing)

    return LagrangeDirac(lagrangian)


def places(sites: int, length: float = LENGTH) -> np.ndarray:
    """The places of the sites (sites,)."""
    return (np.arange(1, sites + 1) / (sites + 1) - 0.5) * length


def kink(x: np.ndarray, t: float = 0.0, speed: float = SPEED, start: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """(φ, φ̇) of the kink that moves with `speed`, at `start` at t = 0, of the whole line."""
    gamma = 1 / np.sqrt(1 - speed**2)
    along = gamma * (np.asarray(x) - start - speed * t)
    return 4 * np.arctan(np.exp(along)), -2 * gamma * speed / np.cosh(along)


def start(sites: int, length: float = LENGTH, speed: float = SPEED, at: float = 0.0) -> dict[str, np.ndarray]:
    """The kink as initial data of `line(length)`."""
    q, v = kink(places(sites, length), 0.0, speed, at)
    return {"q": q, "v": v}


def scene(sites: int = SITES) -> Scene:
    """Pendulums on an axle, each turned by its φ: the kink is a full turn of them."""
    pivots = [(float(x), 0.0, 0.0) for x in places(sites)]
    bob = lambda i: lambda q: jnp.stack([jnp.asarray(pivots[i][0]), jnp.sin(q[i]), -jnp.cos(q[i])])
    arms = (rod(pivots[i], bob(i)) for i in range(sites))
    bobs = (point(bob(i), radius=0.18) for i in range(sites))
    return Scene((rod(pivots[0], pivots[-1]), *arms, *bobs), (0.45, -0.8, 0.4))


EXAMPLE = Example(
    name="sine-gordon",
    title="Kink of the sine-Gordon equation",
    source="Skyrme, Proc. R. Soc. A 262 (1961) 237",
    system=line(),
    initial=start(SITES),
    step=0.1,
    steps=100,
    coordinates=tuple(Coordinate(f"φ{i}") for i in range(1, SITES + 1)),
    scene=scene(),
)
