"""Rules of primitives that move entries about: they run on the arrays of node numbers themselves."""

import itertools
from typing import Any

import numpy as np

from dirax.program.interpreter import Interpreter, Unsupported, rule

CHOICES = 1024
"""Most places that an index which depends on the state may point to."""


@rule("reshape", "squeeze", "expand_dims")
def reshape(interpreter: Interpreter, equation: Any, x, *_):
    order = equation.params.get("dimensions")  # of the axes before, where a function has one: of jnp.ravel(x, order="F")
    if equation.primitive.name == "reshape" and order is not None:
        x = np.transpose(x, order)
    return [x.reshape(equation.outvars[0].aval.shape)]


@rule("broadcast_in_dim")
def broadcast_in_dim(interpreter: Interpreter, equation: Any, x, *_):
    shape, dimensions = equation.params["shape"], equation.params["broadcast_dimensions"]
    inner = [1] * len(shape)
    for axis, where in enumerate(dimensions):
        inner[where] = x.shape[axis]
    return [np.broadcast_to(x.reshape(inner), shape)]


@rule("transpose")
def transpose(interpreter: Interpreter, equation: Any, x):
    return [np.transpose(x, equation.params["permutation"])]


@rule("rev")
def reverse(interpreter: Interpreter, equation: Any, x):
    return [np.flip(x, equation.params["dimensions"])]


@rule("concatenate")
def concatenate(interpreter: Interpreter, equation: Any, *parts):
    return [np.concatenate(parts, axis=equation.params["dimension"])]


@rule("stack")
def stack(interpreter: Interpreter, equation: Any, *parts):
    return [np.stack(parts, axis=equation.params["axis"])]


@rule("unstack")
def unstack(interpreter: Interpreter, equation: Any, x):
    axis = equation.params["axis"]
    return [np.take(x, i, axis=axis) for i in range(x.shape[axis])]


@rule("tile")
def tile(interpreter: Interpreter, equation: Any, x):
    return [np.tile(x, equation.params["reps"])]


@rule("split")
def split(interpreter: Interpreter, equation: Any, x):
    return np.split(x, np.cumsum(equation.params["sizes"])[:-1], axis=equation.params["axis"])


@rule("slice")
def static_slice(interpreter: Interpreter, equation: Any, x):
    p = equation.params
    strides = p["strides"] or (1,) * x.ndim
    return [x[tuple(slice(a, b, s) for a, b, s in zip(p["start_indices"], p["limit_indices"], strides, strict=True))]]


@rule("pad")
def pad(interpreter: Interpreter, equation: Any, x, filler):
    config = equation.params["padding_config"]
    out = np.full(equation.outvars[0].aval.shape, filler.item(), dtype=np.int64)
    for index in np.ndindex(*x.shape):
        target = tuple(low + i * (inside + 1) for i, (low, _, inside) in zip(index, config, strict=True))
        if all(0 <= t < n for t, n in zip(target, out.shape, strict=True)):
            out[target] = x[index]
    return [out]


@rule("empty", "empty2")
def empty(interpreter: Interpreter, equation: Any):
    return [interpreter.constants(np.zeros(equation.outvars[0].aval.shape))]


@rule("iota")
def iota(interpreter: Interpreter, equation: Any):
    p = equation.params
    shape = equation.outvars[0].aval.shape
    along = [1] * len(shape)
    along[p["dimension"]] = -1
    values = np.broadcast_to(np.arange(shape[p["dimension"]]).reshape(along), shape)
    return [interpreter.constants(values)]


# ---------------------------------------------------------------------- indices that may depend on the state


def places(interpreter: Interpreter, starts: list[int], sizes, shape):
    """For each start (a node): the admissible values, and how the node is compared with each."""
    options = []
    for start, size, n in zip(starts, sizes, shape, strict=True):
        fixed = interpreter.static(np.array(start))
        if fixed is not None:
            options.append([int(fixed)])
        elif n - size + 1 > CHOICES:
            raise Unsupported(f"indexes {n - size + 1} places by a number that depends on the state")
        else:
            options.append(list(range(n - size + 1)))
    return options


