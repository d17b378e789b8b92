"""Runs of the native engine under JAX transformations: three primitives whose derivatives are each other.

A run's states and unknowns at the saved rows are functions of the first state, the parameters, t0 and h. `run` computes
them, `jvp` their tangents, `vjp` the cotangents of what they depend on, each on the host
(tangents_on_host.py). Derivatives of the second order and higher are those of the run with a tangent (prolonged.py); of runs
for which that is too large those of the xla engine's run.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from dirax.engines.contract import Outcome, Problem, finished, saved_steps
from dirax.engines.native.gradients.prolonged import Prolonged
from dirax.engines.native.gradients.recording import INPUTS, Recorded
from dirax.engines.native.gradients.tangents_on_host import jvp, vjp
from dirax.engines.native.kernels import kernels
from dirax.engines.native.run import run
from dirax.engines.parameters import parameters
from dirax.engines.xla import Xla
from dirax.engines.xla.loop import unpacked_rows
from dirax.program.primitives import plain_primitive

# ----------------------------------------------------------------------------------------------------- the primitives


def _run(task: Recorded, *arrays: np.ndarray) -> list[np.ndarray]:
    p = task.problem(*arrays)
    out = finished(p, run(p), held=True)
    table = np.stack([out.completed, out.status, out.iterations, out.max_residual], axis=1)
    last = np.zeros((len(table), task.unknowns))
    last[:, : out.last_unknowns.shape[1]] = out.last_unknowns
    return [*_of_rows(out.fields), table, last]


def _of_rows(fields) -> list:
    """States and unknowns of rows, those of all parts in one."""
    return [fields[name].reshape(*fields[name].shape[:2], -1) for name in ("state", "unknowns")]


def _reference(task: Recorded, *inputs):
    """States and unknowns by the xla engine, for derivatives of derivatives."""
    return _of_rows(Xla().run_traced(task.problem(*inputs)).fields)


def _reference_jvp(task: Recorded, *arrays):
    inputs, (state, c, t0, h) = arrays[:INPUTS], arrays[INPUTS + 1 :]
    return jax.jvp(functools.partial(_reference, task), inputs, (state, jnp.zeros_like(inputs[1]), c, t0, h))[1]


def _reference_vjp(task: Recorded, *arrays):
    state, _, *rest = jax.vjp(functools.partial(_reference, task), *arrays[:INPUTS])[1](list(arrays[INPUTS + 1 :]))
    return [state, *rest]


def _primitive(name: str, host: Callable, shapes: Callable) -> Primitive:
    """A primitive computed by `host(task, *arrays)`, with results of `shapes(task, *arrays)`. Everything has the axis of the
    batch in front, and an axis of vmap becomes part of it; trajectories with other t0 or h are run apart."""
    made = Primitive(f"dirax_{name}")
    made.multiple_results = True

    def compute(task: Recorded, *arrays) -> tuple[np.ndarray, ...]:
        given = [np.array(a, dtype=np.float64) for a in arrays]
        clocks, which = np.unique(np.stack(given[INPUTS - 2 : INPUTS], axis=1), axis=0, return_inverse=True)
        if len(clocks) == 1:
            return tuple(np.ascontiguousarray(a, dtype=np.float64) for a in host(task, *given))
        results = tuple(np.empty(shape) for shape in shapes(task, *given))
        for group in range(len(clocks)):
            lanes = which.ravel() == group
            for out, part in zip(results, host(task, *(a[lanes] for a in given)), strict=True):
                out[lanes] = part
        return results

    def lowering(context, *operands, task):
        callback = functools.partial(compute, task)
        return mlir.emit_python_callback(
            context, callback, None, list(operands), context.avals_in, context.avals_out, has_side_effect=False
        )[0]

    def folded(operands, axes, *, task):
        size = next(a.shape[axis] for a, axis in zip(operands, axes, strict=True) if axis is not None)
        front = lambda a, x: jnp.broadcast_to(a, (size, *a.shape)) if x is None else jnp.moveaxis(a, x, 0)
        whole = [front(a, x) for a, x in zip(operands, axes, strict=True)]
        results = made.bind(*(a.reshape(-1, *a.shape[2:]) for a in whole), task=task)
        return [a.reshape(size, -1, *a.shape[1:]) for a in results], [0] * len(results)

    made.def_impl(lambda *arrays, task: [jnp.asarray(a) for a in compute(task, *map(np.asarray, arrays))])
    made.def_abstract_eval(lambda *avals, task: [ShapedArray(shape, np.dtype(np.float64)) for shape in shapes(task, *avals)])
    mlir.register_lowering(made, lowering, platform="cpu")
    batching.primitive_batchers[made] = folded
    return made


def _rows(task: Recorded, state, *_) -> list[tuple[int, ...]]:
    return [(state.shape[0], task.rows, task.parts * size) for size in (task.state_size, task.unknowns)]


run_p = _primitive(
    "run", _run, lambda task, state, *a: [*_rows(task, state), (state.shape[0], 4), (state.shape[0], task.unknowns)]
)
jvp_p = _primitive("jvp", jvp, _rows)
vjp_p = _primitive("vjp", vjp, lambda task, state, guess, c, t0, h, *_: [state.shape, c.shape, t0.shape, h.shape])


def _run_jvp(primals, tangents, *, task):
    found = run_p.bind(*primals, task=task)
    state, _, c, t0, h = map(ad.instantiate_zeros, tangents)
    rows = jvp_p.bind(*primals, found[2][:, 0], state, c, t0, h, task=task)
    return found, [*rows, *(ad.zeros_like_aval(jax.typeof(x)) for x in found[2:])]


KNOWN = INPUTS + 1
"""Operands of `jvp` and `vjp` before those in which they are linear: the inputs and the good steps."""


def _linear_jvp(made: Primitive, known: int, otherwise: Callable) -> Callable:
    """The rule of a primitive that is linear in what follows the `known` operands; `otherwise` is that where these move too."""

    def rule(primals, tangents, *, task):
        if any(type(t) is not ad.Zero for t in tangents[:known]):
            return otherwise(primals, tangents, task=task)
        along = map(ad.instantiate_zeros, tangents[known:])
        return made.bind(*primals, task=task), made.bind(*primals[:known], *along, task=task)

    return rule


def _transposed(other: Primitive, known: int) -> Callable:
    def rule(cotangents, *arguments, task):
        found = other.bind(*arguments[:known], *map(ad.instantiate_zeros, cotangents), task=task)
        wanted = [a if ad.is_undefined_primal(x) else None for a, x in zip(found, arguments[known:], strict=True)]
        return [*(None for _ in arguments[:known]), *wanted]

    return rule


def _by_prolonging(made: Primitive, second: Callable, reference: Callable) -> Callable:
    """The rule where the inputs move: `second` of the run with a tangent, of one that is too large the `reference`."""

    def rule(primals, tangents, *, task):
        tangents = tuple(map(ad.instantiate_zeros, tangents))
        with_tangent = Prolonged.of(task, primals[2].shape[1])
        if with_tangent is None:
            return jax.jvp(functools.partial(reference, task), tuple(primals), tangents)
        return made.bind(*primals, task=task), second(with_tangent, primals, tangents)

    return rule


def _second_jvp(whole: Prolonged, primals, tangents) -> list:
    inputs, completed, tangent = primals[:INPUTS], primals[INPUTS], primals[KNOWN:]
    state, _, *others = tangents[:INPUTS]
    given = whole.inputs(inputs, tangent)
    moved = whole.tangents(inputs, tangent, (state, *others), tangents[KNOWN:])
    return whole.tangent_of_rows(*jvp_p.bind(*given, completed, *moved, task=whole))


def _second_vjp(whole: Prolonged, primals, tangents) -> list:
    (state, _, *others), of_cotangents = tangents[:INPUTS], tangents[KNOWN:]
    turned = curvature_p.bind(*primals, state, *others, task=whole)
    moved = vjp_p.bind(*primals[:KNOWN], *of_cotangents, task=whole.task)
    return [a + b for a, b in zip(turned, moved, strict=True)]


CURVED = KNOWN + 2
"""Operands of `curvature` before the tangent: those of `jvp` and `vjp`, and the cotangents of states and unknowns."""


def _curvature(*arrays, task: Prolonged) -> list:
    """∂²⟨cotangents, run⟩ along a tangent of the inputs, from (inputs, completed, cotangents, tangent): mixed derivatives are
    symmetric, and so these are the cotangents of the inputs for the tangents of the rows."""
    inputs, completed, cotangents, tangent = arrays[:INPUTS], arrays[INPUTS], arrays[KNOWN:CURVED], arrays[CURVED:]
    given, h, of_h = task.inputs(inputs, tangent), inputs[-1], tangent[-1]
    of_state, of_c, of_t, of_step = vjp_p.bind(*given, completed, *task.cotangents(*cotangents), task=task)
    s, m = inputs[0].shape[1], inputs[2].shape[1]
    return [of_state[:, :s], of_c[:, :m], of_t, of_step - of_c[:, -1] * of_h / h**2]


curvature_p = plain_primitive("dirax_curvature", _curvature, lambda *arrays, **_: list(arrays[CURVED:]))
"""It is linear in the tangent, and symmetric: its own transpose."""

ad.primitive_jvps[run_p] = _run_jvp
ad.primitive_jvps[jvp_p] = _linear_jvp(jvp_p, KNOWN, _by_prolonging(jvp_p, _second_jvp, _reference_jvp))
ad.primitive_jvps[vjp_p] = _linear_jvp(vjp_p, KNOWN, _by_prolonging(vjp_p, _second_vjp, _reference_vjp))
ad.primitive_jvps[curvature_p] = _linear_jvp(curvature_p, CURVED, ad.primitive_jvps[curvature_p])
ad.primitive_transposes[jvp_p] = _transposed(vjp_p, KNOWN)
ad.primitive_transposes[vjp_p] = _transposed(jvp_p, KNOWN)
ad.primitive_transposes[curvature_p] = _transposed(curvature_p, CURVED)


# ------------------------------------------------------------------------------------------------------------ the run


def run_traced(problem: Problem) -> Outcome:
    """Run `problem` under `jax.grad`, `jit` or `vmap`. Raises `UnsupportedPrimitive` for a step that cannot be compiled."""
    p, batch = problem, problem.batch or 1
    leaves = parameters(p.params, p.batch_params)
    task = Recorded(p, leaves)
    moving = [leaf for leaf, moves in zip(jax.tree.leaves(p.params), leaves.dynamic, strict=True) if moves]
    per_lane = lambda a: a if p.batch_params else jnp.broadcast_to(a, (batch, *jnp.shape(a)))
    columns = [per_lane(jnp.asarray(leaf, float)).reshape(batch, -1) for leaf in moving]
    c = jnp.concatenate(columns, axis=1) if columns else jnp.zeros((batch, 1))
    made = kernels(task.equation, np.zeros((1, c.shape[1])), True, p.compensated)
    made.check()
    _ = made.step.differentiable
    guesses = [jnp.asarray(g).reshape(batch, -1) for g in p.guess]
    guess = jnp.stack([jnp.pad(g, ((0, 0), (0, task.unknowns - g.shape[1]))) for g in guesses], axis=1)
    clock = [jnp.broadcast_to(jnp.asarray(x, float), (batch,)) for x in (p.t0, p.h)]
    state = jnp.asarray(p.state).reshape(batch, -1)
    states, unknowns, table, last = run_p.bind(state, guess, c, *clock, task=task)

    stage = p.equation.stages[0][0]
    completed = jnp.minimum(saved_steps(p)[None, :, None], table[:, None, :1])
    pieces = []
    for i, (part, _) in enumerate(p.equation.stages[: task.parts]):
        at = i * task.unknowns
        pieces += [states[..., i * task.state_size : (i + 1) * task.state_size], unknowns[..., at : at + part.unknowns]]
    packed = jnp.concatenate([*pieces, completed], axis=2)
    rows = unpacked_rows(p, packed)
    outcome = Outcome(
        fields={name: a if p.is_node(name) else a[:, :-1] for name, a in rows.items()},
        closing={name: a[:, -1] for name, a in rows.items()},
        completed=table[:, 0].astype(int),
        status=table[:, 1].astype(int),
        iterations=table[:, 2].astype(int),
        max_residual=table[:, 3],
        last_state=states[:, -1, : task.state_size],
        last_unknowns=last[:, : stage.unknowns],
        engine="native",
    )
    return finished(p, outcome)
