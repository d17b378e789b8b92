"""Cards of the gallery: each system with its moving picture, its formulas, its command and what to look at."""

import inspect
import math
import re
from dataclasses import dataclass
from html import escape
from importlib import import_module
from pathlib import Path

from dirax import gallery
from dirax.show.animation import animate, calm_end
from dirax.show.page import equations_html

SECONDS, RATE, SIZE = 4.0, 15, (3.6, 2.4)
"""A moving picture: how long it takes, frames a second, inches of 100 dots."""

MOST_STEPS = 6000

LONGEST = 6500
"""Letters of MathML from which on the formula is the one that its author wrote."""

LOOK = {
    "rolling-disk": "The contact point goes round a circle; by (+) the circle grows, since that scheme feeds energy in.",
    "heisenberg": "A constraint without a force: the particle runs straight at constant velocity.",
    "kepler": "The ellipse closes: neither the energy nor the angular momentum drifts.",
    "double-pendulum": "Chaos, with an energy that stays in its band.",
    "cartesian-double-pendulum": "The same motion from positions and rods: both rods keep their lengths to roundoff.",
    "turntable": "The centre goes round with 2/7 of the table's frequency, wherever it began.",
    "henon-heiles": "A star between order and chaos: plot_section shows which.",
    "pendulum": "The level curves of the energy, followed by a map that is symplectic.",
    "rigid-body": "The tip of the momentum stays on its sphere to the last digit.",
    "free-top": "Turning about the middle axis is unstable: the body tumbles over and comes back.",
    "heavy-top": "The axis bows and comes up again while it goes round: nutation and precession.",
    "heavy-top-so3": "The same top with its attitude; the spatial momentum about the vertical is constant.",
    "suslov": "From one steady rotation to the opposite one: the energy is kept, the volume is not.",
    "chaplygin-sleigh-se2": "The momenta of the reduced sleigh: every motion ends going straight.",
    "underwater-vehicle": "Impulses that circle about a stable motion; three Casimirs stay where they are.",
    "kirchhoff": "Angular and linear impulse of a body in a fluid, on the level sets of two Casimirs.",
    "spherical-pendulums": "Through the poles without singular angles.",
    "charged-particle": "A helix; the charge is the momentum of a fourth, cyclic coordinate.",
    "magnetic-spherical-pendulum": "No Lagrangian: a magnetic bracket, and a rod that keeps its length.",
    "double-spherical-pendulum": "The angular momentum about the vertical is conserved, by the scheme and by its reduction.",
    "planar-n-body": "Three equal masses chase each other on a figure eight.",
    "vortices": "A Lagrangian without masses: two pairs leapfrog through each other.",
    "chaotic-vortices": "Four vortices in chaos: positions lose their meaning, the energy does not.",
    "lotka-volterra": "Predator and prey go round and round; an ordinary method spirals.",
    "guiding-centre": "A drift along the equipotentials, without the fast gyration.",
    "lc-ladder": "Charges and fluxes slosh up and down the ladder without loss.",
    "dc-motor": "Flux and angular momentum come to rest where voltage, resistance and drag balance.",
    "mass-spring-damper": "The books balance: the energy changes by what is supplied less what is lost, to roundoff.",
    "snakeboard": "It moves forward by wiggling alone.",
    "rolling-ball": "It falls with 5/7 of the slope's gravity, and keeps its spin.",
    "chaplygin-sleigh": "It swings round and then goes straight: no invariant measure.",
    "knife-edge": "On a slope it moves across and not down, on a cycloid.",
    "contact-particle": "A hard case: symmetric schemes keep its energy only while it is reversible.",
    "transmission": "A hard case: a pendulum sets the gear between two oscillators.",
    "bicycle": "Nobody steers: at 4.6 m/s the bicycle rights itself, and goes straight again.",
    "andrews-squeezer": "Seven bodies in three loops, driven by a motor: every joint stays closed to roundoff.",
    "four-bar": "A closed loop of links, stated as a tree and one joint that closes it.",
    "bricard": "Six hinges with one degree of freedom where counting says none: redundant constraints.",
    "tippe-top": "Friction turns the spinning top over: it ends on its stem.",
    "chaplygin-sphere": "A ball that is heavier on one side rolls on; its momentum about the contact stays.",
    "rattleback": "Spun the wrong way it begins to rattle, and turns round.",
    "euler-disk": "A coin that spins as it lies down, ever faster.",
    "flyball-governor": "The balls rise as the shaft turns faster.",
    "n-four-bar": "All windows fold through the flat position, where each of them could fold either way.",
    "car-axis": "Stiff springs on a road of waves, to thirteen published digits.",
    "slider-crank": "The rod bends and stretches as the crank drives the block to and fro.",
    "snakeboard-gait": "Axles and rotor swing with one frequency: the board rides off.",
    "trikke": "Three skates and a sway: nobody pushes, and it gathers speed.",
    "n-trailer": "Each trailer cuts the corner a little more than the one before it.",
    "robot-arm": "With its motors off it swings like a pendulum of six hinges, and its wrist goes its own ways.",
    "oscillator-chain": "The energy leaves the first mode and comes back to it.",
    "sine-gordon": "A kink runs along without changing its shape.",
    "hanging-chain": "As many rods as links, all of constant length.",
    "wave-line": "A pulse runs along a line with ports at both ends.",
    "wave-sheet": "A sheet swings to and fro; what flows through its sides is what its energy changes by.",
}
"""What to look at, by the name of the system."""


