"""Which entries convolutions of arrays multiply."""

import math
from typing import Any

import numpy as np


def factors(equation: Any) -> tuple[np.ndarray, np.ndarray]:
    """Of a `conv_general_dilated`, the entries of both operands that each result sums the products of: (*results, terms) numbers
    of entries, counted from 1; 0 for places outside of the first operand."""
    p, shapes = equation.params, [v.aval.shape for v in equation.invars]
    specs = p["dimension_numbers"].lhs_spec, p["dimension_numbers"].rhs_spec
    left, right = (np.arange(1, math.prod(s) + 1).reshape(s).transpose(spec) for s, spec in zip(shapes, specs, strict=True))
    axes = range(2, left.ndim)
    for axis, step, (low, high) in zip(axes, p["lhs_dilation"], p["padding"], strict=True):
        left = _padded(left, axis, step, low, high)
    for axis, stride, step in zip(reversed(axes), reversed(p["window_strides"]), reversed(p["rhs_dilation"]), strict=True):
        width = right.shape[axis]
        count = max((left.shape[axis] - (width - 1) * step - 1) // stride + 1, 0)
        left = np.take(left, stride * np.arange(count)[:, None] + step * np.arange(width), axis=axis)
    order = [*range(2, left.ndim, 2), 1, *range(3, left.ndim, 2)]  # places, channels, window
    left = left.transpose(0, *order)
    places, window = left.shape[1 : left.ndim // 2], left.shape[left.ndim // 2 + 1 :]
    groups, samples = p["feature_group_count"] * p["batch_group_count"], len(left) // p["batch_group_count"]
    channels, terms = right.shape[1], right.shape[1] * math.prod(window)
    if p["batch_group_count"] > 1:
        left = left.reshape(groups, samples, *places, terms).swapaxes(0, 1)
    else:
        left = np.moveaxis(left.reshape(samples, *places, groups, channels, *window), 1 + len(places), 1)
        left = left.reshape(samples, groups, *places, terms)
    right = right.reshape(groups, -1, terms)
    whole = (samples, groups, right.shape[1], *places, terms)
    both = np.expand_dims(left, 2), right.reshape(1, *right.shape[:2], *(1 for _ in places), terms)
    out = (*np.argsort(p["dimension_numbers"].out_spec), left.ndim - 1)
    shape = (samples, right.shape[0] * right.shape[1], *places, terms)
    first, second = (np.broadcast_to(a, whole).reshape(shape).transpose(out) for a in both)
    return first, second


def _padded(array: np.ndarray, axis: int, step: int, low: int, high: int) -> np.ndarray:
    """With step − 1 zeros between neighbours along an axis, and so many before and after; less than none are taken away."""
    array = np.moveaxis(array, axis, 0)
    wide = np.zeros((max((len(array) - 1) * step + 1, 0), *array.shape[1:]), array.dtype)
    wide[::step] = array
    wide = wide[max(-low, 0) : len(wide) - max(-high, 0)]
    return np.moveaxis(np.pad(wide, [(max(low, 0), max(high, 0)), *[(0, 0)] * (array.ndim - 1)]), 0, axis)
