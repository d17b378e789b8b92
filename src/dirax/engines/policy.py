"""Which engine takes what: the engines by name, and every number that decides between them, with its measurement.

Times are of two cores of an AMD EPYC with AVX-512; docs/native-engine.md has the tables.
"""

from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import jax

from dirax.engines.configure import fast_loops_asked_for
from dirax.engines.contract import Problem
from dirax.engines.engine import AbstractEngine

ENGINES = {
    "auto": "dirax.engines.auto:Auto",
    "xla": "dirax.engines.xla:Xla",
    "native": "dirax.engines.native:Native",
    "sparse": "dirax.engines.sparse.engine:Sparse",
}
"""Name → the class, imported when it is used."""

# ---------------------------------------------------------------------------------------------- what "auto" gives to native

LARGEST_FULL = 32
"""Unknowns of a stage, or entries of the state, up to which "auto" takes the native engine for any step.

A chain of 32 pendulums, each coupled to all: 44 220 operations a step, compiled in 5.0 s (xla: 2.0 s), 9.9 µs a step (xla: 94),
which pays after 35 000 steps. At 40 there are more than 60 000 operations, which is where tracing ends."""

LARGEST_NATIVE = 192
"""The same for steps that are sparse enough: 64 oscillators with forces between neighbours have 4 972 operations, compiled in
.9 s, and 96 in 1.6 s; they take .04 µs an oscillator and step, in the sparse engine .08 and .06. First gradients through a chain
of 40, 64 and 96 take 2.0, 4.0 and 4.0 s instead of 5.3, 5.2 and 4.9, through a walking mechanism of nine coordinates by Method 2
and by Lobatto's nodes, with 33 unknowns and more, 2.2 and 2.3 s instead of 17."""

MOST_OPERATIONS = 30_000
"""Scalar operations of a step of more unknowns. First call, and 1000 steps, natively and by the engine that takes it else: ten
bobs on rods by Method 2, 13 809 operations, 3.9 s and .09 s (xla: 15 and 18 s), by Lobatto's nodes, 26 460, 3.1 and .04 (xla: 6.3
and .7); a mesh of 25 points, 29 335, 2.3 and .02 (sparse: 4.7 and .1); first gradients in half the time. A lattice of 90 sites,
44 775, takes 9.7 s to the first result, and the sparse engine 8.3."""

LARGEST_SCALARS, MOST_NOT_SPARSE = 384, 60_000
"""Both for a step that the sparse engine leaves. First call, and 1000 steps, natively and by XLA: twenty bobs on rods by Method
2, 300 unknowns and 29 297 operations, 6.2 s and .32 s (5.3 and 4.2), fifteen by Lobatto's nodes, 40 973, 3.3 and .06 (4.8 and
30); 14 bodies that attract each other, 50 451, 2.5 and .06 (2.2 and .46); first gradients in half the time."""

# ---------------------------------------------------------------------------------------------- what "auto" gives to sparse

FEWEST_SPARSE = 33
"""Unknowns of a stage, or entries of the state, from which on "auto" asks the sparse engine what native does not take: a chain of
64 oscillators takes 6 µs a step there, and 47 µs in the xla engine."""

LARGEST_DENSE = 20_000
"""Unknowns of a step that is not sparse up to which "auto" forms its matrix, 3 GB: more are refused."""

MOST_ARRAY_OPERATIONS = 400
"""Operations on arrays in a residual from which on a sparse step is written by the levels of its scalar program."""

PLUGINS = ("jax_plugins", "libtpu")
"""The packages without which JAX has no device but CPUs."""

# ------------------------------------------------------------------------------------ what the xla engine writes in scalars

LARGEST_SCALAR = 16
"""Unknowns of a stage, or entries of the state, up to which the xla engine writes a step in scalars, in large batches and in
loops that XLA makes one kernel: the rolling disk as arrays and as scalars 4.2 and 1.4 µs a step in such a loop, the double
spherical pendulum 5.5 and 4.3 in a batch of 512, vortices of 8 unknowns 8.4 and 8.3."""

SCALAR_BATCH = 64
"""Trajectories from which on a batch is large: on a CPU an array program calls LAPACK once for each small matrix of a batch. For
one trajectory, as JAX comes, scalars may be slower: the double spherical pendulum takes 6.9 µs a step in arrays, 11 in
scalars."""

