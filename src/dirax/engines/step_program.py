"""From a StepEquation to the scalar graph: its functions traced at the flat sizes, interpreted, with the Jacobian."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend.core import jaxprs_in_params

import dirax.program.rules  # noqa: F401  (registers the rules)
from dirax.program.graph import Graph, GraphTooLarge
from dirax.program.interpreter import Interpreter, Nodes, Unavailable, UnsupportedPrimitive


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
        return sum(int(np.prod(s)) for s in self.shapes)

    @property
    def key(self) -> tuple:
        """Equal for parameters that give the same program; other leaves than arrays count by identity."""
        fixed = ((a.dtype.str, a.shape, a.tobytes()) if isinstance(a, np.ndarray) else id(a) for a in self.fixed)
        return self.treedef, self.shapes, self.dtypes, tuple(fixed)

    def rebuild(self, leaves) -> Any:
        """The pytree of its float64 inputs."""
        own = lambda x, dtype: x if np.issubdtype(dtype, np.floating) else jnp.asarray(x).astype(dtype)
        leaves, fixed = iter([own(*given) for given in zip(leaves, self.dtypes, strict=True)]), iter(self.fixed)
        return jax.tree.unflatten(self.treedef, [next(leaves) if d else next(fixed) for d in self.dynamic])

    def flatten(self, params: Any, batch: int | None) -> np.ndarray:
        """The floating leaves as (size,), or (B, size) with their batch axis."""
        leaves = [leaf for leaf, d in zip(jax.tree.leaves(params), self.dynamic, strict=True) if d]
        lead = () if batch is None else (batch,)
        columns = [np.asarray(leaf, dtype=np.float64).reshape(*lead, -1) for leaf in leaves]
        return np.concatenate(columns, axis=-1) if columns else np.zeros((*lead, 0))


def parameters(params: Any, batched: bool) -> Parameters:
    """Which leaves of `params` are inputs of the kernel."""
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


@dataclass
class TracedEquation:
    """One StepEquation as nodes: inputs and outputs of its functions."""

    state: list[int]
    unknowns: list[int]
    previous: list[int]
    guess: list[int]
    residual: list[int]
    advance: list[int]
    rows: dict[str, Nodes]
    scale: tuple[float, ...]
    nesting: int
    """How deep derivatives of derivatives go in its functions."""


@dataclass
class Inputs:
    """The scalars that every equation of a step shares."""

    t: int
    h: int
    params: list[int]


def inputs(g: Graph, size: int) -> Inputs:
    return Inputs(g.input("t"), g.input("h"), [g.input(f"param{i}") for i in range(size)])


def trace(g: Graph, shared: Inputs, equation: Any, p: Parameters) -> TracedEquation:
    """The nodes of one equation. Raises `UnsupportedPrimitive`."""
    s, k = equation.state_size, equation.unknowns
    scalar, vector = jax.ShapeDtypeStruct((), jnp.float64), lambda n: jax.ShapeDtypeStruct((n,), jnp.float64)
    leaf_shapes = [jax.ShapeDtypeStruct(shape, jnp.float64) for shape in p.shapes]

    def everything(u, state, previous, t, h, leaves):
        params = p.rebuild(leaves)
        row = equation.unpack(state, u, t, h, params)
        return (
            equation.guess(state, previous, h, params),
            equation.residual(u, state, t, h, params),
            equation.advance(u, state, t, h, params),
            [jnp.asarray(row[name]) for name in sorted(row)],
        )

    closed = jax.make_jaxpr(everything)(vector(k), vector(s), vector(k), scalar, scalar, leaf_shapes)
    names = sorted(equation.fields)
    state = [g.input(f"state{i}") for i in range(s)]
    unknowns = [g.input(f"u{i}") for i in range(k)]
    previous = [g.input(f"previous{i}") for i in range(k)]
    ids = lambda nodes, shape=None: np.array(nodes, dtype=np.int64).reshape((len(nodes),) if shape is None else shape)
    leaves, at = [], 0
    for shape in p.shapes:
        count = int(np.prod(shape))
        leaves.append(ids(shared.params[at : at + count], shape))
        at += count
    try:
        outputs = Interpreter(g).run(
            closed, ids(unknowns), ids(state), ids(previous), ids(shared.t, ()), ids(shared.h, ()), *leaves
        )
    except GraphTooLarge as error:
        raise UnsupportedPrimitive("the step as a whole", f"has {error}", "see docs/native-engine.md") from None
    for output in outputs:
        if isinstance(output, Unavailable):
            raise output.error
    guess, residual, advance, *rows = outputs
    if len(rows) != len(names):
        raise UnsupportedPrimitive("unpack", f"returns {len(rows)} arrays for {len(names)} fields", "the scheme")
    return TracedEquation(
        state, unknowns, previous, guess.tolist(), residual.tolist(), advance.tolist(),
        dict(zip(names, rows, strict=True)), tuple(equation.scale), nesting(closed.jaxpr),
    )  # fmt: skip


DERIVATIVES = ("dirax_derivative", "dirax_directional")


def nesting(jaxpr: Any) -> int:
    """How deep derivatives that tracing left to the graph lie in one another."""
    known: dict[int, int] = {}

    def depth(jaxpr: Any) -> int:
        if id(jaxpr) not in known:
            inner = [(e.primitive.name in DERIVATIVES, j) for e in jaxpr.eqns for j in jaxprs_in_params(e.params)]
            known[id(jaxpr)] = max((derives + depth(getattr(j, "jaxpr", j)) for derives, j in inner), default=0)
        return known[id(jaxpr)]

    return depth(jaxpr)
