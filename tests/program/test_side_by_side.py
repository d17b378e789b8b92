"""Functions at many entries by XLA, whose threads must not wait for one another."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dirax.program import side_by_side as module
from dirax.program.side_by_side import side_by_side, waits
from dirax.program.tracing import gradient

MATRIX = jax.ShapeDtypeStruct((3, 3), jnp.float64)


@pytest.mark.parametrize(
    ("function", "least"),
    [
        (lambda a: a @ a, 0),
        (jnp.linalg.inv, 2),
        (lambda a: jax.lax.scan(lambda c, _: (jnp.linalg.cholesky(c @ c.T + jnp.eye(3)), None), a, None, 3)[0], 1),
        (lambda a: gradient(lambda a: jnp.sum(jnp.linalg.inv(a)))(a), 8),
    ],
)
def test_what_is_shared_out_to_threads_is_counted(function, least, monkeypatch):
    monkeypatch.setattr(module, "threads", lambda: max(1, least))
    assert waits(function, MATRIX) == (least > 0)
    monkeypatch.setattr(module, "threads", lambda: 1000)
    assert not waits(function, MATRIX)


@pytest.mark.parametrize("threads", [1, 1000])
@pytest.mark.soak_of("1")
def test_it_is_vmap(threads, monkeypatch):
    monkeypatch.setattr(module, "threads", lambda: threads)
    draw = np.random.default_rng(0).normal
    one = lambda item, shift: {"x": jnp.linalg.solve(item["a"] + shift, item["b"]), "s": item["b"][0]}
    items, shift = {"a": draw(size=(5, 3, 3)), "b": draw(size=(5, 3))}, draw(size=(3, 3))
    for axes, second in (((0, None), shift), ((0, 0), draw(size=(5, 3, 3)))):
        found, expected = jax.jit(side_by_side(one, axes))(items, second), jax.vmap(one, axes)(items, second)
        for name in expected:
            np.testing.assert_allclose(found[name], expected[name], rtol=1e-10)
    assert jax.make_jaxpr(side_by_side(one, (0, None)))(items, shift).eqns[-1].primitive.name.startswith("scan") == (threads == 1)


def test_solves_that_wait_for_one_another_come_to_an_end():
    """Under `jax.vmap` these never end on two cores."""
    code = """
import jax, jax.numpy as jnp, dirax
from dirax.program.side_by_side import side_by_side
one = lambda a: [jnp.sum(jax.scipy.linalg.solve_triangular(a + k * jnp.eye(64), jnp.eye(64), lower=True)) for k in range(1, 17)]
found = jax.jit(side_by_side(one, (0,)))(jnp.zeros((8, 64, 64)))
print(float(found[3][5]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout.split() == ["16.0"]
