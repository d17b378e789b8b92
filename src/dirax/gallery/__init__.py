"""Ready-made systems with their sources' data: `names()`, `get(name)`, and the papers' figures drawn again."""

import difflib
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dirax.gallery.example import Coordinate, Example

__all__ = ["Coordinate", "Example", "get", "names"]

_MODULES = {
    "rolling-disk": "rolling_disk",
    "heisenberg": "heisenberg",
    "kepler": "kepler",
    "double-pendulum": "double_pendulum",
    "cartesian-double-pendulum": "cartesian_double_pendulum",
    "turntable": "turntable",
    "henon-heiles": "henon_heiles",
    "pendulum": "pendulum",
    "rigid-body": "rigid_body",
    "free-top": "free_top",
    "heavy-top": "heavy_top",
    "heavy-top-so3": "heavy_top_so3",
    "suslov": "suslov",
    "chaplygin-sleigh-se2": "chaplygin_sleigh_se2",
    "underwater-vehicle": "underwater_vehicle",
    "kirchhoff": "kirchhoff",
    "spherical-pendulums": "spherical_pendulums",
    "charged-particle": "charged_particle",
    "magnetic-spherical-pendulum": "magnetic_spherical_pendulum",
    "double-spherical-pendulum": "double_spherical_pendulum",
    "planar-n-body": "planar_n_body",
    "vortices": "vortices",
    "chaotic-vortices": "chaotic_vortices",
    "lotka-volterra": "lotka_volterra",
    "guiding-centre": "guiding_centre",
    "lc-ladder": "lc_ladder",
    "dc-motor": "dc_motor",
    "mass-spring-damper": "mass_spring_damper",
    "snakeboard": "snakeboard",
    "rolling-ball": "rolling_ball",
    "chaplygin-sleigh": "chaplygin_sleigh",
    "knife-edge": "knife_edge",
    "contact-particle": "contact_particle",
    "transmission": "transmission",
    "oscillator-chain": "oscillator_chain",
    "sine-gordon": "sine_gordon",
    "hanging-chain": "hanging_chain",
    "wave-line": "wave_line",
    "wave-sheet": "wave_sheet",
    "bicycle": "bicycle",
    "andrews-squeezer": "andrews_squeezer",
    "four-bar": "four_bar",
    "bricard": "bricard",
    "tippe-top": "tippe_top",
    "chaplygin-sphere": "chaplygin_sphere",
    "rattleback": "rattleback",
    "euler-disk": "euler_disk",
    "flyball-governor": "flyball_governor",
    "n-four-bar": "n_four_bar",
    "car-axis": "car_axis",
    "slider-crank": "slider_crank",
    "snakeboard-gait": "snakeboard_gait",
    "trikke": "trikke",
    "n-trailer": "n_trailer",
    "robot-arm": "robot_arm",
}
"""Name → the module here that defines `EXAMPLE`; a new system is a file and a line."""


def names() -> tuple[str, ...]:
    """The names of the gallery's systems."""
    return tuple(_MODULES)


def modules() -> dict[str, str]:
    """The module here of each system."""
    return dict(_MODULES)


def get(name: str) -> "Example":
    """The example of that name; capitals, spaces and underscores do not matter.

    Raises `ValueError`, with the nearest name, for a name that is not in the gallery.
    """
    wanted = str(name).strip().lower().replace("_", "-").replace(" ", "-").replace("é", "e").replace("–", "-")
    if wanted not in _MODULES:
        near = difflib.get_close_matches(wanted, _MODULES, n=1, cutoff=0.4)
        hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(_MODULES)}."
        raise ValueError(f"no system {name!r:.60} in the gallery: {hint}")
    return import_module(f"dirax.gallery.{_MODULES[wanted]}").EXAMPLE


def __getattr__(name: str) -> Any:
    if name in ("Coordinate", "Example"):
        return getattr(import_module("dirax.gallery.example"), name)
    raise AttributeError(f"module 'dirax.gallery' has no attribute {name!r}")