def read_at(interpreter: Interpreter, x: np.ndarray, starts: list[int], sizes, offset, fill: int | None) -> int:
    """The node of x at starts + offset: clamped into the array, or `fill` outside it."""
    g = interpreter.graph
    options = places(interpreter, starts, sizes, x.shape)

    def choose(axis: int, index: tuple[int, ...]) -> int:
        if axis == x.ndim:
            return int(x[index])
        values, last = options[axis], x.shape[axis] - sizes[axis]
        if interpreter.static(np.array(starts[axis])) is not None:
            if fill is not None and not 0 <= values[0] <= last:
                return fill
            return choose(axis + 1, (*index, min(max(values[0], 0), last) + offset[axis]))
        node, result = starts[axis], fill
        for value in reversed(values):
            entry = choose(axis + 1, (*index, value + offset[axis]))
            test = g.make("le" if fill is None else "eq", node, g.constant(float(value)))
            result = entry if result is None else g.select(test, entry, result)
        assert result is not None
        return result

    return choose(0, ())


@rule("dynamic_slice")
def dynamic_slice(interpreter: Interpreter, equation: Any, x, *starts):
    sizes = equation.params["slice_sizes"]
    begin = [int(s.item()) for s in starts]
    out = np.empty(sizes, dtype=np.int64)
    for index in np.ndindex(*sizes):
        out[index] = read_at(interpreter, x, begin, sizes, index, None)
    return [out]


@rule("dynamic_update_slice")
def dynamic_update_slice(interpreter: Interpreter, equation: Any, x, update, *starts):
    begin = [int(s.item()) for s in starts]
    limits = [n - s for n, s in zip(x.shape, update.shape, strict=True)]
    g, out = interpreter.graph, x.copy()
    clamp = lambda node, top: g.make("min", g.make("max", node, g.zero), g.constant(float(top)))
    begin = [clamp(node, top) for node, top in zip(begin, limits, strict=True)]
    for index in np.ndindex(*update.shape):
        write_at(interpreter, out, begin, update.shape, index, int(update[index]), lambda old, new: new)
    return [out]


def write_at(interpreter: Interpreter, out: np.ndarray, starts, sizes, offset, new: int, combine) -> None:
    """out[starts + offset] = combine(old, new), nothing outside the array."""
    g = interpreter.graph
    options = places(interpreter, starts, sizes, out.shape)
    dynamic = [interpreter.static(np.array(s)) is None for s in starts]
    for choice in itertools.product(*options):
        if not all(0 <= c <= n - s for c, n, s in zip(choice, out.shape, sizes, strict=True)):
            continue
        index = tuple(c + o for c, o in zip(choice, offset, strict=True))
        here = g.true
        for node, value, moves in zip(starts, choice, dynamic, strict=True):
            if moves:
                here = g.make("and", here, g.make("eq", node, g.constant(float(value))))
        out[index] = g.select(here, combine(int(out[index]), new), int(out[index]))


@rule("gather")
def gather(interpreter: Interpreter, equation: Any, x, indices):
    p, shape = equation.params, equation.outvars[0].aval.shape
    d, sizes, fill = p["dimension_numbers"], p["slice_sizes"], None
    if "FILL" in str(p["mode"]):
        value = p["fill_value"]
        if value is None:
            value = np.nan if x.size and equation.outvars[0].aval.dtype == np.float64 else 0
        boolean = equation.outvars[0].aval.dtype == np.bool_
        fill = interpreter.graph.constant(bool(value) if boolean else float(value))
    kept = [a for a in range(x.ndim) if a not in d.collapsed_slice_dims and a not in d.operand_batching_dims]
    batch_axes = [a for a in range(len(shape)) if a not in d.offset_dims]
    if (fixed := interpreter.static(indices)) is not None:
        batching = dict(zip(d.operand_batching_dims, d.start_indices_batching_dims, strict=True))
        window = dict(zip(kept, d.offset_dims, strict=True))
        index, within = _known_places(fixed, shape, batch_axes, d.start_index_map, batching, window, x.shape, sizes)
        return [x[index] if fill is None else np.where(within, x[index], fill)]
    out = np.empty(shape, dtype=np.int64)
    for index in np.ndindex(*shape):
        batch = tuple(index[a] for a in batch_axes)
        starts = _starts(interpreter, indices, batch, d.start_index_map, x.ndim)
        for axis, along in zip(d.operand_batching_dims, d.start_indices_batching_dims, strict=True):
            starts[axis] = interpreter.graph.constant(float(batch[along]))
        offset = [0] * x.ndim
        for axis, where in zip(kept, d.offset_dims, strict=True):
            offset[axis] = index[where]
        out[index] = read_at(interpreter, x, starts, sizes, offset, fill)
    return [out]


