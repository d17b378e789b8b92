"""Values that JAX traces and functions close over go with the params: a loss that states its system costs what one with params
does, and has its values and derivatives."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

START = {"q": [1.0, 0.2], "v": [0.0, 0.1], "step": 0.05, "steps": 20}
MIDPOINT = dx.LagrangeDAlembert()
K = 1.3
FACTOR = 1.0


def end(lagrangian, scheme=MIDPOINT, **more):
    return jnp.sum(dx.simulate(dx.LagrangeDirac(lagrangian), scheme, **START | more).q[..., -1, :] ** 2)


def by_params(k, scheme=MIDPOINT, **more):
    return end(lambda q, v, params: v @ v / 2 - params["k"] * q @ q / 2, scheme, params={"k": k}, **more)


class Spring(eqx.Module):
    """A stiffness with a name that is static."""

    k: jax.Array
    name: str = eqx.field(static=True, default="spring")

    def lagrangian(self, q, v):
        return v @ v / 2 - self.k * q @ q / 2


class Plain:
    def __init__(self, k):
        self.stiffness = {"k": [k]}

    def lagrangian(self, q, v):
        return v @ v / 2 - self.stiffness["k"][0] * q @ q / 2


class Counting(Plain):
    """Keeps a record, which is its own."""

    calls = 0

    def lagrangian(self, q, v):
        self.calls += 1
        return super().lagrangian(q, v)


def of_helper(k):
    potential = lambda q: k * q @ q / 2
    return lambda q, v: v @ v / 2 - potential(q)


WAYS = {
    "a number": lambda k: lambda q, v: v @ v / 2 - k * q @ q / 2,
    "a default": lambda k: lambda q, v, k=k: v @ v / 2 - k * q @ q / 2,
    "a function of it": of_helper,
    "a partial function": lambda k: functools.partial(lambda k, q, v: v @ v / 2 - k * q @ q / 2, k),
    "a pytree": lambda k: Spring(jnp.asarray(k)).lagrangian,
    "an object": lambda k: Plain(k).lagrangian,
    "an object in the closure": lambda k: (lambda plain: lambda q, v: plain.lagrangian(q, v))(Plain(k)),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.soak_of(but=["a partial function", "an object in the closure"])
def test_it_is_the_run_with_params_and_is_compiled_once(way, compiled):
    loss = lambda k: end(WAYS[way](k))
    assert float(jax.grad(loss)(K)) == float(jax.grad(by_params)(K))
    many = len(compiled)
    assert float(jax.grad(loss)(1.1 * K)) == pytest.approx(float(jax.grad(by_params)(1.1 * K)), rel=1e-14)
    assert len(compiled) == many
    values = jax.vmap(loss)(jnp.array([K, 2.0]))
    np.testing.assert_allclose(values, [float(loss(K)), float(loss(2.0))], rtol=1e-13)


GIVEN = [{}, {"q": [0.5, 0.1]}, {"params": {"s": 2.0}}, {"q": [0.5, 0.1], "params": {"s": 2.0}}]


@pytest.mark.parametrize("given", GIVEN, ids=str)
@pytest.mark.parametrize("traced", ["closed over", "params"])
@pytest.mark.soak_of("closed over-{}", "params-{}")
def test_a_run_that_is_prepared_where_jax_traces(traced, given):
    """What it was given later was left out without a word."""

    def loss(k):
        factor, s = (k, 1.0) if traced == "closed over" else (1.0, k)
        system = dx.LagrangeDirac(lambda q, v, params: v @ v / 2 - factor * params["s"] * q @ q / 2)
        run = dx.prepare(system, MIDPOINT, params={"s": s}, **START)
        return jnp.sum(run(**given).q[-1])

    near = (loss(K + 1e-5) - loss(K - 1e-5)) / 2e-5
    assert float(jax.grad(loss)(K)) == pytest.approx(float(near), rel=1e-8, abs=1e-12)


@pytest.mark.soak
def test_a_global_that_has_changed_is_read_again(monkeypatch):
    """It was refused although it was stated again."""
    loss = lambda k: end(lambda q, v: v @ v / 2 - FACTOR * k * q @ q / 2)
    before = float(jax.grad(loss)(K))
    monkeypatch.setitem(globals(), "FACTOR", 2.0)
    assert float(jax.grad(loss)(K)) == pytest.approx(2.0 * float(jax.grad(by_params)(2.0 * K)), rel=1e-13) != before
    monkeypatch.setitem(globals(), "FACTOR", 1.0)
    assert float(jax.grad(loss)(K)) == before


def test_keys_without_an_order_are_left_alone():
    loss = lambda k: (lambda table: end(lambda q, v: v @ v / 2 - table["a"] * k * q @ q / 2))({"a": 1.0, 1: 2.0})
    assert float(jax.grad(loss)(K)) == pytest.approx(float(jax.grad(by_params)(K)), rel=1e-13)


def test_an_object_that_keeps_a_record_is_left_to_itself():
    """It is compiled by the xla engine, and its record goes on."""
    seen = []

    def loss(k):
        seen.append(Counting(k))
        return end(seen[-1].lagrangian)

    assert float(jax.grad(loss)(K)) == pytest.approx(float(jax.grad(by_params)(K)), rel=1e-12)
    assert seen[0].calls > 0


@pytest.mark.soak
def test_beside_params_of_a_batch():
    stiffness = jnp.array([1.0, 2.0])
    batch = {"q": np.ones((2, 2)), "v": np.zeros((2, 2)), "batch_params": True}
    loss = lambda k: end(lambda q, v, params: v @ v / 2 - k * params["s"] * q @ q / 2, params={"s": stiffness}, **batch)
    expected = lambda k: by_params(k * stiffness, **batch)
    assert float(jax.grad(loss)(K)) == pytest.approx(float(jax.grad(expected)(K)), rel=1e-13)


def test_what_follows_a_run_has_the_params_it_was_given():
    def loss(k):
        sol = dx.simulate(
            dx.LagrangeDirac(lambda q, v, params: v @ v / 2 - k * params["s"] * q @ q / 2), MIDPOINT, params={"s": 2.0}, **START
        )
        own = sol.map_rows(lambda row, params: params["s"] * row["q"][0])
        return jnp.sum(sol.energy()) + jnp.sum(own) + sol.at(0.33).q[0] + sol.params["s"]

    near = (loss(K + 1e-5) - loss(K - 1e-5)) / 2e-5
    assert float(jax.grad(loss)(K)) == pytest.approx(float(near), rel=1e-8)


@pytest.mark.soak
def test_second_derivatives():
    loss = lambda k: end(WAYS["a number"](k))
    assert float(jax.hessian(loss)(K)) == pytest.approx(float(jax.hessian(by_params)(K)), rel=1e-12)


@pytest.mark.soak
def test_walls_and_events_are_those_of_plain_runs():
    """A peg of a thousandth of a step is hit, as it is in a run that nothing traces."""
    fall = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[1])
    run = {"q": [0.0, 1.0], "v": [1.0, 0.0], "step": 0.1, "steps": 30}
    peg = lambda k: dx.Impact(lambda q: (q[0] - 0.5 * k) ** 2 + (q[1] - 0.875) ** 2 - 1e-8)
    last = lambda k: jnp.sum(dx.simulate(fall, MIDPOINT, events=[peg(k)], **run).q[-1])
    assert float(jax.jit(last)(1.0)) == pytest.approx(float(last(1.0)), rel=1e-13)
    assert abs(float(last(1.0)) - float(last(1.1))) > 0.1
    level = lambda k: jnp.nansum(dx.simulate(fall, MIDPOINT, events=[dx.Event(lambda q: q[1] - k)], **run).events.t)
    assert float(jax.grad(level)(0.5)) == pytest.approx(float((level(0.5 + 1e-6) - level(0.5 - 1e-6)) / 2e-6), rel=1e-7)


SKEW, INPUT = np.array([[0.0, 1.0], [-1.0, 0.0]]), np.array([[0.0], [1.0]])
OTHERS = {
    "matrices of a port-Hamiltonian": lambda k: (
        dx.PortHamiltonian(lambda x: k * x @ x / 2, SKEW, R=lambda x: jnp.diag(jnp.stack([0.0 * k, k / 9]))),
        dx.DiscreteGradient(), {},
    ),
    "its inputs": lambda k: (
        dx.PortHamiltonian(lambda x: x @ x / 2, SKEW, B=INPUT), dx.DiscreteGradient(),
        {"inputs": lambda t, x: jnp.stack([k * jnp.sin(t)])},
    ),
    "a resistor": lambda k: (
        dx.circuit([("C", 1, 0, 1.0), ("L", 1, 2, 1.0), ("R", 2, 0, lambda u: k * u + u**3)]), dx.DiscreteDirac(), {},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", OTHERS)
@pytest.mark.soak
def test_of_other_systems(name):
    def loss(k):
        system, scheme, more = OTHERS[name](k)
        return jnp.sum(dx.simulate(system, scheme, x=[1.0, 0.2], step=0.05, steps=20, **more).x[-1] ** 2)

    near = (loss(K + 1e-5) - loss(K - 1e-5)) / 2e-5
    assert float(jax.grad(loss)(K)) == pytest.approx(float(near), rel=1e-8)


def skate(q):
    return jnp.stack([jnp.stack([jnp.sin(q[2]), -jnp.cos(q[2]), jnp.zeros(())])])


@pytest.mark.parametrize(
    "system",
    [
        lambda k: dx.NonholonomicMechanics(lambda q: k * jnp.eye(3), lambda q: q @ q, skate),
        lambda k: dx.ManifoldLagrangian(lambda q, v: k * v @ v / 2 - q[2] ** 2, dx.Euclidean(3), forces=lambda t, q, v: -k * v),
        lambda k: dx.LagrangeDirac(lambda q, v: v @ v / 2 - k * q[2], holonomic=lambda q: jnp.stack([q @ q - 1.0])),
    ],
    ids=["nonholonomic", "on a manifold", "holonomic"],
)  # fmt: skip
@pytest.mark.soak_of(but=["on a manifold"])
def test_of_systems_that_are_made_into_others(system):
    def loss(k):
        return dx.simulate(system(k), MIDPOINT, q=[1.0, 0.0, 0.0], v=[0.0, 0.0, 0.3], step=0.05, steps=20).q[-1, 2]

    near = (loss(K + 1e-5) - loss(K - 1e-5)) / 2e-5
    assert float(jax.grad(loss)(K)) == pytest.approx(float(near), rel=1e-7)
