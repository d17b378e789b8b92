"""Complex numbers as pairs of real ones: an equation of a jaxpr with complex operands or results, written in real operations."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun

from dirax.program import pairs
from dirax.program.fourier import fourier
from dirax.program.memo import Memo, Same
from dirax.program.pairs import Pair, as_pair

KEPT = 1024
"""Equations whose jaxprs are kept in memory."""

_written: Memo[ClosedJaxpr | None] = Memo(KEPT)


def is_complex(atom: Any) -> bool:
    """Whether a variable or literal of a jaxpr is complex, of 64 bits a part."""
    return getattr(atom.aval, "dtype", None) == np.complex128


def has_complex(equation: Any) -> bool:
    """Whether an equation of a jaxpr has complex operands or results."""
    return any(map(is_complex, (*equation.invars, *equation.outvars)))


def in_pairs(equation: Any) -> ClosedJaxpr | None:
    """The jaxpr from the operands of an equation to its results, both flattened, without complex numbers; None where a primitive
    has no rule."""
    return _written.get(Same(equation), lambda: _traced(equation))


def by_pairs(equation: Any, operands: Sequence[Any], run: Callable[[ClosedJaxpr, list[Any]], Sequence[Any]]) -> list[Any] | None:
    """The results of an equation with complex operands or results, each a `Pair`, by a `run` of its jaxpr of real ones; what is
    no pair stands for both of its parts. None where a primitive has no rule."""
    if (closed := in_pairs(equation)) is None:
        return None
    given = []
    for operand, variable in zip(operands, equation.invars, strict=True):
        given.extend(operand if isinstance(operand, Pair) else [operand] * (1 + is_complex(variable)))
    found = iter(run(closed, given))
    return [Pair(next(found), next(found)) if is_complex(v) else next(found) for v in equation.outvars]


class NotInPairs(Exception):
    """Raised for a primitive without a rule."""


def _traced(equation: Any) -> ClosedJaxpr | None:
    shape = lambda v: jax.ShapeDtypeStruct(v.aval.shape, np.float64 if is_complex(v) else v.aval.dtype)
    operands = [Pair(shape(v), shape(v)) if is_complex(v) else shape(v) for v in equation.invars]
    try:
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            return jax.make_jaxpr(lambda *given: _results(equation, given))(*operands)
    except NotInPairs:
        return None


def _results(equation: Any, operands: Sequence[Any]) -> Sequence[Any]:
    if equation.primitive.name not in RULES:
        raise NotInPairs
    found = RULES[equation.primitive.name](equation, *operands)
    return found if equation.primitive.multiple_results else [found]


def _run(closed: ClosedJaxpr, *operands: Any) -> list[Any]:
    """The results of a jaxpr whose complex operands are pairs."""
    jaxpr = closed.jaxpr
    values = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*map(_paired, closed.consts), *operands), strict=True))
    read = lambda atom: _paired(atom.val) if isinstance(atom, Literal) else values[atom]
    for equation in jaxpr.eqns:
        given = [read(atom) for atom in equation.invars]
        if not has_complex(equation):
            variables = [v for v in equation.invars if not isinstance(v, Literal)]
            alone = jaxpr.replace(constvars=(), invars=variables, outvars=equation.outvars, eqns=[equation])
            known = [x for x, v in zip(given, equation.invars, strict=True) if not isinstance(v, Literal)]
            results = jaxpr_as_fun(ClosedJaxpr(alone, ()))(*known)
        else:
            results = _results(equation, given)
        values.update(zip(equation.outvars, results, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _paired(value: Any) -> Any:
    return Pair(jnp.real(value), jnp.imag(value)) if jnp.result_type(value) == np.complex128 else value


# ---------------------------------------------------------------------------------------------------------------------- rules

RULES: dict[str, Callable] = {}
"""Primitive name → rule(equation, *operands), of pairs and arrays."""


def _rule(*names: str) -> Callable[[Callable], Callable]:
    return lambda function: [RULES.setdefault(name, function) for name in names][-1]


def _of_pairs(function: Callable) -> Callable:
    return lambda equation, *operands: function(*map(as_pair, operands))


RULES.update({
    name: _of_pairs(function)
    for name, function in {
        "add": pairs.add, "add_any": pairs.add, "sub": pairs.subtract, "neg": pairs.negative, "mul": pairs.multiply,
        "div": pairs.divide, "abs": pairs.size, "sign": pairs.sign, "exp": pairs.exp, "expm1": pairs.expm1, "log": pairs.log,
        "log1p": pairs.log1p, "sqrt": pairs.sqrt, "sin": pairs.sin, "cos": pairs.cos, "tan": pairs.tan, "sinh": pairs.sinh,
        "rsqrt": lambda x: pairs.power(pairs.sqrt(x), -1), "logistic": pairs.logistic,
        "cosh": pairs.cosh, "tanh": pairs.tanh, "real": lambda x: x.re, "imag": lambda x: x.im,
        "conj": lambda x: Pair(x.re, -x.im), "square": lambda x: pairs.multiply(x, x), "pow": pairs.power_of,
        "eq": lambda x, y: (x.re == y.re) & (x.im == y.im), "ne": lambda x, y: (x.re != y.re) | (x.im != y.im),
        "is_finite": lambda x: jnp.isfinite(x.re) & jnp.isfinite(x.im),
    }.items()
})  # fmt: skip


@_rule("empty", "empty2")
def _empty(equation: Any):
    return Pair(*jnp.zeros((2, *equation.outvars[0].aval.shape)))


@_rule("integer_pow")
def _integer_power(equation: Any, x: Pair):
    return pairs.power(x, equation.params["y"])


@_rule("complex")
def _complex(equation: Any, re: Any, im: Any):
    return Pair(*jnp.broadcast_arrays(re, im))


@_rule("convert_element_type")
def _converted(equation: Any, x: Any):
    kind = np.dtype(equation.params["new_dtype"])
    if kind.kind == "b":
        return (x.re != 0.0) | (x.im != 0.0)
    if kind != np.complex128:
        return x.re.astype(kind)
    return x if isinstance(x, Pair) else Pair(x.astype(np.float64), jnp.zeros(x.shape))


@_rule(
    "broadcast_in_dim", "reshape", "squeeze", "expand_dims", "transpose", "rev", "slice", "dynamic_slice", "dynamic_update_slice",
    "concatenate", "stack", "unstack", "tile", "split", "pad", "gather", "copy", "copy_p", "stop_gradient", "reduce_sum",
    "cumsum", "select_n",
)  # fmt: skip
def _each_part(equation: Any, *operands: Any):
    """What moves and adds entries does so with either part."""
    of = lambda k: equation.primitive.bind(*(o[k] if isinstance(o, Pair) else o for o in operands), **equation.params)
    re, im = of(0), of(1)
    return [Pair(*parts) for parts in zip(re, im, strict=True)] if equation.primitive.multiple_results else Pair(re, im)


@_rule("scatter", "scatter-add")
def _scattered(equation: Any, x: Pair, places: Any, updates: Pair):
    p = equation.params
    names = "indices_are_sorted", "unique_indices", "mode"
    function = lax.scatter if equation.primitive.name == "scatter" else lax.scatter_add
    of = lambda k: function(x[k], places, updates[k], p["dimension_numbers"], **{name: p[name] for name in names})
    return Pair(of(0), of(1))


@_rule("dot_general")
def _product(equation: Any, x: Any, y: Any):
    numbers = equation.params["dimension_numbers"]
    of = lambda a, b: lax.dot_general(a, b, numbers, precision=equation.params["precision"])
    x, y = as_pair(x), as_pair(y)
    return Pair(of(x.re, y.re) - of(x.im, y.im), of(x.re, y.im) + of(x.im, y.re))


@_rule("fft")
def _fourier(equation: Any, x: Any):
    kind, lengths = equation.params["fft_type"], equation.params["fft_lengths"]
    found = fourier(kind, lengths, *as_pair(x))
    return Pair(*found) if isinstance(found, tuple) else found


@_rule("scan")
def _scan(equation: Any, *operands: Any):
    p = equation.params
    fixed, carried = p["num_consts"], p["num_consts"] + p["num_carry"]

    def body(carry, along):
        found = _run(p["jaxpr"], *operands[:fixed], *carry, *along)
        return found[: p["num_carry"]], found[p["num_carry"] :]

    more = {name: p[name] for name in ("length", "reverse", "unroll")}
    carry, rows = lax.scan(body, list(operands[fixed:carried]), list(operands[carried:]), **more)
    return [*carry, *rows]


@_rule("while")
def _while(equation: Any, *operands: Any):
    p = equation.params
    first, second = p["cond_nconsts"], p["cond_nconsts"] + p["body_nconsts"]
    going = lambda carry: _run(p["cond_jaxpr"], *operands[:first], *carry)[0]
    body = lambda carry: _run(p["body_jaxpr"], *operands[first:second], *carry)
    return lax.while_loop(going, body, list(operands[second:]))


@_rule("cond")
def _branches(equation: Any, which: Any, *operands: Any):
    choices = [functools.partial(_run, branch) for branch in equation.params["branches"]]
    return lax.switch(which.astype(np.int32), choices, *operands)


@_rule("jit", "pjit", "closed_call", "core_call", "remat", "checkpoint", "remat2")
def _call(equation: Any, *operands: Any):
    jaxpr = equation.params["jaxpr"] if "jaxpr" in equation.params else equation.params["call_jaxpr"]
    return _run(jaxpr if hasattr(jaxpr, "consts") else ClosedJaxpr(jaxpr, ()), *operands)
