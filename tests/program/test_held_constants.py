"""Constants that no node of a graph of float64 stands for: keys of jax.random, single precision, whole numbers above 2⁵³."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.program.rules import elementwise, reductions
from dirax.program.scalar_program import ScalarProgram

WEIGHTS = jnp.asarray(np.linspace(0.2, 0.8, 3), jnp.float32)


def drawn(q, key):
    return jnp.sum(jnp.tanh(jax.random.normal(key, (3,)) * q[0]) ** 2)


def split_in_a_loop(q):
    keys = jax.random.split(jax.random.key(1), 3)
    return q[0] ** 2 * jax.lax.scan(lambda sum, key: (sum + jax.random.uniform(key) / 4, None), 0.0, keys)[0]


@pytest.mark.parametrize(
    "potential",
    [
        lambda q: drawn(q, jax.random.key(0)),
        lambda q: drawn(q, jax.random.PRNGKey(0)),
        split_in_a_loop,
        lambda q: jnp.sum(WEIGHTS.astype(float) * q[0] ** jnp.arange(2.0, 5.0)),
        lambda q: jax.jit(lambda weights: jnp.sum(jnp.tanh((weights * weights).astype(float) * q[0]) ** 2))(WEIGHTS),
        lambda q: WEIGHTS[jnp.argmax(WEIGHTS - WEIGHTS[1])].astype(float) * jnp.float16(0.5).astype(float) * q[0] ** 2,
        lambda q: q[0] ** 2 * (jnp.uint64(2**63 + 12345) >> 60).astype(float) / 16,
    ],
)
@pytest.mark.soak_of(but=["split_in_a_loop"])
def test_both_engines_take_them(potential):
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2 - potential(q))
    run = dict(q=[1.0], v=[0.2], step=0.1, steps=20)
    native, xla = (dx.simulate(system, dx.Collocation(2), **run, engine=engine) for engine in ("native", "xla"))
    np.testing.assert_allclose(native.q, xla.q, rtol=0, atol=1e-13)
    plain = dx.simulate(dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2), dx.Collocation(2), **run)
    assert np.max(np.abs(native.q - plain.q)) > 1e-3


def test_single_precision_of_the_state_is_said():
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - (q.astype(jnp.float32).astype(float) ** 2).sum() / 2)
    with pytest.raises(Exception, match="float32"):
        dx.simulate(system, dx.LagrangeDAlembert(), q=[1.0], v=[0.2], step=0.1, steps=20, engine="native")


def test_a_network_of_single_precision_that_is_closed_over_runs_natively():
    weights = np.random.default_rng(0).normal(size=(4, 2)).astype(np.float32)
    with jax.numpy_dtype_promotion("standard"):
        network = lambda q: jnp.tanh(jnp.asarray(weights) @ q) @ weights[:, 0]
        system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2 - network(q))
        sol = dx.simulate(system, dx.Collocation(2), q=[0.3, 0.2], v=[0.1, 0.4], step=0.1, steps=20)
        assert sol.stats["engine"] == "native" and dx.verify(sol).ok


def test_products_of_constants_have_the_bits_of_their_sums(monkeypatch):
    """A solve with a constant matrix of 200 unknowns made eight million nodes of them, in a minute."""
    left, right = np.random.default_rng(0).normal(size=(2, 12, 12))
    left[3], right[:, 2] = 0.0, -0.0
    closed = jax.make_jaxpr(lambda x: (jnp.asarray(left) @ right) @ x + jnp.linalg.solve(jnp.asarray(left + 5 * np.eye(12)), x))(
        jnp.ones(12)
    )
    found = []
    for large in (1, 10**9):
        monkeypatch.setattr(reductions, "LARGE", large)
        found.append(ScalarProgram.of(closed).in_numpy([np.linspace(0.1, 1.0, 12)[None]])[0])
    assert found[0].tobytes() == found[1].tobytes() and np.all(np.isfinite(found[0]))


def test_operations_on_arrays_of_constants_have_the_bits_of_those_on_each(monkeypatch):
    held = np.array([0.1, -0.0, np.inf, np.nan, 3.0, -2.5])

    @np.errstate(invalid="ignore")
    def function(x, xp=jnp):
        pairs = xp.asarray(held)[:, None], xp.asarray(held)[None] + 1.0
        found = [op(*pairs) for op in (xp.add, xp.subtract, xp.multiply, xp.less, xp.equal, xp.not_equal, xp.less_equal)]
        return xp.stack([xp.asarray(a, float) for a in (*found, -pairs[1] * pairs[0], xp.abs(pairs[0] * pairs[1]))]), x

    closed, made = jax.make_jaxpr(function)(1.0), []
    for large in (1, 10**9):
        monkeypatch.setattr(elementwise, "LARGE", large)
        made.append(ScalarProgram.of(closed))
    one, other = made
    assert one.graph.op == other.graph.op and one.graph.args == other.graph.args
    numbers = [np.nan_to_num(program.constants(program.results[0]), nan=7.0, posinf=np.inf, neginf=-np.inf) for program in made]
    assert numbers[0].tobytes() == numbers[1].tobytes()
    np.testing.assert_array_equal(one.constants(one.results[0]), function(1.0, np)[0])


@pytest.mark.parametrize(
    ("potential", "real"),
    [
        (lambda q: jnp.imag(jnp.exp(1j * q[0])), lambda q: jnp.sin(q[0])),
        (lambda q: jnp.real((q[0] + 1j * q[1]) ** 3) / 10, lambda q: (q[0] ** 3 - 3 * q[0] * q[1] ** 2) / 10),
        (lambda q: jnp.abs(q[0] + 1j * q[1] + 0.5) ** 2 / 2, lambda q: ((q[0] + 0.5) ** 2 + q[1] ** 2) / 2),
    ],
)
@pytest.mark.soak_of(but=["<lambda>-<lambda>2"])
def test_complex_numbers_on_the_way(potential, real):
    """i times what no node holds was taken for i: the first of these was a constant potential on the native engine."""

    def run(potential):
        system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q - potential(q))
        return dx.simulate(system, dx.LagrangeDAlembert(), q=[0.3, 0.4], v=[0.2, -0.1], step=0.05, steps=20)

    with jax.numpy_dtype_promotion("standard"):
        sol = run(potential)
        assert sol.stats["engine"] == "native"
        np.testing.assert_allclose(sol.q, run(real).q, rtol=0, atol=1e-13)
        assert dx.verify(sol).ok


def test_gradients_with_complex_arrays_that_are_held():
    """Whose parts are arrays of JAX, which makes them while it traces the run."""
    turned = jnp.asarray(np.exp(1j * np.arange(3.0)))
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - jnp.abs(turned @ q.astype(complex)) ** 2)

    def last(q, engine):
        return jnp.sum(dx.simulate(system, dx.LagrangeDAlembert(), q=q, v=0 * q, step=0.1, steps=3, engine=engine).q[-1] ** 2)

    q = jnp.array([0.1, -0.2, 0.4])
    np.testing.assert_allclose(jax.grad(last)(q, "native"), jax.grad(last)(q, "xla"), rtol=1e-12)
