"""Runs of the native engine under JAX transformations: three primitives whose derivatives are each other.

A run's states and unknowns at the saved rows are functions of the first state, the parameters, t0 and h. `run` computes
them, `push` their tangents, `pull` the cotangents of what they depend on, each on the host (sweep.py). Derivatives of the
second order and higher are those of the xla engine's run.
"""

import functools
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from dirax.engines.contract import Outcome, Problem, finished, saved_steps
from dirax.engines.native.engine import run
from dirax.engines.native.gradients.runs import pull, push
from dirax.engines.native.program import program
from dirax.engines.step_program import Parameters, parameters
from dirax.engines.xla import Xla
from dirax.engines.xla.loop import unpacked_rows
from dirax.schemes.step import Field, StepEquation, StepSequence

KEPT = 128
"""Equations kept in memory."""

INPUTS = 5
"""State (B, s), guess (B, stages, k), parameters (B, m), t0 and h (B,): what the three primitives begin with."""


class Recorded:
    """A run as a function of arrays, the five inputs. Its results are (B, rows, s) and (B, rows, k): states and unknowns of
    the first stage; then good steps, status, Newton updates and largest residual (B, 4), and the last unknowns (B, k)."""

    def __init__(self, problem: Problem, leaves: Parameters):
        p = problem
        self.equation, self.unknowns = recording(p.equation, leaves)
        self.state_size, self.rows, self.steps = p.equation.stages[0][0].state_size, p.rows, p.steps
        self.numbers: dict[str, Any] = {
            "steps": p.steps,
            "save_every": p.save_every,
            "first_step": p.first_step,
            "max_iterations": p.max_iterations,
            "compensated": p.compensated,
        }

    def problem(self, state, guess, c, t0, h) -> Problem:
        """The run of equal t0 and h."""
        guesses = tuple(guess[:, i, : stage.unknowns] for i, (stage, _) in enumerate(self.equation.stages))
        h, t0, batch = h[0], t0[0], state.shape[0]
        return Problem(self.equation, state, guesses, h, t0, params=c, batch=batch, batch_params=True, **self.numbers)


_recordings: OrderedDict[tuple, tuple[Any, tuple[Any, int]]] = OrderedDict()


def recording(equation: Any, leaves: Parameters) -> tuple[Any, int]:
    """The equation with parameters as one array (m,), whose rows are the state and the unknowns, and their number, 1 at
    least; the same object for the same arguments."""
    key = (id(equation), leaves.key)
    if key not in _recordings:
        _recordings[key] = (equation, leaves), _recording(equation, leaves)
        if len(_recordings) > KEPT:
            _recordings.popitem(last=False)
    _recordings.move_to_end(key)
    return _recordings[key][1]


def _recording(equation: Any, leaves: Parameters) -> tuple[Any, int]:
    size = max(1, *(stage.unknowns for stage, _ in equation.stages))

    def split(c):
        parts, at = [], 0
        for shape in leaves.shapes:
            count = int(np.prod(shape))
            parts.append(c[at : at + count].reshape(shape))
            at += count
        return leaves.rebuild(parts)

    def one(stage: StepEquation) -> StepEquation:
        def unpack(state, u, t, h, c):
            return {"state": state, "unknowns": jnp.concatenate([u, jnp.zeros(size - stage.unknowns)])}

        return StepEquation(
            start=stage.start,
            guess=lambda state, previous, h, c: stage.guess(state, previous, h, split(c)),
            residual=lambda u, state, t, h, c: stage.residual(u, state, t, h, split(c)),
            advance=lambda u, state, t, h, c: stage.advance(u, state, t, h, split(c)),
            unpack=unpack,
            state_size=stage.state_size,
            unknowns=stage.unknowns,
            fields={"state": Field((stage.state_size,)), "unknowns": Field((size,))},
            labels=stage.labels,
        )

    made = {id(stage): one(stage) for stage, _ in equation.stages}
    return StepSequence(tuple((made[id(stage)], fraction) for stage, fraction in equation.stages)), size


# ----------------------------------------------------------------------------------------------------- the primitives


def _run(task: Recorded, *arrays: np.ndarray) -> list[np.ndarray]:
    p = task.problem(*arrays)
    out = finished(p, run(p), held=True)
    table = np.stack([out.completed, out.status, out.iterations, out.max_residual], axis=1)
    last = np.zeros((len(table), task.unknowns))
    last[:, : out.last_unknowns.shape[1]] = out.last_unknowns
    return [out.fields["state"], out.fields["unknowns"], table, last]


