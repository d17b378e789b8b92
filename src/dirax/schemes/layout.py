"""Layout: the named parts of a flat vector, in order."""

import math
from collections import namedtuple
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class Layout(Mapping[str, tuple[int, ...]]):
    """The named parts of a flat vector, in order: the state of a scheme, or the unknowns of its step.

    A part is a vector, named with its length, or an array or a number, named with its shape; it may be empty. A layout is
    the mapping from names to shapes, so that one layout is made of another's parts: `Layout(x=3, **other)`.

        state = dx.Layout(q=2, p=2, work=())
        q, p, work = state.split(vector)  # also .q, .p, .work
        vector = state.join(q=q, p=p)  # a part that is not given is zero

    Splitting takes plain slices and joining is a concatenation: both are traceable and cost nothing.
    Raises `TypeError` for a part that is no length and no shape.
    """

    def __init__(self, /, **parts: int | tuple[int, ...]):
        for name, part in parts.items():
            sizes = part if isinstance(part, tuple) else (part,)
            if not all(isinstance(size, int) and size >= 0 for size in sizes):
                raise TypeError(f"the part {name!r} of a layout must be a length or a shape, but {part!r} was given.")
        self._shapes = {name: part if isinstance(part, tuple) else (part,) for name, part in parts.items()}
        self._kind = _kind(tuple(parts))
        self._places, at = {}, 0
        for name, shape in self._shapes.items():
            self._places[name] = slice(at, at + math.prod(shape))
            at += math.prod(shape)
        self.size = at

    def __getitem__(self, name: str) -> tuple[int, ...]:
        return self._shapes[name]

    def __iter__(self):
        return iter(self._shapes)

    def __len__(self) -> int:
        return len(self._shapes)

    def __hash__(self) -> int:
        return hash(tuple(self._shapes.items()))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Layout) and list(self._shapes.items()) == list(other._shapes.items())

    def __repr__(self) -> str:
        parts = ((name, shape[0] if len(shape) == 1 else shape) for name, shape in self._shapes.items())
        return f"Layout({', '.join(f'{name}={part}' for name, part in parts)})"

    def place(self, name: str) -> slice:
        """Where a part lies in the vector."""
        return self._places[name]

    def split(self, vector: Float[Array, " size"]) -> Any:
        """The parts of a vector, in order and by name (a named tuple)."""
        if vector.shape != (self.size,):
            raise ValueError(f"{self!r} takes a vector of length {self.size}, but one of shape {vector.shape} was given.")
        return self._kind(*(self._part(vector, name) for name in self._shapes))

    def join(self, /, **parts: Any) -> Float[Array, " size"]:
        """The vector of these parts; those that are not given are zero. Raises `ValueError` for one of another shape."""
        if unknown := parts.keys() - self._shapes.keys():
            raise ValueError(f"{self!r} has no part {', '.join(sorted(unknown))}.")
        pieces = [self._piece(name, parts.get(name)) for name, shape in self._shapes.items() if math.prod(shape)]
        return jnp.concatenate(pieces) if pieces else jnp.zeros(0)

    def replace(self, vector: Float[Array, " size"], /, **parts: Any) -> Float[Array, " size"]:
        """The vector with these parts instead of its own."""
        return self.join(**self.split(vector)._asdict() | parts)

    def without(self, *names: str) -> dict[str, tuple[int, ...]]:
        """The names and shapes of the other parts."""
        return {name: shape for name, shape in self._shapes.items() if name not in names}

    def rest(self, vector: Float[Array, " size"], *names: str) -> dict[str, Array]:
        """The other parts of a vector, by name."""
        return {name: part for name, part in self.split(vector)._asdict().items() if name not in names}

    @property
    def entries(self) -> tuple[str, ...]:
        """The name of each number of the vector, such as `q[0]`, for messages."""
        return tuple(
            f"{name}[{', '.join(map(str, index))}]" if shape else name
            for name, shape in self._shapes.items()
            for index in np.ndindex(shape)
        )

    def _part(self, vector: Array, name: str) -> Array:
        place, shape = self._places[name], self._shapes[name]
        if not shape:
            return vector[place.start]
        return vector[place] if len(shape) == 1 else vector[place].reshape(shape)

    def _piece(self, name: str, part: Any) -> Array:
        shape = self._shapes[name]
        if part is None:
            return jnp.zeros(math.prod(shape))
        if jnp.shape(part) != shape:
            raise ValueError(f"the part {name!r} of {self!r} has the shape {shape}, but {jnp.shape(part)} was given.")
        return jnp.reshape(part, (-1,)) if len(shape) != 1 else jnp.asarray(part)


@lru_cache(maxsize=256)
def _kind(names: tuple[str, ...]) -> type:
    """The named tuple of parts with these names."""
    return namedtuple("Parts", names)  # pyrefly: ignore[bad-class-definition]  # names known when it runs
