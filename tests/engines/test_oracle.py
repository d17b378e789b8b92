"""The xla engine with scalars="never": JAX alone, without the scalar program, on the whole gallery against the native engine."""

import subprocess
import sys

import jax
import numpy as np
import pytest

import dirax as dx
import dirax.gallery as gallery
from dirax.engines.xla import Xla

ORACLE = Xla(scalars="never")
ALONE = """
import sys

class Forbidden:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "llvmlite" or name.startswith("dirax.engines.native"):
            raise ImportError(f"{name} must not be imported")

sys.meta_path.insert(0, Forbidden())

import jax, jax.numpy as jnp, numpy as np
import dirax as dx

system = dx.LagrangeDirac(lambda q, v, k: v @ v / 2 - k * q @ q / 2 + 1e-3 * jnp.sqrt(1.5 - q[0]))
run = {"v": [0.4], "params": 1.0, "step": 0.1, "steps": 12, "engine": ENGINE}
one = dx.simulate(system, dx.LagrangeDAlembert(), q=[1.0], **run)
many = dx.simulate(system, dx.LagrangeDAlembert(), q=np.linspace(0.1, 1.0, 70)[:, None], compensated=True, **run)
np.testing.assert_allclose(many.q[-1], one.q, atol=1e-13)
failing = dx.simulate(system, dx.LagrangeDAlembert(), q=[1.0], **(run | {"v": [5.0]}))
assert one.ok and np.all(many.ok) and not failing.ok and "not finite" in failing.message
end = lambda k: dx.simulate(system, dx.LagrangeDAlembert(), q=[1.0], **(run | {"params": k})).q[-1, 0]
slope = jax.jit(jax.grad(end))(1.0)
assert np.isfinite(slope)
assert all(dx.verify(run).ok for run in [one, many, many, many])
print(one.stats["engine"], one.stats.get("not_native", ""))
"""


@pytest.mark.parametrize("engine", ["xla", pytest.param("auto", marks=pytest.mark.soak)])
def test_xla_runs_without_the_compiler(engine):
    """A single trajectory, a batch that is written in scalars, a failure with its message, a gradient, a verdict."""
    program = ALONE.replace("ENGINE", repr(engine))
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-3000:]
    assert run.stdout.strip() == ("xla" if engine == "xla" else "xla dirax.engines.native must not be imported")


def assert_agreement(name: str, ours: dx.Solution, theirs: dx.Solution) -> None:
    assert np.all(ours.ok) and np.all(theirs.ok), name
    for field, values in theirs.fields.items():
        tolerance = 1e-9 * max(1.0, float(np.max(np.abs(values), initial=0.0)))
        np.testing.assert_allclose(ours.fields[field], values, rtol=0, atol=tolerance, err_msg=f"{name}: {field}")


QUICK = ("kepler", "rolling-disk", "henon-heiles", "lc-ladder", "rigid-body")
"""Those that XLA compiles in a second or two; all of them take it minutes."""

ELSEWHERE = {"snakeboard-gait": {"q": [0.1, -0.2, 0.3, 0.2, 0.1, -0.15], "v": [0.0] * 6}}
"""Data of examples that begin at rest where unknowns have no size: these grow in a run, for which the oracle has no code."""


@pytest.mark.parametrize("name", [pytest.param(n, marks=[] if n in QUICK else pytest.mark.soak) for n in gallery.names()])
@pytest.mark.soak
def test_the_gallery_by_jax_alone(name):
    example = gallery.get(name)
    ours, theirs = (example.simulate(steps=5, engine=engine, **ELSEWHERE.get(name, {})) for engine in (ORACLE, "native"))
    assert_agreement(name, ours, theirs)


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[] if n == "rolling-disk" else pytest.mark.soak) for n in ("kepler", "rolling-disk", "rigid-body")],
)
def test_large_batches_by_jax_alone_and_in_scalars(name):
    """Above the size from which the policy writes a step in scalars."""
    example = gallery.get(name)
    given = {key: np.tile(np.asarray(value, float), (70, 1)) for key, value in example.initial.items() if np.ndim(value) == 1}
    run = dict(example.initial) | given | {"step": example.step, "steps": 5, "params": example.params}
    theirs = dx.simulate(example.system, example.scheme, **run, engine="native")
    for engine in (ORACLE, "xla"):
        assert_agreement(name, dx.simulate(example.system, example.scheme, **run, engine=engine), theirs)


@pytest.mark.soak
def test_derivatives_by_jax_alone():
    """Of a run with constraints, with respect to a parameter."""
    example = gallery.get("rolling-disk")
    leaves, structure = jax.tree.flatten(example.params)

    def end(engine, leaves):
        params = jax.tree.unflatten(structure, leaves)
        sol = dx.simulate(
            example.system, example.scheme, **example.initial, params=params, step=example.step, steps=4, engine=engine
        )
        return sol.q[-1] @ np.arange(1.0, 1.0 + sol.q.shape[-1])

    leaves = [np.asarray(leaf, float) for leaf in leaves]
    ours, theirs = (jax.grad(lambda x, e=engine: end(e, x))(leaves) for engine in (ORACLE, "native"))
    for mine, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(mine, other, rtol=1e-8, atol=1e-12)