@dataclass(frozen=True)
class Card:
    """A system of the gallery to be looked at: `picture` is a file with its motion."""

    name: str
    title: str
    source: str
    what: str
    look: str
    formulas: str
    picture: Path

    def html(self, folder: str) -> str:
        """The card, on one line, with the picture looked for in `folder`."""
        about = escape(f"The motion of: {self.title}")
        width, height = (round(100 * side) for side in SIZE)
        return (
            f'<article class="system" id="{self.name}">'
            f'<img src="{folder}/{self.picture.name}" alt="{about}" width="{width}" height="{height}" loading="lazy">'
            f"<h3>{escape(self.title)}</h3><p>{escape(self.what)} <em>{escape(self.look)}</em></p>"
            f'{self.formulas}<p class="source">{escape(self.source)}</p>'
            f"<p><code>dirax report {self.name} --open</code></p></article>"
        ).replace("\n", " ")


def card(name: str, folder: Path) -> Card:
    """Run a system of the gallery and write its moving picture into `folder`."""
    example = gallery.get(name)
    sol = example.simulate(steps=min(example.steps, MOST_STEPS))
    end = calm_end(sol, round(SECONDS * RATE))
    shown = sol if math.isclose(end, float(sol.t[-1])) else sol[float(sol.t[0]) : end]
    picture = animate(shown, folder / f"{name}.webp", seconds=SECONDS, frames_per_second=RATE, size=SIZE)
    about = inspect.getdoc(import_module(f"dirax.gallery.{gallery.modules()[name]}")) or ""
    formulas = equations_html(sol)
    if not 0 < len(formulas) <= LONGEST:
        formulas = _written(about)
    what = about.partition("\n")[0].partition(": the system of")[0].rstrip(".") + "."
    return Card(
        name=name,
        title=example.title,
        source=example.source,
        what=what.replace("`", ""),
        look=LOOK[name],
        formulas=formulas,
        picture=picture,
    )


def _written(about: str) -> str:
    """The first formula of a text, its indented lines, as they were written."""
    found = re.search(r"(?:^    .+\n?)+", about, re.MULTILINE)
    if found is None:
        return ""
    lines = [escape(" ".join(line.split())) for line in found[0].splitlines()]
    return f'<div class="written">{"<br>".join(lines)}</div>'
