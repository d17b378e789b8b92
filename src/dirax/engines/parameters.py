"""Parameters of a step: which leaves of the user's pytree are scalar inputs of its program."""

import math
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from dirax.program.interpreter import UnsupportedPrimitive
from dirax.program.memo import Same


@dataclass(frozen=True)
class Parameters:
    """How a params pytree becomes scalar inputs: floating leaves in order; other leaves are part of the program, or, where
    they have a batch axis, inputs too, of their own dtype to the user's functions."""

    shapes: tuple[tuple[int, ...], ...]
    dtypes: tuple[np.dtype, ...]
    fixed: tuple[Any, ...]
    treedef: Any
    dynamic: tuple[bool, ...]

    @property
    def size(self) -> int:
        """How many numbers they are."""
        return sum(int(np.prod(s)) for s in self.shapes)

    @property
    def key(self) -> tuple:
        """Equal for parameters that give the same program; other leaves than arrays count by identity."""
        fixed = ((a.dtype.str, a.shape, a.tobytes()) if isinstance(a, np.ndarray) else Same(a) for a in self.fixed)
        return self.treedef, self.shapes, self.dtypes, tuple(fixed)

    def split(self, numbers) -> Any:
        """The pytree of its inputs as one array (size,), with other numbers after them."""
        parts, at = [], 0
        for shape in self.shapes:
            count = math.prod(shape)
            parts.append(numbers[at : at + count].reshape(shape))
            at += count
        return self.rebuild(parts)

    def rebuild(self, leaves) -> Any:
        """The pytree of its float64 inputs."""
        own = lambda x, dtype: x if np.issubdtype(dtype, np.floating) else x.astype(dtype)
        leaves, fixed = iter([own(*given) for given in zip(leaves, self.dtypes, strict=True)]), iter(self.fixed)
        return jax.tree.unflatten(self.treedef, [next(leaves) if d else next(fixed) for d in self.dynamic])

    def flatten(self, params: Any, batch: int | None, xp: Any = np) -> np.ndarray:
        """The floating leaves as (size,), or (B, size) with their batch axis."""
        leaves = jax.tree.leaves(params)
        if len(self.shapes) < len(self.dynamic):
            leaves = [leaf for leaf, d in zip(leaves, self.dynamic, strict=True) if d]
        lead = () if batch is None else (batch,)
        columns = [xp.asarray(leaf, dtype=np.float64).reshape(*lead, -1) for leaf in leaves]
        return xp.concatenate(columns, axis=-1) if columns else xp.zeros((*lead, 0))


def parameters(params: Any, batched: bool) -> Parameters:
    """Which leaves of `params` are inputs. Raises `UnsupportedPrimitive` for leaves that JAX traces and that are no floats."""
    leaves, treedef = jax.tree.flatten(params)
    dynamic, shapes, dtypes, fixed = [], [], [], []
    for leaf in leaves:
        number = isinstance(leaf, int | float | np.ndarray | np.generic | jax.Array) and not isinstance(leaf, bool)
        dtype = leaf.dtype if isinstance(leaf, Tracer) else np.asarray(leaf).dtype
        moves = number and (batched or np.issubdtype(dtype, np.floating))
        dynamic.append(bool(moves))
        if moves:
            shapes.append(np.shape(leaf)[1:] if batched else np.shape(leaf))
            dtypes.append(np.dtype(dtype))
        else:
            if isinstance(leaf, Tracer):
                raise UnsupportedPrimitive("params", f"has a leaf of dtype {dtype} that JAX traces", "see docs/native-engine.md")
            fixed.append(np.asarray(leaf) if number else leaf)
    return Parameters(tuple(shapes), tuple(dtypes), tuple(fixed), treedef, tuple(dynamic))
