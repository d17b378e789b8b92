"""The frames of a scene: where every body is along a trajectory, as numbers for drawing."""

import contextlib
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.show.arrays import Arrays
from dirax.show.scene import Part, Reading, Scene, axes, path, point
from dirax.show.turns import quaternions

FRAMES = 10_000
"""Most frames of one trajectory; a longer one is drawn at evenly spread rows."""

NUMBERS = 240_000
"""Most numbers of all frames together, which bounds the size of the page."""

TURN = "turn"

NOT_TRACEABLE = (jax.errors.TracerArrayConversionError, jax.errors.ConcretizationTypeError)


def scene_of(given: Any, dimension: int) -> Scene:
    """A Scene, from one or from a list of parts; without any, the path of the first coordinates."""
    if isinstance(given, Scene):
        return given
    if given is not None:
        return Scene(tuple(given) if isinstance(given, Sequence) else (given,))
    if dimension == 0:  # the shape space of a system that is reduced by all of its coordinates
        return Scene((axes(),))
    if dimension == 1:
        place, view = (lambda q, t: jnp.stack([t, jnp.zeros(()), q[0]])), "front"
    else:
        count = min(dimension, 3)
        place, view = (lambda q: q[:count]), "oblique" if count == 3 else "tilted"
    return Scene((axes(), path(place), point(place, trail=True)), view)


@dataclass(frozen=True)
class Motion:
    """Where the parts of a scene are along one trajectory, at the times `t` (frames,): `places[k]` holds by name arrays
    (frames, 3), quaternions (frames, 4) for turns, a single row where nothing moves; None for a part that this run cannot
    place."""

    t: np.ndarray
    places: tuple[dict[str, np.ndarray] | None, ...]


