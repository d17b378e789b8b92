"""Where primitives with known indices read and write, in NumPy: a compiler would take longer than all of it."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jax.lax import GatherScatterMode


def read(equation: Any, arrays: Sequence[np.ndarray], indices: Sequence[np.ndarray]) -> np.ndarray:
    """The result of a 'gather', 'dynamic_slice' or 'dynamic_update_slice' of arrays of whole numbers; 0 for what is outside."""
    p, shape = equation.params, arrays[0].shape
    if equation.primitive.name == "gather":
        d = p["dimension_numbers"]
        kept = (d.offset_dims, d.collapsed_slice_dims, d.operand_batching_dims, d.start_indices_batching_dims)
        clips = p["mode"] != GatherScatterMode.FILL_OR_DROP
        return np.append(0, arrays[0])[_places(indices[0], shape, p["slice_sizes"], d.start_index_map, *kept, clips)]
    starts = np.array([int(i) for i in indices])
    if equation.primitive.name == "dynamic_slice":
        every = tuple(range(len(shape)))
        return np.append(0, arrays[0])[_places(starts, shape, p["slice_sizes"], every, every, (), (), (), True)]
    written, sizes = arrays[0].copy(), arrays[1].shape
    starts = np.clip(starts, 0, np.subtract(shape, sizes))
    written[tuple(slice(start, start + size) for start, size in zip(starts, sizes, strict=True))] = arrays[1]
    return written


def places_of_updates(equation: Any, indices: np.ndarray, shape: tuple[int, ...], given: tuple[int, ...]) -> np.ndarray:
    """Where a scatter writes each of its updates, of shape `given`, in an array of `shape`, counted from 1; 0 for outside it."""
    d = equation.params["dimension_numbers"]
    single, sizes = {*d.inserted_window_dims, *d.operand_batching_dims}, [1] * len(shape)
    window = [axis for axis in range(len(shape)) if axis not in single]
    for axis, along in zip(window, d.update_window_dims, strict=True):
        sizes[axis] = given[along]
    kept = (d.update_window_dims, d.inserted_window_dims, d.operand_batching_dims, d.scatter_indices_batching_dims)
    clips = equation.params["mode"] == GatherScatterMode.CLIP
    return _places(indices, shape, sizes, d.scatter_dims_to_operand_dims, *kept, clips).ravel()


def _places(
    indices: np.ndarray,
    shape: tuple[int, ...],
    sizes: Sequence[int],
    index_map: Sequence[int],
    window_axes: Sequence[int],
    single: Sequence[int],
    batching: Sequence[int],
    batching_of_indices: Sequence[int],
    clips: bool,
) -> np.ndarray:
    """The entries, counted from 1, of windows of these sizes that begin at the `indices` (batch…, axes of the `index_map`), whose
    axes are the `window_axes` of the result; outside of the array 0, or the nearest window where it `clips`."""
    batch = indices.shape[:-1]
    starts = np.zeros((*batch, len(shape)), np.int64)
    starts[..., list(index_map)] = indices
    for axis, along in zip(batching, batching_of_indices, strict=True):
        starts[..., axis] = np.moveaxis(np.arange(batch[along]).reshape(-1, *[1] * (len(batch) - 1)), 0, along)
    last = np.subtract(shape, sizes)
    inside = np.all((starts >= 0) & (starts <= last), axis=-1)
    strides = np.array([math.prod(shape[axis + 1 :]) for axis in range(len(shape))], np.int64)
    own = np.arange(1, math.prod(shape) + 1).reshape(shape)[tuple(map(slice, sizes))]
    own = own.squeeze(tuple({*single, *batching}))
    alone = lambda a: np.reshape(a, (*batch, *[1] * own.ndim))
    places = alone(np.clip(starts, 0, last) @ strides) + own
    places = places if clips else np.where(alone(inside), places, 0)
    return np.moveaxis(places, range(len(batch), places.ndim), window_axes)