def _reference(task: Recorded, *inputs):
    """States and unknowns by the xla engine, for derivatives of derivatives."""
    fields = Xla().run_traced(task.problem(*inputs)).fields
    return [fields["state"], fields["unknowns"]]


def _reference_push(task: Recorded, *arrays):
    inputs, (state, c, t0, h) = arrays[:INPUTS], arrays[INPUTS + 1 :]
    return jax.jvp(functools.partial(_reference, task), inputs, (state, jnp.zeros_like(inputs[1]), c, t0, h))[1]


def _reference_pull(task: Recorded, *arrays):
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
    return [(state.shape[0], task.rows, task.state_size), (state.shape[0], task.rows, task.unknowns)]


run_p = _primitive(
    "run", _run, lambda task, state, *a: [*_rows(task, state), (state.shape[0], 4), (state.shape[0], task.unknowns)]
)
push_p = _primitive("push", push, _rows)
pull_p = _primitive("pull", pull, lambda task, state, guess, c, t0, h, *_: [state.shape, c.shape, t0.shape, h.shape])


def _run_jvp(primals, tangents, *, task):
    found = run_p.bind(*primals, task=task)
    state, _, c, t0, h = map(ad.instantiate_zeros, tangents)
    rows = push_p.bind(*primals, found[2][:, 0], state, c, t0, h, task=task)
    return found, [*rows, *(ad.zeros_like_aval(jax.typeof(x)) for x in found[2:])]


def _linear_jvp(made: Primitive, reference: Callable) -> Callable:
    def rule(primals, tangents, *, task):
        if all(type(t) is ad.Zero for t in tangents[: INPUTS + 1]):
            along = map(ad.instantiate_zeros, tangents[INPUTS + 1 :])
            return made.bind(*primals, task=task), made.bind(*primals[: INPUTS + 1], *along, task=task)
        return jax.jvp(functools.partial(reference, task), tuple(primals), tuple(map(ad.instantiate_zeros, tangents)))

    return rule


def _transposed(other: Primitive) -> Callable:
    def rule(cotangents, *arguments, task):
        known, linear = arguments[: INPUTS + 1], arguments[INPUTS + 1 :]
        found = other.bind(*known, *map(ad.instantiate_zeros, cotangents), task=task)
        wanted = [a if ad.is_undefined_primal(x) else None for a, x in zip(found, linear, strict=True)]
        return [*(None for _ in known), *wanted]

    return rule


ad.primitive_jvps[run_p] = _run_jvp
ad.primitive_jvps[push_p] = _linear_jvp(push_p, _reference_push)
ad.primitive_jvps[pull_p] = _linear_jvp(pull_p, _reference_pull)
ad.primitive_transposes[push_p] = _transposed(pull_p)
ad.primitive_transposes[pull_p] = _transposed(push_p)


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
    made, _ = program(task.equation, np.zeros((1, c.shape[1])), True, p.compensated)
    made.check()
    guesses = [jnp.asarray(g).reshape(batch, -1) for g in p.guess]
    guess = jnp.stack([jnp.pad(g, ((0, 0), (0, task.unknowns - g.shape[1]))) for g in guesses], axis=1)
    clock = [jnp.broadcast_to(jnp.asarray(x, float), (batch,)) for x in (p.t0, p.h)]
    state = jnp.asarray(p.state).reshape(batch, -1)
    states, unknowns, table, last = run_p.bind(state, guess, c, *clock, task=task)

    stage = p.equation.stages[0][0]
    completed = jnp.minimum(saved_steps(p)[None, :, None], table[:, None, :1])
    packed = jnp.concatenate([states, unknowns[..., : stage.unknowns], completed], axis=2)
    rows = unpacked_rows(p, packed)
    outcome = Outcome(
        fields={name: a if p.is_node(name) else a[:, :-1] for name, a in rows.items()},
        closing={name: a[:, -1] for name, a in rows.items()},
        completed=table[:, 0].astype(int),
        status=table[:, 1].astype(int),
        iterations=table[:, 2].astype(int),
        max_residual=table[:, 3],
        last_state=states[:, -1],
        last_unknowns=last[:, : stage.unknowns],
        engine="native",
    )
    return finished(p, outcome)