def motions(scene: Scene, runs: Sequence[tuple[dict[str, np.ndarray], Any]], most: int | None = None) -> list[Motion]:
    """The motion of every run, (rows by name, params), at no more than `most` evenly spread rows each."""
    moving = sum(4 if name == TURN else 3 for part in scene.parts for name, place in part.places.items() if callable(place))
    most = most or min(FRAMES, max(64, NUMBERS // max(1, moving * len(runs))))
    return [_motion(scene, rows, params, most, first=k == 0) for k, (rows, params) in enumerate(runs)]


def described(
    scene: Scene, arrays: Arrays, runs: Sequence[tuple[dict[str, np.ndarray], Any]], most: int | None = None
) -> dict[str, Any]:
    """The scene for the page: its parts, and for each run (rows by name, params) the channels that move them.

    A run without the fields that a place needs has None for it, and is drawn without that part.
    """
    channels, parts = [], []
    found = motions(scene, runs, most)
    for k, part in enumerate(scene.parts):
        named: dict[str, Any] = {}
        for name, place in part.places.items():
            if callable(place):
                named[name] = {"channel": len(channels)}
                channels.append((k, name))
            else:
                named[name] = {"constant": _constant(name, place, part)[0].tolist()}
        parts.append({"kind": part.kind, "places": named, **part.settings})
    return {
        "parts": parts,
        "view": list(scene.direction),
        "actors": [{"t": arrays.add(m.t), "channels": [_channel(arrays, m.places[k], n) for k, n in channels]} for m in found],
    }


def _constant(name: str, place: Any, part: Part) -> np.ndarray:
    return _checked(name, np.asarray(place, float)[None], f"{name} of a {part.kind}")


def _motion(scene: Scene, rows: dict[str, np.ndarray], params: Any, most: int, first: bool) -> Motion:
    if scene.fields is not None:
        with contextlib.suppress(KeyError):  # a run that has not what they are computed from
            rows = {**rows, **{name: np.asarray(a) for name, a in scene.fields(rows, params).items()}}
    total = len(rows["t"])
    chosen = np.unique(np.linspace(0, total - 1, min(total, most)).round().astype(int))
    frames = {name: np.asarray(a)[chosen] for name, a in rows.items()}
    wanted = [(k, name, place) for k, part in enumerate(scene.parts) for name, place in part.places.items() if callable(place)]
    given = [(k, name, place, _names(place, frames)) for k, name, place in wanted]
    if first and (lost := [place for _, _, place, names in given if names is None]):
        raise ValueError(
            f"a place of the scene takes {', '.join(inspect.signature(lost[0]).parameters)}, but a row of this solution has "
            f"{', '.join(sorted(rows))} and params: name the arguments after these."
        )
    unplaced = {k for k, _, _, names in given if names is None}
    usable = [(k, name, place, names) for k, name, place, names in given if k not in unplaced and names is not None]
    values = _along([(place, names) for _, _, place, names in usable], frames, params)
    places: list[dict[str, np.ndarray] | None] = [
        None if k in unplaced else {n: _constant(n, place, part) for n, place in part.places.items() if not callable(place)}
        for k, part in enumerate(scene.parts)
    ]
    for (k, name, place, _), value in zip(usable, values, strict=True):
        what = f"the function {getattr(place, '__name__', 'lambda')} of a scene"
        of_part = places[k]
        assert of_part is not None
        of_part[name] = _filled(_checked(name, value, what))
    return Motion(frames["t"], tuple(places))


def _filled(values: np.ndarray) -> np.ndarray:
    """Bodies stay where a run ended."""
    finite = values[np.all(np.isfinite(values), axis=1)]
    return np.where(np.isfinite(values), values, finite[-1] if len(finite) else 0.0)


def _names(place: Callable, frames: Mapping[str, np.ndarray]) -> tuple[str, ...] | None:
    """What a place is given, by the names of its arguments; None where the rows have not got it."""
    arguments = inspect.signature(place).parameters.values()
    names = tuple(a.name for a in arguments if a.default is a.empty)  # others are the function's own
    if len(names) == 1 and names[0] not in frames and names[0] not in ("p", "params", "x"):
        names = ("q",)
    if "q" not in frames:
        names = tuple("x" if name == "q" else name for name in names)
    return names if all(name in frames or name == "params" for name in names) else None


def _along(places: list[tuple[Callable, tuple[str, ...]]], frames: dict[str, np.ndarray], params: Any) -> list[np.ndarray]:
    """Every place at every row: compiled, or row by row where JAX cannot trace it."""
    needed = {name for _, names in places for name in names} - {"params"}
    rows = {name: np.asarray(frames[name], float) for name in sorted(needed)}

    def at(row: dict[str, Any], params: Any) -> list[Any]:
        known, found = {**row, "params": params}, dict[int, Any]()

        def value(place: Callable, names: tuple[str, ...]) -> Any:
            if id(place) not in found:
                given = [known[name] for name in names]
                whole = place.read(value(place.whole, names), params) if isinstance(place, Reading) else place(*given)
                found[id(place)] = whole
            return found[id(place)]

        return [value(place, names) for place, names in places]

    if not places:
        return []
    try:
        with jax.numpy_dtype_promotion("standard"):
            found = jax.jit(jax.vmap(lambda row: [jnp.asarray(v, float) for v in at(row, params)]))(rows)
        return [np.asarray(value) for value in found]
    except NOT_TRACEABLE:
        each = [at({name: a[i] for name, a in rows.items()}, params) for i in range(len(frames["t"]))]
        return [np.array(values, float) for values in zip(*each, strict=True)]


def _checked(name: str, values: np.ndarray, what: str) -> np.ndarray:
    """Points (rows, 3), from those of a plane (rows, 2) too, or quaternions (rows, 4), from matrices too."""
    if name == TURN:
        if values.shape[1:] == (3, 3):
            return quaternions(values)
        if values.shape[1:] != (4,):
            raise ValueError(f"{what} must be a quaternion (4,) or a matrix (3, 3), but it has shape {values.shape[1:]}.")
        return values / np.linalg.norm(values, axis=1, keepdims=True)
    if values.shape[1:] not in ((2,), (3,)):
        raise ValueError(f"{what} must have two or three numbers, but it has shape {values.shape[1:]}.")
    return np.concatenate([values, np.zeros((len(values), 3 - values.shape[1]))], axis=1)


def _channel(arrays: Arrays, places: Mapping[str, np.ndarray] | None, name: str) -> list[Any] | None:
    """The columns of a channel: a number where it does not change, else a record of the page's arrays."""
    if places is None:
        return None
    if name == TURN:
        return [_quantized(arrays, column, 32767.0, "i2") for column in places[name].T]
    return [_quantized(arrays, column, None, "f4") for column in places[name].T]


def _quantized(arrays: Arrays, column: np.ndarray, scale: float | None, kind: str) -> Any:
    if np.all(column == column[0]):
        return float(column[0])
    if scale is None:
        return arrays.add(column, kind)
    return {**arrays.add(np.round(column * scale), kind), "scale": 1 / scale}
