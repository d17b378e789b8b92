"""Whole numbers and truth values among the parameters of a batch: the dtype that the user's functions see, on every engine."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

MIDPOINT = dx.LagrangeDAlembert()
TABLE = np.array([1.0, 2.0, 5.0])
RUN = {"step": 0.1, "steps": 30, "batch_params": True}


def oscillator(stiffness):
    """L = v²/2 − k q²/2 with k = stiffness(params)."""
    return dx.LagrangeDirac(lambda q, v, params: (v @ v - stiffness(params) * q @ q) / 2)


def cayley(k, h, steps):
    """q of the midpoint rule from q = 1 at rest: it turns (√k q, p) by 2 arctan(h√k/2) a step."""
    return np.cos(steps * 2 * np.arctan(h * np.sqrt(k) / 2))


@pytest.mark.parametrize("engine", ["xla", "auto", "native"])
def test_indices_and_truth_values(engine):
    chosen = oscillator(lambda p: jnp.asarray(TABLE)[p["k"]] * jnp.where(p["stiff"], p["factor"], 1.0))
    k, stiff = np.array([2, 0, 1, 2]), np.array([True, False, True, False])
    params = {"k": k, "stiff": stiff, "factor": np.full(4, 3.0)}
    sol = dx.simulate(chosen, MIDPOINT, q=np.ones((4, 1)), v=np.zeros((4, 1)), params=params, engine=engine, **RUN)
    assert sol.ok.all() and sol.stats["engine"] == ("native" if engine == "auto" else engine)
    exact = cayley(TABLE[k] * np.where(stiff, 3.0, 1.0), 0.1, 30)
    np.testing.assert_allclose(sol.q[:, -1, 0], exact, atol=1e-12)
    np.testing.assert_allclose(np.ptp(sol.energy(), axis=1), 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("number", "stiffness"),
    [
        (np.int32(2**30), lambda p: jnp.asarray(p * 4 + 2, float)),  # it wraps around
        (np.array([1, 255], np.uint8), lambda p: jnp.asarray(p[0] - p[1], float)),
        (2**53 + 1, lambda p: 2.0 * jnp.asarray(p - 2**53, float)),  # no float64
        (10**9, lambda p: jnp.asarray(p, float) * 2e-9),
    ],
)
@pytest.mark.parametrize("engine", ["xla", "native"])
@pytest.mark.soak_of("xla-number0-<lambda>", "xla-number1-<lambda>", "xla-9007199254740993-<lambda>", "xla-1000000000-<lambda>")
def test_whole_numbers_of_any_size_are_those_of_jax(number, stiffness, engine):
    run = {"q": np.ones(1), "v": np.zeros(1), "step": 0.1, "steps": 30, "engine": engine}
    sol = dx.simulate(oscillator(stiffness), MIDPOINT, params=number, **run)
    np.testing.assert_allclose(sol.q[-1, 0], cayley(2.0, 0.1, 30), atol=1e-13)
    np.testing.assert_allclose(sol.energy(), 1.0, atol=1e-13)


@pytest.mark.parametrize("kind", [np.longdouble, ">f8", np.float16])
def test_floats_of_other_kinds(kind):
    sol = dx.simulate(
        oscillator(lambda p: jnp.asarray(p[0], float)),
        MIDPOINT,
        q=np.ones(1),
        v=np.zeros(1),
        params=np.array([2.0], kind),
        step=0.1,
        steps=30,
    )
    np.testing.assert_allclose(sol.q[-1, 0], cayley(2.0, 0.1, 30), atol=1e-13)


@pytest.mark.parametrize("engine", ["xla", "auto"])
@pytest.mark.soak_of("xla")
def test_a_table_read_where_the_params_are_captured(engine):
    """sol.params can be closed over and read by an index that JAX traces, as can what a failed step is explained from."""
    chosen = oscillator(lambda p: p["table"][p["k"]])
    once = {"q": np.ones(1), "v": np.zeros(1), "params": {"table": TABLE, "k": 2}, "step": 0.1, "steps": 3, "engine": engine}
    sol = dx.simulate(chosen, MIDPOINT, **once)
    assert jax.jit(lambda k: sol.params["table"][k])(1) == 2.0
    limited = dx.LagrangeDirac(lambda q, v, p: v @ v / 2 + p["table"][p["k"]] * jnp.sum(jnp.log(1.1 - q)))
    failed = dx.simulate(limited, MIDPOINT, **once | {"v": np.full(1, 5.0), "steps": 30})
    assert not failed.ok and "step" in failed.message and len(failed.t) < 31


@pytest.mark.parametrize("engine", [pytest.param("xla", marks=pytest.mark.soak), "auto"])
def test_derivatives_beside_an_index(engine):
    """By the floating parameter, of which the index chooses the entry: by central differences of the closed form."""
    chosen = oscillator(lambda p: p["table"][p["k"]])
    k, table = np.array([2, 0]), np.stack([TABLE, 2 * TABLE])

    def end(table):
        params = {"k": k, "table": table}
        return (
            dx.simulate(chosen, MIDPOINT, q=jnp.ones((2, 1)), v=jnp.zeros((2, 1)), params=params, engine=engine, **RUN)
            .q[:, -1]
            .sum()
        )

    slopes = np.zeros((2, 3))
    for lane, i in enumerate(k):
        at = table[lane, i]
        slopes[lane, i] = (cayley(at + 1e-6, 0.1, 30) - cayley(at - 1e-6, 0.1, 30)) / 2e-6
    np.testing.assert_allclose(jax.grad(end)(jnp.asarray(table)), slopes, atol=1e-8)


STILL = {"count": 2, "stiff": True, "on": np.array([True]), "which": np.int32(1)}


@oscillator
def MIXED(p):
    stiffness = jnp.where(p["stiff"] & p["on"][0], jnp.asarray(TABLE)[p["which"]] * jnp.asarray(p["k"], float), 0.0)
    return stiffness * jnp.asarray(p["count"], float)


def mixed(engine, **params):
    """The end of a run whose stiffness is 2·TABLE[1]·k, of leaves that are no floats and one that is."""
    run = {"q": np.ones(1), "v": np.zeros(1), "step": 0.1, "steps": 30, "engine": engine}
    return dx.simulate(MIXED, MIDPOINT, params=STILL | params, **run).q[-1, 0]


def mixed_slope(k):
    return (cayley(4 * k + 4e-6, 0.1, 30) - cayley(4 * k - 4e-6, 0.1, 30)) / 2e-6


@pytest.mark.parametrize("engine", ["xla", "auto", "native"])
@pytest.mark.soak
def test_leaves_that_stand_still_beside_one_that_jax_traces(engine):
    end = lambda k: mixed(engine, k=k)
    several = jnp.array([1.5, 0.5])
    (values, slopes), (value, slope), single = jax.jit(
        lambda k: (jax.vmap(jax.value_and_grad(end))(k), jax.jvp(end, (k[0],), (1.0,)), jax.grad(end)(jnp.float32(1.5)))
    )(several)
    np.testing.assert_allclose(values, cayley(np.array([6.0, 2.0]), 0.1, 30), atol=1e-12)
    np.testing.assert_allclose(slopes, [mixed_slope(1.5), mixed_slope(0.5)], rtol=1e-6)
    np.testing.assert_allclose([value, slope], [values[0], slopes[0]], rtol=1e-12)
    np.testing.assert_allclose(single, mixed_slope(1.5), rtol=1e-6)
    assert single.dtype == np.float32


@pytest.mark.parametrize("engine", [pytest.param("xla", marks=pytest.mark.soak), "auto"])
def test_leaves_that_are_no_floats_and_that_jax_traces(engine):
    params = STILL | {"k": 1.5}
    end = lambda params: mixed(engine, **params)
    several = jax.tree.map(lambda a: np.stack([a, a]), params) | {"count": np.array([2, 1])}
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(end, allow_int=True)))(several)
    np.testing.assert_allclose(values, cayley(np.array([6.0, 3.0]), 0.1, 30), atol=1e-12)
    np.testing.assert_allclose(slopes["k"][0], mixed_slope(1.5), rtol=1e-6)


@pytest.mark.soak
def test_what_only_whole_numbers_can_do_falls_back_and_says_so():
    shifted = oscillator(lambda p: (1 << p["k"]).astype(float))
    k = np.array([0, 1, 3])
    sol = dx.simulate(shifted, MIDPOINT, q=np.ones((3, 1)), v=np.zeros((3, 1)), params={"k": k}, **RUN)
    assert sol.stats["engine"] == "xla" and "shift_left" in sol.stats["not_native"]
    np.testing.assert_allclose(sol.q[:, -1, 0], cayley(2.0**k, 0.1, 30), atol=1e-12)
