"""Four equal point vortices in chaotic motion, the kind of run on which Rowley & Marsden (2002) compare integrators.

The equations and H are those of `vortices`, with Γ = (1, 1, 1, 1). Four vortices are in general not integrable (Aref & Pompre
1982). The initial points are our own, found by search and rounded: a difference of 1e-9 in x_1 has grown to 1e-2 by t = 140,
and to the size of the motion by t = 200, so positions mean little after that; the energy, the linear impulse Σ Γ z and the
angular impulse Σ Γ |z|² are constant.
"""

import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.gallery.vortices import point_vortices
from dirax.gallery.vortices import scene as vortex_scene
from dirax.schemes.discrete_dirac import DiscreteDirac

CIRCULATIONS = (1.0, 1.0, 1.0, 1.0)
START = np.array([0.9, -0.1, -1.4, 0.1, 1.1, 0.4, 0.4, -0.3])

EXAMPLE = Example(
    name="chaotic-vortices",
    title="Four equal point vortices in chaotic motion",
    source="after Rowley & Marsden 2002, with data of our own",
    system=point_vortices(CIRCULATIONS),
    initial={"q": START, "v": np.zeros(8)},
    scheme=DiscreteDirac(constraints="resolve"),
    step=0.05,
    steps=4000,
    coordinates=tuple(Coordinate(f"{letter}{j}") for letter in "xy" for j in range(1, 5)),
    plane=(0, 4),
    scene=vortex_scene(),
)
