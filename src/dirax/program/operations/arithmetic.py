"""Sums, products, reciprocals, roots; the larger and the smaller; whole numbers near by."""

import operator

import jax.numpy as jnp
import numpy as np
from jax import lax

from dirax.program.operations.operation import Builder, Operation, elementary


def _larger(g: Builder, node: int, x: int, y: int) -> list[int | None]:
    first = g.make("le", y, x)
    return [g.select(first, g.one, g.zero), g.select(first, g.zero, g.one)]


def _smaller(g: Builder, node: int, x: int, y: int) -> list[int | None]:
    return _larger(g, node, y, x)


def _stepwise(name: str, numpy, jax, c: str | None) -> Operation:
    return Operation(name=name, numpy=numpy, jax=jax, c=c, stepwise=True)


OPERATIONS = (
    Operation(
        name="add",
        numpy=np.add,
        jax=lax.add,
        derivative=lambda g, f, x, y: [g.one, g.one],
        exact=operator.add,
        commutative=True,
    ),
    Operation(
        name="sub",
        numpy=np.subtract,
        jax=lax.sub,
        derivative=lambda g, f, x, y: [g.one, g.constant(-1.0)],
        exact=operator.sub,
    ),
    Operation(
        name="mul",
        numpy=np.multiply,
        jax=lax.mul,
        derivative=lambda g, f, x, y: [y, x],
        exact=operator.mul,
        commutative=True,
    ),
    elementary("neg", np.negative, lax.neg, lambda g, x, f: g.constant(-1.0), exact=operator.neg, c=None),
    elementary("recip", lambda a: np.divide(1.0, a), lax.reciprocal, lambda g, x, f: g.neg(g.mul(f, f)), c=None),
    elementary(
        "abs",
        np.abs,
        lax.abs,
        lambda g, x, f: g.select(g.make("lt", x, g.zero), g.constant(-1.0), g.one),
        exact=abs,
        c="fabs",
    ),
    elementary("sqrt", np.sqrt, lax.sqrt, lambda g, x, f: g.mul(g.constant(0.5), g.recip(f)), edge=True),
    Operation(name="max", numpy=np.maximum, jax=lax.max, derivative=_larger, c="fmax", commutative=True),
    Operation(name="min", numpy=np.minimum, jax=lax.min, derivative=_smaller, c="fmin", commutative=True),
    Operation(
        name="rem",
        numpy=np.fmod,
        jax=lax.rem,
        derivative=lambda g, f, x, y: [g.one, g.neg(g.make("trunc", g.div(x, y)))],
        c="fmod",
    ),
    _stepwise("floor", np.floor, lax.floor, "floor"),
    _stepwise("ceil", np.ceil, lax.ceil, "ceil"),
    _stepwise("round", np.rint, jnp.rint, "rint"),
    _stepwise("trunc", np.trunc, jnp.trunc, "trunc"),
    _stepwise("sign", np.sign, lax.sign, None),
)
