"""An LC ladder, stated by a list of its elements: of very many sections, a transmission line."""

import jax.numpy as jnp
import numpy as np

from dirax.gallery.example import Coordinate, Example
from dirax.schemes.discrete_dirac import DiscreteDirac
from dirax.show.scene import Scene, arrow, box, rod, spring
from dirax.systems.circuit import GROUND, Element, circuit


def ladder(sections: int = 4, inductance: float = 1.0, capacitance: float = 1.0) -> list[Element]:
    """Sections of an inductor along and a capacitor to the ground; its first inductor is tied to the ground."""
    along: list[Element] = [("L", k, k + 1, inductance) for k in range(sections)]
    return along + [("C", k + 1, GROUND, capacitance) for k in range(sections)]


def frequencies(sections: int = 4, inductance: float = 1.0, capacitance: float = 1.0) -> np.ndarray:
    """The ladder's angular frequencies, 2/√(LC) sin((2k − 1)π/(4n + 2)), k = 1, …, n."""
    k = np.arange(1, sections + 1)
    return 2 / np.sqrt(inductance * capacitance) * np.sin((2 * k - 1) * np.pi / (4 * sections + 2))


def pulse(sections: int, place: float, width: float, inductance: float = 1.0, capacitance: float = 1.0) -> np.ndarray:
    """Charges and fluxes (2·sections,) of a pulse of voltage 1 that goes to the right, 1/√(LC) sections in a unit of time, as
    d'Alembert has it of one that is wide and far from the ends: `place` and `width` in sections; the voltage is √(L/C) times the
    current."""
    shape = lambda at: np.exp(-(((at - place) / width) ** 2))
    at = np.arange(sections)
    return np.concatenate([capacitance * shape(at + 1.0), np.sqrt(inductance * capacitance) * shape(at + 0.5)])


def scene(sections: int = 4) -> Scene:
    """Coils and capacitors of the ladder: the charges as bars on these, the fluxes as arrows along those."""
    parts = []
    for k in range(sections):
        node, ground = (k + 1.0, 0.0, 0.0), (k + 1.0, 0.0, -0.9)
        charge = lambda x, k=k: jnp.stack([k + 1.0 + 0.0 * x[k], 0.0 * x[k], 0.8 * x[k]])
        flux = lambda x, k=sections + k: jnp.stack([0.8 * x[k], 0.0 * x[k], 0.0 * x[k]])
        parts += [spring((float(k), 0.0, 0.0), node, turns=4, radius=0.1)]
        parts += [rod(node, (k + 1.0, 0.0, -0.4), radius=0.012), rod((k + 1.0, 0.0, -0.55), ground, radius=0.012)]
        parts += [box((k + 1.0, 0.0, -0.4 - gap), size=(0.4, 0.4, 0.05), colour="ink") for gap in (0.0, 0.15)]
        parts += [rod(node, charge, radius=0.07, colour=1), arrow((k + 0.5, 0.0, 0.3), flux, colour=2)]
    return Scene((*parts, rod((0.0, 0.0, -0.9), (float(sections), 0.0, -0.9)), rod((0.0, 0.0, -0.9), (0.0, 0.0, 0.0))), "front")


EXAMPLE = Example(
    name="lc-ladder",
    title="LC ladder",
    source="closed port-Hamiltonian system of [BLM] §7, from a netlist",
    system=circuit(ladder()),
    initial={"x": np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])},
    scheme=DiscreteDirac(),
    step=0.05,
    steps=1000,
    coordinates=tuple(Coordinate(f"{letter}{i}") for letter in ("charge ", "flux ") for i in range(1, 5)),
    scene=scene(),
)