LARGEST_NESTED = 96
"""The same as LARGEST_SCALAR for a step that is nested, whatever its batch and device: the array program of a pendulum with its
tension as a coordinate has 500 000 operations and took XLA 160 s to compile, its graph has 1 263."""

NESTED = 4
"""Derivatives of derivatives from which on a step is nested: each more takes the array program times MORE_FOR_XLA, and the graph
hardly any."""

MORE_FOR_XLA = 2.6
"""Operations on arrays that the derivative of one of them takes."""

SCALARS_FOR_ARRAYS = 5
"""Scalar operations that take LLVM as long to compile as XLA takes for one operation on arrays, a millisecond: "auto" gives
the native engine a step of more than MOST_OPERATIONS where XLA would take longer. The bicycle by Method 2 has 31 900 and 48 100:
4 s and 60 s to the first result, and 14 µs and 5.5 ms a step."""

MOST_TRACED, LEFT_OUT = 200_000, 2
"""Scalar operations up to which a step is traced where XLA would take longer, and how many there are for one that is left when
what nothing needs is left out: a rod of two rigid bodies in space has 111 000 and 96 365, compiled in 5 s, XLA takes 65."""

MOST_FOR_XLA = 6000
"""Scalar operations of a residual with its Jacobian up to which XLA is given them: it takes some milliseconds to compile each."""


@cache
def engine_of(name: str, **options: Any) -> AbstractEngine:
    """The engine of that name. Raises `KeyError` for another, `ImportError` without the libraries that it needs."""
    module, _, kind = ENGINES[name].partition(":")
    return getattr(import_module(module), kind)(**options)


def kept_from_native(problem: Problem, traced: bool, not_sparse: bool) -> str | None:
    """Why "auto" does not ask the native engine, where it does not, before the sparse engine is asked or, `not_sparse`, after it.
    Derivatives of collocation are by all its nodes at once."""
    full = traced and any(stage.collocation is not None for stage, _ in problem.equation.stages)
    largest = LARGEST_FULL if full else LARGEST_SCALARS if not_sparse else LARGEST_NATIVE
    return _larger_than(largest, problem, traced) or _other_device()


def most_operations(problem: Problem, not_sparse: bool) -> int | None:
    """Scalar operations of a step up to which "auto" takes the native engine; None for any number."""
    return None if problem.size <= LARGEST_FULL else MOST_NOT_SPARSE if not_sparse else MOST_OPERATIONS


def most_traced(array_operations: float) -> int:
    """Scalar operations up to which an equation is traced that takes so many operations on arrays."""
    return min(MOST_TRACED, int(LEFT_OUT * SCALARS_FOR_ARRAYS * array_operations))


def small_for_scalars(problem: Problem) -> bool:
    """Whether the xla engine writes the step in scalars because that is quicker than arrays."""
    many = problem.batch is not None and problem.batch >= SCALAR_BATCH
    return problem.size <= LARGEST_SCALAR and (many or fast_loops_asked_for()) and jax.default_backend() == "cpu"


def _larger_than(largest: int, problem: Problem, traced: bool) -> str | None:
    size = problem.size if traced else _solved_at_once(problem)
    return None if size <= largest else f"{size} numbers a step, more than {largest}"


def _solved_at_once(problem: Problem) -> int:
    """`size`, of collocation that of one node, since no matrix of all nodes is formed: the outer solar system has 18 unknowns at
    each of eight, and takes 44 µs a step of 500 days, 7 sweeps."""
    (first, _), *others = problem.equation.stages
    return problem.size if others or first.collocation is None else max(first.state_size, first.collocation.first)


def _other_device() -> str | None:
    device: Any = getattr(jax.config, "jax_default_device", None)
    # asking JAX starts it, which takes 10 ms
    known = "cpu" if getattr(jax.config, "jax_platforms", None) == "cpu" or not _plugins() else None
    platform = getattr(device, "platform", device) or known or jax.default_backend()
    return None if platform == "cpu" else f"JAX computes on {platform}"


@cache
def _plugins() -> bool:
    return any(map(find_spec, PLUGINS))
