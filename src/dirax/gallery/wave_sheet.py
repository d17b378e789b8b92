"""Waves on a sheet as a port-Hamiltonian system with ports along two sides: a Stokes–Dirac structure on a staggered grid.

    Ė = ∂_x F + ∂_y G,   Ḟ = ∂_x E,   Ġ = ∂_y E,   H = ½ ∫ (E² + F² + G²) dx dy:

Maxwell's equations for E_z in a plane, with F = H_y and G = −H_x, or waves of shallow water. Inputs are F along the left side and
E along the right one (A. J. van der Schaft, B. M. Maschke, J. Geom. Phys. 42 (2002) 166); through the other two sides nothing
flows. E lives in the middle of cells, F on the right edge of each, G on the edges between cells above each other, as in the grid
of K. S. Yee (IEEE Trans. Antennas Propag. 14 (1966) 302). The state is x = (E, F, G), E and F column by column of cells.

With both inputs zero E = cos κ(i + ½) cos λ(j + ½) is a mode for κ = π(a + ½)/(columns + ½), λ = πb/rows, of the frequency
2 √(sin²(κ/2) + sin²(λ/2)) / Δ.
"""

import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp

from dirax.gallery.example import Coordinate, Example
from dirax.schemes.discrete_dirac import DiscreteDirac
from dirax.show.scene import Scene, point, rod
from dirax.systems.port_hamiltonian import PortHamiltonian

COLUMNS, ROWS = 4, 3


def structure(columns: int, rows: int, spacing: float = 1.0) -> tuple[sp.csr_matrix, sp.csr_matrix]:
    """J and B of a sheet."""
    along = lambda count: sp.eye_array(count, k=1, format="csr") - sp.eye_array(count, format="csr")
    cells, upwards = columns * rows, sp.csr_matrix(along(rows))[:-1]
    differences = sp.vstack([sp.kron(along(columns), sp.eye_array(rows)), sp.kron(sp.eye_array(columns), upwards)])
    # dH = Δ² x in the coordinates x, so that the flow of each is a difference over Δ³
    J = sp.block_array([[None, -differences.T], [differences, None]]) / spacing**3
    left, right = np.arange(rows), cells + (columns - 1) * rows + np.arange(rows)
    entries = np.repeat([-1.0, 1.0], rows) / spacing
    B = sp.csr_matrix((entries, (np.concatenate([left, right]), np.arange(2 * rows))), (3 * cells - columns, 2 * rows))
    return sp.csr_matrix(J), B


def sheet(columns: int = COLUMNS, rows: int = ROWS, spacing: float = 1.0) -> PortHamiltonian:
    """A sheet of square cells: 3·columns·rows − columns states, u = (F along the left side, E along the right one) (2·rows,)."""
    return PortHamiltonian(lambda x: spacing**2 * jnp.sum(x**2) / 2, *structure(columns, rows, spacing))


def mode(columns: int, rows: int, a: int, b: int, spacing: float = 1.0) -> tuple[np.ndarray, float]:
    """The state of a mode at rest, and its frequency."""
    kappa, lam = np.pi * (a + 0.5) / (columns + 0.5), np.pi * b / rows
    field = np.outer(np.cos(kappa * (np.arange(columns) + 0.5)), np.cos(lam * (np.arange(rows) + 0.5)))
    x = np.zeros(3 * columns * rows - columns)
    x[: columns * rows] = field.ravel()
    return x, 2.0 * float(np.hypot(np.sin(kappa / 2), np.sin(lam / 2))) / spacing


def scene(columns: int = COLUMNS, rows: int = ROWS) -> Scene:
    """E, drawn upwards, over the middles of the cells."""
    cell = lambda i, j: lambda x: jnp.stack([jnp.asarray(i / columns), jnp.asarray(j / columns), 0.2 * x[rows * i + j]])
    joined = [rod(cell(i, j), cell(i + 1, j)) for i in range(columns - 1) for j in range(rows)]
    joined += [rod(cell(i, j), cell(i, j + 1)) for i in range(columns) for j in range(rows - 1)]
    return Scene((*joined, *(point(cell(i, j), radius=0.02) for i in range(columns) for j in range(rows))))


EXAMPLE = Example(
    name="wave-sheet",
    title="Waves on a sheet with ports along two sides",
    source="van der Schaft & Maschke, J. Geom. Phys. 42 (2002) 166",
    system=sheet(),
    initial={"x": mode(COLUMNS, ROWS, 0, 1)[0]},
    scheme=DiscreteDirac(),
    step=0.05,
    steps=300,
    coordinates=(
        *(Coordinate(f"{letter}{i}{j}") for letter in "EF" for i in range(1, COLUMNS + 1) for j in range(1, ROWS + 1)),
        *(Coordinate(f"G{i}{j}") for i in range(1, COLUMNS + 1) for j in range(1, ROWS)),
    ),
    scene=scene(),
)
