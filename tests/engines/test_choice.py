"""Which engine "auto" takes: by the size of a step and by what it holds."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.engines import policy as choice
from dirax.engines import step_program as module_of_steps
from dirax.engines.step_program import step_program
from dirax.program.interpreter import UnsupportedPrimitive

N = 20
RUN = {"q": np.sin(np.arange(float(N))), "v": np.zeros(N), "step": 0.01, "steps": 5}


def potential(differences):
    """The same for neighbours alone and for all pairs."""
    return dx.LagrangeDirac(lambda q, v: v @ v / 2 - jnp.sum(1 - jnp.cos(differences(q))) - q @ q / 2)


@pytest.mark.soak
def test_sparse_steps_beyond_the_size_of_full_ones_are_native(monkeypatch):
    monkeypatch.setattr(choice, "MOST_OPERATIONS", 10_000)
    monkeypatch.setattr(choice, "MOST_NOT_SPARSE", 10_000)
    neighbours = dx.simulate(potential(jnp.diff), dx.LagrangeDAlembert(), **RUN)
    assert 2 * N > choice.LARGEST_FULL and neighbours.stats["engine"] == "native"
    pairs = dx.simulate(potential(lambda q: q[:, None] - q[None]), dx.LagrangeDAlembert(), **RUN)
    assert pairs.stats["engine"] == "xla" and "scalar operations to be written out, more than 10000" in pairs.stats["not_native"]
    again = dx.simulate(potential(jnp.diff), dx.LagrangeDAlembert(), **RUN, engine="xla")
    np.testing.assert_allclose(again.q, neighbours.q, atol=1e-12)


@pytest.mark.soak
def test_too_large_a_step_says_its_size():
    size = choice.LARGEST_NATIVE // 2 + 1
    large = dx.simulate(potential(jnp.diff), dx.LagrangeDAlembert(), q=np.zeros(size), v=np.ones(size), step=0.01, steps=1)
    assert large.stats["engine"] == "sparse" and large.stats["not_native"] == f"{2 * size} numbers a step, more than 192"


def test_a_large_step_that_is_not_sparse_is_native(monkeypatch):
    """Of more numbers than such as are sparse may have."""
    monkeypatch.setattr(choice, "LARGEST_NATIVE", 2 * N - 2)
    all_of_all = dx.LagrangeDirac(lambda q, v: v @ v / 2 - jnp.cos(jnp.sum(q)) - q @ q)
    sol = dx.simulate(all_of_all, dx.LagrangeDAlembert(), **RUN)
    assert sol.stats["engine"] == "native" and "not_native" not in sol.stats
    monkeypatch.setattr(choice, "LARGEST_SCALARS", 2 * N - 1)
    dx.clear_caches()
    again = dx.simulate(all_of_all, dx.LagrangeDAlembert(), **RUN)
    assert again.stats["engine"] == "xla" and again.stats["not_native"] == f"{2 * N} numbers a step, more than {2 * N - 1}"
    np.testing.assert_allclose(sol.q, again.q, rtol=1e-12)


@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.soak_of("True")
def test_operations_do_not_matter_where_an_array_program_would_be_far_larger(nested, monkeypatch):
    """L = v²/2 − x² − λ y in three coordinates: a chain whose steps differentiate its constraints again and again."""
    monkeypatch.setattr(choice, "LARGEST_FULL", 3)
    monkeypatch.setattr(choice, "MOST_OPERATIONS", 4)
    monkeypatch.setattr(choice, "SCALARS_FOR_ARRAYS", 0.1)
    plain = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[0] ** 2 - jnp.cos(q[1]))
    hidden = dx.LagrangeDirac(lambda q, v: v[:2] @ v[:2] / 2 - q[0] ** 2 + q[2] * (q[1] - jnp.sin(q[0])))
    run = {"q": [0.1, 0.2], "v": [0.3, 0.4]}
    system: Any = plain
    if nested:
        chain = dx.constraint_algorithm(hidden, {"q": [0.1, 0.1, 0.0], "v": [0.3, 0.3, 0.0]})
        assert chain.index == 4
        system, run = chain.resolved(), {"x": chain.point}
    sol = dx.simulate(system, dx.DiscreteDirac() if nested else dx.LagrangeDAlembert(), **run, step=0.01, steps=3)
    assert step_program(sol.equation, sol.params, False).nested == nested
    assert sol.stats["engine"] == ("native" if nested else "xla")


def test_a_step_whose_elimination_is_too_large_goes_to_arrays(monkeypatch):
    """Its residual is small enough to be traced, which is all that the native engine says before it writes the kernel."""
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - jnp.sum(jnp.cos(q[:, None] - q[None, :] * 0.7)))
    run = {"q": np.linspace(0.1, 0.5, 4), "v": np.zeros(4), "step": 0.05, "steps": 5}
    monkeypatch.setenv("DIRAX_CACHE", "off")
    size = step_program(dx.simulate(system, dx.LagrangeDAlembert(), **run).equation, None, False).size
    monkeypatch.setattr(module_of_steps, "NODE_LIMIT", size + 10)
    monkeypatch.setattr(choice, "MOST_TRACED", 0)
    dx.clear_caches()
    sol = dx.simulate(system, dx.LagrangeDAlembert(), **run)
    assert sol.ok and sol.stats["engine"] == "xla" and f"more than {size + 10} scalar operations" in sol.stats["not_native"]
    assert step_program(sol.equation, None, False).size == size
    with pytest.raises(UnsupportedPrimitive, match=f"more than {size + 10} scalar operations"):
        dx.simulate(system, dx.LagrangeDAlembert(), **run, engine="native")


def test_a_large_step_that_takes_xla_longer_is_traced_further(monkeypatch):
    """Of more scalar operations than a limit, and many more operations on arrays than a chain with as many."""
    monkeypatch.setattr(module_of_steps, "NODE_LIMIT", 1000)
    turned = lambda q: jnp.stack([jnp.sin(q[i]) * jnp.cos(q[(i + 1) % 6]) for i in range(6)])
    written = dx.LagrangeDirac(lambda q, v: v @ v / 2 + turned(turned(turned(q))) @ turned(q))
    run = {"q": np.linspace(0.1, 0.9, 6), "v": np.zeros(6), "step": 0.01, "steps": 3}
    sol = dx.simulate(written, dx.LagrangeDAlembert(), **run)
    assert sol.stats["engine"] == "native" and sol.stats["operations"] > 1000
    pairs = potential(lambda q: q[:, None] - q[None, :])
    of_arrays = dx.simulate(pairs, dx.LagrangeDAlembert(), **RUN)
    assert of_arrays.stats["engine"] == "xla" and "scalar operations" in of_arrays.stats["not_native"]


def test_a_first_step_too_stiff_for_what_native_has_is_taken_by_xla(monkeypatch):
    """A fixed point of the rates at two nodes diverges, and Newton's methods are made too large to be written."""

    def refuse(*given):
        raise UnsupportedPrimitive("the step as a whole", "is too large", "here")

    stiff = dx.LagrangeDirac(lambda q, v: v @ v / 2 - 1e6 * q @ q / 2 - jnp.sum(jnp.cos(q)))
    run = {"q": [1.5, -0.4], "v": [0.0, 1.0], "step": 0.2, "steps": 4}
    monkeypatch.setattr("dirax.engines.native.run.kernels", refuse)
    monkeypatch.setattr("dirax.engines.native.collocation_kernels.CollocationKernels.by_newton", None)
    native = dx.simulate(stiff, dx.Collocation(2), **run, engine="native")
    assert not native.ok and "Newton's method is too large for this engine" in native.message
    sol = dx.simulate(stiff, dx.Collocation(2), **run)
    assert sol.ok and sol.stats["engine"] == "xla" and "too large for this engine" in sol.stats["not_native"]
