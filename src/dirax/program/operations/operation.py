"""What an operation on scalars is: one object with all that the program knows of it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable


@runtime_checkable
class Builder(Protocol):
    """What a rule uses of the graph on which it builds nodes; a node is a number."""

    zero: int
    one: int

    def constant(self, value: Any) -> int: ...
    def make(self, op: str, *args: int) -> int: ...
    def add(self, a: int, b: int) -> int: ...
    def sub(self, a: int, b: int) -> int: ...
    def mul(self, a: int, b: int) -> int: ...
    def div(self, a: int, b: int) -> int: ...
    def neg(self, a: int) -> int: ...
    def recip(self, a: int) -> int: ...
    def select(self, condition: int, yes: int, no: int) -> int: ...
    def is_constant(self, node: int) -> bool: ...


@dataclass(frozen=True, kw_only=True)
class Operation:
    """One operation on float64 and bool scalars: its meaning in NumPy and in JAX, its derivative, its name in C.

    Its machine code has the same name in `dirax.engines.native.functions`, unless a `formula` of other operations does as well.
    """

    name: str
    numpy: Callable[..., Any]
    """Its values on arrays."""
    jax: Callable[..., Any]
    """The same on scalars of JAX."""
    derivative: Callable[..., list[int | None]] | None = None
    """(graph, node, *operands) ↦ the nodes of the derivatives by each operand, None for zero; none if all are zero."""
    exact: Callable[..., Any] | None = None
    """What Python's own floats do as NumPy's do, without a warning or an error."""
    c: str | None = None
    """Its name in C's math library."""
    formula: Callable[..., int] | None = None
    """(graph, *operands) ↦ the node of the same value by other operations, of which its machine code is made."""
    commutative: bool = False
    boolean: bool = False
    """Whether its values are truth values."""
    stepwise: bool = False
    """Whether its derivative is zero wherever there is one."""
    edge: bool = False
    """Whether its value is finite somewhere where its derivative is not."""


def elementary(name: str, numpy: Callable, jax: Callable, slope: Callable[[Builder, int, int], int], **more: Any) -> Operation:
    """A function of one number, which C names alike: `slope(graph, x, f)` is the node of f′ at f = name(x)."""
    known: dict[str, Any] = {"c": name} | more
    return Operation(name=name, numpy=numpy, jax=jax, derivative=lambda g, f, x: [slope(g, x, f)], **known)


def square(g: Builder, x: int) -> int:
    return g.mul(x, x)


def root(g: Builder, x: int) -> int:
    return g.make("sqrt", x)
