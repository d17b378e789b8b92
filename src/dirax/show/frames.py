"""The frames of a scene: where every body is along a trajectory, as numbers for drawing."""

import contextlib
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.show.arrays import Arrays
from dirax.show.scene import Part, Scene, axes, path, point
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
    if dimension == 1:
        place, view = (lambda q, t: jnp.stack([t, jnp.zeros(()), q[0]])), "front"
    else:
        count = min(dimension, 3)
        place, view = (lambda q: q[:count]), "oblique" if count == 3 else "tilted"
    return Scene((axes(), path(place), point(place, trail=True)), view)


def described(scene: Scene, arrays: Arrays, runs: Sequence[tuple[dict[str, np.ndarray], Any]]) -> dict[str, Any]:
    """The scene for the page: its parts, and for each run (rows by name, params) the channels that move them.

    A run without the fields that a place needs has None for it, and is drawn without that part.
    """
    places, parts = [], []
    for part in scene.parts:
        named = {}
        for name, place in part.places.items():
            if callable(place):
                named[name] = {"channel": len(places)}
                places.append((name, place))
            else:
                named[name] = {"constant": _constant(name, place, part)}
        parts.append({"kind": part.kind, "places": named, **part.settings})
    most = max(64, NUMBERS // max(1, sum(4 if name == TURN else 3 for name, _ in places) * len(runs)))
    return {
        "parts": parts,
        "view": list(scene.direction),
        "actors": [_actor(scene, places, arrays, *run, min(most, FRAMES), first=k == 0) for k, run in enumerate(runs)],
    }


def _constant(name: str, place: Any, part: Part) -> list[float]:
    value = np.asarray(place, float)
    return _checked(name, value[None], f"{name} of a {part.kind}")[0].tolist()


def _actor(
    scene: Scene, places: list, arrays: Arrays, rows: dict[str, np.ndarray], params: Any, most: int, first: bool
) -> dict[str, Any]:
    if scene.fields is not None:
        with contextlib.suppress(KeyError):  # a run that has not what they are computed from
            rows = {**rows, **{name: np.asarray(a) for name, a in scene.fields(rows, params).items()}}
    total = len(rows["t"])
    chosen = np.unique(np.linspace(0, total - 1, min(total, most)).round().astype(int))
    frames = {name: np.asarray(a)[chosen] for name, a in rows.items()}
    given = [(k, name, place, _names(place, frames)) for k, (name, place) in enumerate(places)]
    if first and (lost := [place for _, _, place, names in given if names is None]):
        raise ValueError(
            f"a place of the scene takes {', '.join(inspect.signature(lost[0]).parameters)}, but a row of this solution has "
            f"{', '.join(sorted(rows))} and params: name the arguments after these."
        )
    usable = [(k, name, place, names) for k, name, place, names in given if names is not None]
    values = _along([(place, names) for _, _, place, names in usable], frames, params)
    channels: list[Any] = [None] * len(places)
    for (k, name, place, _), value in zip(usable, values, strict=True):
        what = f"the function {getattr(place, '__name__', 'lambda')} of a scene"
        channels[k] = _channel(arrays, name, _checked(name, value, what))
    return {"t": arrays.add(frames["t"]), "channels": channels}


def _names(place: Callable, frames: Mapping[str, np.ndarray]) -> tuple[str, ...] | None:
    """What a place is given, by the names of its arguments; None where the rows have not got it."""
    arguments = inspect.signature(place).parameters.values()
    names = tuple(a.name for a in arguments if a.default is a.empty)  # others are the function's own
    if len(names) == 1 and names[0] not in frames and names[0] not in ("p", "params", "x"):
        names = ("q" if "q" in frames else "x",)
    return names if all(name in frames or name == "params" for name in names) else None


def _along(places: list[tuple[Callable, tuple[str, ...]]], frames: dict[str, np.ndarray], params: Any) -> list[np.ndarray]:
    """Every place at every row: compiled, or row by row where JAX cannot trace it."""
    needed = {name for _, names in places for name in names} - {"params"}
    rows = {name: np.asarray(frames[name], float) for name in sorted(needed)}

    def at(row: dict[str, Any], params: Any) -> list[Any]:
        known = {**row, "params": params}
        return [place(*(known[name] for name in names)) for place, names in places]

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


def _channel(arrays: Arrays, name: str, values: np.ndarray) -> list[Any]:
    """The columns of a channel: a number where it does not change, else a record of the page's arrays."""
    finite = values[np.all(np.isfinite(values), axis=1)]
    values = np.where(np.isfinite(values), values, finite[-1] if len(finite) else 0.0)  # bodies stay where a run ended
    if name == TURN:
        return [_quantized(arrays, column, 32767.0, "i2") for column in values.T]
    return [_quantized(arrays, column, None, "f4") for column in values.T]


def _quantized(arrays: Arrays, column: np.ndarray, scale: float | None, kind: str) -> Any:
    if np.all(column == column[0]):
        return float(column[0])
    if scale is None:
        return arrays.add(column, kind)
    return {**arrays.add(np.round(column * scale), kind), "scale": 1 / scale}
