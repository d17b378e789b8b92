"""The wave equation on a line as a port-Hamiltonian system with ports at both ends: a Stokes–Dirac structure on staggered cells.

    ε̇ = ∂_x (p/ρ),   ṗ = ∂_x (T ε),   H = ½ ∫ (T ε² + p²/ρ) dx

with the boundary flows (velocities) of the left end and boundary efforts (stresses) of the right one as inputs (A. J. van der
Schaft, B. M. Maschke, J. Geom. Phys. 42 (2002) 166). Strains ε live on N cells, momenta p at N points: that at the right end of
each cell. With T = ρ = 1 both are those of the cell, x = (strain of a cell, momentum of a point) in turn, and

    Δ ε̇_i = v_i − v_{i−1},   Δ ṗ_i = T(ε_{i+1} − ε_i),   v_0 = u_1,   T ε_{N+1} = u_2.

J and B are sparse: any number of cells.
"""

import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp

from dirax.gallery.example import Coordinate, Example
from dirax.schemes.discrete_dirac import DiscreteDirac
from dirax.show.scene import Scene, point, rod
from dirax.systems.port_hamiltonian import PortHamiltonian

CELLS = 8


def line(cells: int = CELLS) -> PortHamiltonian:
    """The line of length 1: state (ε_1, p_1, ε_2, p_2, …) (2N,), u = (velocity of the left end, stress at the right one)."""
    size, spacing = 2 * cells, 1.0 / cells
    neighbours = np.ones(size - 1)
    # dH = Δ(T ε, p/ρ) in the coordinates x, so that the flow of each is a difference over Δ²
    J = (sp.csr_matrix(sp.diags(neighbours, 1)) - sp.csr_matrix(sp.diags(neighbours, -1))) / spacing**2
    B = sp.csr_matrix(([-1.0 / spacing, 1.0 / spacing], ([0, size - 1], [0, 1])), (size, 2))
    return PortHamiltonian(lambda x: spacing * jnp.sum(x**2) / 2, sp.csr_matrix(J), B)


def pulse(cells: int = CELLS, place: float = 0.5, width: float = 0.1) -> np.ndarray:
    """A pulse of strain that goes to the right: p = −ε."""
    x = np.empty(2 * cells)
    shape = lambda s: np.exp(-(((s - place) / width) ** 2))
    x[0::2] = shape((np.arange(cells) + 0.5) / cells)
    x[1::2] = -shape(np.arange(1, cells + 1) / cells)
    return x


def scene(cells: int = CELLS) -> Scene:
    """The strain, drawn upwards, over the middles of the cells."""
    cell = lambda i: lambda x: jnp.stack([jnp.asarray((i + 0.5) / cells), 0.0 * x[0], 0.4 * x[2 * i]])
    joined = (rod(cell(i), cell(i + 1)) for i in range(cells - 1))
    line = rod((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), radius=0.003)
    return Scene((line, *joined, *(point(cell(i), radius=0.02) for i in range(cells))), "front")


EXAMPLE = Example(
    name="wave-line",
    title="Wave equation with ports at its ends",
    source="van der Schaft & Maschke, J. Geom. Phys. 42 (2002) 166",
    system=line(),
    initial={"x": pulse()},
    scheme=DiscreteDirac(),
    step=0.02,
    steps=200,
    coordinates=tuple(Coordinate(f"{letter}{i}") for i in range(1, CELLS + 1) for letter in ("ε", "p")),
    scene=scene(),
)