def _known_places(
    fixed: np.ndarray, shape, batch_axes: list[int], index_map, batching: dict[int, int], window: dict[int, int], inside, sizes
) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Where the entries of this shape are in an array whose shape is `inside`, by known indices of slices of these `sizes`, which
    are clamped into it; and which of them are there without that. `batching` and `window` say of axes of the array at which of
    the batch and of the entries they are."""
    grid, nothing = np.indices(shape), np.zeros(shape, np.int64)
    batch = tuple(grid[a] for a in batch_axes)
    starts = {axis: np.broadcast_to(fixed[(*batch, k)], shape) for k, axis in enumerate(index_map)}
    starts |= {axis: batch[along] for axis, along in batching.items()}
    index, within = [], np.ones(shape, bool)
    for axis, (n, size) in enumerate(zip(inside, sizes, strict=True)):
        start, offset = starts.get(axis, nothing), grid[window[axis]] if axis in window else nothing
        index.append(np.clip(start, 0, n - size) + offset)
        within &= (start >= 0) & (start <= n - size)
    return tuple(index), within


def _starts(interpreter: Interpreter, indices, batch, index_map, rank: int) -> list[int]:
    starts = [interpreter.graph.zero] * rank
    for k, axis in enumerate(index_map):
        starts[axis] = int(indices[(*batch, k)])
    return starts


@rule("scatter", "scatter-add", "scatter-mul", "scatter-min", "scatter-max", "scatter-sub")
def scatter(interpreter: Interpreter, equation: Any, x, indices, updates):
    g, d = interpreter.graph, equation.params["dimension_numbers"]
    kind = equation.primitive.name[8:]
    combine = (lambda old, new: g.make(kind, old, new)) if kind else (lambda old, new: new)
    window = [a for a in range(x.ndim) if a not in d.inserted_window_dims and a not in d.operand_batching_dims]
    batch_axes = [a for a in range(updates.ndim) if a not in d.update_window_dims]
    sizes = [1] * x.ndim
    for axis, where in zip(window, d.update_window_dims, strict=True):
        sizes[axis] = updates.shape[where]
    clip, out = "CLIP" in str(equation.params["mode"]), x.copy()
    if (fixed := interpreter.static(indices)) is not None:
        batching = dict(zip(d.operand_batching_dims, d.scatter_indices_batching_dims, strict=True))
        known = dict(zip(window, d.update_window_dims, strict=True))
        at = fixed, updates.shape, batch_axes, d.scatter_dims_to_operand_dims, batching, known, x.shape, sizes
        index, within = _known_places(*at)
        within |= clip
        flat = np.ravel_multi_index(tuple(i[within] for i in index), x.shape) if x.ndim else np.zeros(updates.size, np.int64)
        nodes = out.ravel().tolist()
        for place, new in zip(flat.tolist(), updates[within].tolist(), strict=True):
            nodes[place] = combine(nodes[place], new)
        return [np.array(nodes, np.int64).reshape(out.shape)]
    for index in np.ndindex(*updates.shape):
        batch = tuple(index[a] for a in batch_axes)
        starts = _starts(interpreter, indices, batch, d.scatter_dims_to_operand_dims, x.ndim)
        for axis, along in zip(d.operand_batching_dims, d.scatter_indices_batching_dims, strict=True):
            starts[axis] = g.constant(float(batch[along]))
        if clip:
            tops = [g.constant(float(n - s)) for n, s in zip(x.shape, sizes, strict=True)]
            starts = [g.make("min", g.make("max", s, g.zero), top) for s, top in zip(starts, tops, strict=True)]
        offset = [0] * x.ndim
        for axis, where in zip(window, d.update_window_dims, strict=True):
            offset[axis] = index[where]
        write_at(interpreter, out, starts, sizes, offset, int(updates[index]), combine)
    return [out]
