"""Functions that are stated anew: systems of the same code and values are equal, and share all that was made for one of them."""

import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

RUN = {"q": [1.0, 0.2], "v": [0.0, 0.1], "step": 0.05, "steps": 20}
MIDPOINT = dx.LagrangeDAlembert()


def spring(k, pull=None, bias=(0.0,)):
    potential = lambda q: k * q @ q / 2
    sideways = lambda q: 0.0 if pull is None else pull["at"] @ q
    return dx.LagrangeDirac(lambda q, v, bias=bias: v @ v / 2 - potential(q) - sideways(q) - bias[0])


def end(system, **more):
    return dx.simulate(system, MIDPOINT, **RUN | more).q[-1]


def test_systems_are_equal_by_what_their_functions_read():
    at = lambda x: {"at": np.array([x, 0.0])}
    assert spring(1.5) == spring(1.5) and hash(spring(1.5)) == hash(spring(1.5)) and spring(2.0, at(0.3)) == spring(2.0, at(0.3))
    assert spring(jnp.asarray(1.5)) == spring(jnp.asarray(1.5)) and spring((1, "a")) == spring((1, "a"))
    others = [spring(k) for k in (1.5, 2.0, 0.0, -0.0, 1, True, np.float64(1.5), np.float32(1.5), jnp.asarray(1.5), None)]
    others += [spring(1.5, at(0.1)), spring(1.5, at(-0.0)), spring(1.5, at(0.0)), spring(1.5, None, (0.1,)), spring([1.5])]
    assert all(a != b for i, a in enumerate(others) for b in others[:i])


def test_a_system_that_is_stated_anew_is_prepared():
    """Its first call took as long as that of a new one: a gradient whose loss states its system compiled it every time."""
    first = dx.simulate(spring(1.5), MIDPOINT, **RUN)
    again = dx.simulate(spring(1.5), MIDPOINT, **RUN)
    assert again.equation is first.equation and np.array_equal(again.q, first.q)
    other = dx.simulate(spring(3.0), MIDPOINT, **RUN)
    assert other.equation is not first.equation and not np.allclose(other.q[-1], first.q[-1])


@pytest.mark.parametrize("kind", [dx.Event, dx.Impact, None])
@pytest.mark.soak_of(but=["None"])
def test_a_loss_that_states_everything_compiles_once(kind, compiled):
    def loss(k, offset):
        system = dx.LagrangeDirac(lambda q, v, params: v @ v / 2 - params * q @ q / 2)
        events = [] if kind is None else [kind(lambda q: q[0] + offset)]
        return jnp.sum(dx.simulate(system, MIDPOINT, params=k, events=events, **RUN | {"steps": 50}).q[-1])

    jax.grad(loss)(1.5, 0.5), jax.grad(loss)(1.4, 0.5)
    first = len(compiled)
    found = float(jax.grad(loss)(1.6, 0.5))
    assert len(compiled) == first
    nearby = (loss(1.6 + 1e-5, 0.5) - loss(1.6 - 1e-5, 0.5)) / 2e-5
    assert found == pytest.approx(float(nearby), rel=1e-8)
    assert loss(1.6, 0.5) != loss(1.6, 0.4) or kind is not dx.Impact


@pytest.mark.soak
def test_what_is_assigned_later_in_another_place_does_not_matter():
    """The function that stands for both holds the values of its closure."""

    def study():
        found = []
        for k in (1.0, 2.0):
            found.append(end(dx.LagrangeDirac(lambda q, v: v @ v / 2 - k * q @ q / 2), engine="xla"))  # noqa: B023
        return found

    first, again = study(), study()
    assert np.array_equal(first, again) and not np.allclose(*first)
    pull = {"at": np.array([0.3, 0.0])}
    one, other = spring(1.0, pull), spring(1.0, {"at": np.array([0.3, 0.0])})
    before = end(one)
    pull["at"][0] = 5.0
    assert np.array_equal(end(other, engine="xla"), end(other, engine="native")) and np.array_equal(end(other), before)
    with pytest.raises(ValueError, match=r"reads .*pull"):
        end(one)
    assert not np.allclose(end(spring(1.0, pull)), before)


@pytest.mark.soak
def test_values_that_are_traced_are_those_of_their_own_call():
    loss = lambda k: jnp.sum(end(spring(k)))
    for k in (1.0, 2.0):
        nearby = (loss(k + 1e-5) - loss(k - 1e-5)) / 2e-5
        assert float(jax.grad(loss)(k)) == pytest.approx(float(nearby), rel=1e-8) == float(jax.jit(jax.grad(loss))(k))


def test_functions_that_keep_a_record_stay_apart():
    def counted(record):
        def lagrangian(q, v):
            record.append(len(q))
            return v @ v / 2 - q @ q / 2

        return dx.LagrangeDirac(lagrangian)

    one, other = [], []
    assert counted(one) != counted(other)
    end(counted(one)), end(counted(other))
    assert one and other


def test_only_what_is_the_same_object_is_equal_of_objects_that_are_not_known():
    class Field:
        def __init__(self, k):
            self.k = k

    a, b = Field(1.0), Field(1.0)
    system = lambda of: dx.LagrangeDirac(lambda q, v: v @ v / 2 - of.k * q @ q / 2)
    assert system(a) == system(a) and system(a) != system(b)
    before = system(a)
    a.k = 2.0
    assert system(a) != before and np.allclose(end(system(a)), end(system(Field(2.0))))


def test_a_function_that_calls_itself_and_one_that_is_not_ready_are_taken_as_they_are():
    def make(power):
        def product(x, n):
            return x if n == 1 else x * product(x, n - 1)

        return dx.LagrangeDirac(lambda q, v: v @ v / 2 - product(q[0], power) / power)

    assert np.array_equal(end(make(4)), end(make(4))) and not np.allclose(end(make(4)), end(make(2)))

    def early():
        function = lambda q, v: v @ v / 2 - later * q @ q / 2
        with pytest.raises(TypeError, match="later"):
            end(dx.LagrangeDirac(function))
        later = 1.0
        return end(dx.LagrangeDirac(function))

    assert np.array_equal(early(), end(spring(1.0)))


def with_default(q, v, k=np.array([2.0, 1.0])):
    return v @ v / 2 - k @ q**2 / 2


def test_functions_of_modules_stand_for_themselves_and_are_sent_by_name():
    system = dx.LagrangeDirac(with_default)
    assert system.lagrangian.function is with_default
    run = dx.prepare(system, MIDPOINT, **RUN)
    assert np.array_equal(pickle.loads(pickle.dumps(run))().q, run().q)
