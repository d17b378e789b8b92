"""User functions: with or without params, named in errors; more of their errors in test_bad_input.py."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.program.user_functions import UserFunction, check_finite, is_traced

Q = jnp.array([1.0, 2.0])


def named(q, v, params):
    return params * (q @ v)


class Callable:
    def __call__(self, q, v):
        return q @ v


class Learned(eqx.Module):
    """Holds an array, so it has no hash."""

    weight: jax.Array

    def __call__(self, q, v):
        return self.weight * (q @ v)


@pytest.mark.parametrize(
    "function, takes_params, value",
    [
        (lambda q, v: q @ v, False, 5.0),
        (lambda q, v, params: params * (q @ v), True, 15.0),
        (lambda q, v, whatever: whatever * (q @ v), True, 15.0),  # the last of three required ones is params
        (lambda q, v, params=2.0: params * (q @ v), True, 15.0),
        (lambda q, v, scale=2.0: scale * (q @ v), False, 10.0),  # an option of the user's own, not params
        (lambda *all: all[0] @ all[1], False, 5.0),
        (functools.partial(lambda k, q, v: k * (q @ v), 4.0), False, 20.0),
        (named, True, 15.0),
        (Callable(), False, 5.0),
        (Learned(jnp.array(7.0)), False, 35.0),
        (jax.jit(lambda q, v: q @ v), False, 5.0),
        (jnp.dot, False, 5.0),
    ],
)
def test_params_are_passed_to_those_who_take_them(function, takes_params, value):
    wrapped = UserFunction(function, "lagrangian", ("q", "v"))
    assert wrapped.takes_params is takes_params
    assert wrapped(Q, Q, 3.0) == value
    assert wrapped.shape(Q, Q, 3.0).shape == ()
    hash(wrapped)


def test_equal_functions_are_equal():
    """So that compiled code is reused when a system is made again from the same functions."""
    one, other = (UserFunction(named, "lagrangian", ("q", "v")) for _ in range(2))
    assert one == other and hash(one) == hash(other)
    assert one != UserFunction(named, "hamiltonian", ("q", "v"))


def test_it_shows_the_users_own_name():
    assert repr(UserFunction(named, "lagrangian", ("q", "v"))) == "named(q, v, params)"
    assert repr(UserFunction(lambda q, v: 0.0, "lagrangian", ("q", "v"))) == "lambda(q, v)"
    assert repr(UserFunction(Callable(), "lagrangian", ("q", "v"))) == "Callable(q, v)"


def test_indices_are_checked_inside_control_flow_and_not_refused_when_right():
    wrap = lambda f: UserFunction(f, "potential", ("q",))
    last = wrap(lambda q: jax.lax.cond(q[0] > 0, lambda: q[-1], lambda: q[jnp.array([1, 0])].sum()))
    assert last.shape(Q, None).shape == ()
    loop = wrap(lambda q: jax.lax.fori_loop(0, 3, lambda i, s: s + q[i], 0.0))
    with pytest.raises(ValueError, match=r"potential\(q\) reads an entry .* \(2,\).*out-of-bounds"):
        loop.shape(Q, None)
    assert wrap(lambda q: jax.lax.fori_loop(0, 2, lambda i, s: s + q[i], 0.0)).shape(Q, None).shape == ()


def test_shapes_can_be_had_inside_transformations():
    function = UserFunction(lambda q: q * q[1], "field", ("q",))
    shapes = []
    jax.jit(lambda q: shapes.append(function.shape(q, None).shape))(Q)
    assert shapes == [(2,)]


def test_returning_checks_the_shape_where_it_is_called():
    checked = UserFunction(lambda q: q, "field", ("q",)).returning((2,))
    np.testing.assert_array_equal(jax.jit(checked)(Q, None), Q)
    with pytest.raises(ValueError, match=r"field\(q\) must return an array of shape \(2,\), but it returned shape \(3,\)"):
        checked(jnp.ones(3), None)


def test_what_jax_does_not_differentiate_is_named():
    scaled = UserFunction(lambda q: jnp.ones(2).at[np.array([0, 1])].multiply(q), "field", ("q",))
    np.testing.assert_array_equal(scaled(Q, None), Q)
    with pytest.raises(
        TypeError, match=r"^field\(q\) cannot be differentiated or batched by JAX, .* \(scatter_mul gradients .*jax\.custom_jvp"
    ):
        jax.jacfwd(scaled)(Q, None)


def test_finite_values_pass_and_traced_ones_are_not_looked_at():
    check_finite("params", {"a": [1, 2.0, np.ones(3)], "b": None, "c": "text", "d": jnp.arange(2)})
    jax.jit(lambda x: check_finite("x", x))(jnp.nan)


def test_tracers_are_recognized_anywhere_in_a_tree():
    assert not is_traced({"a": (1.0, Q)}, None)
    assert jax.jit(lambda x: is_traced({"a": (1.0, [x])}))(Q).item() is True


@pytest.mark.parametrize(
    "function, arguments, timed, word, place",
    [
        (lambda q, v, params: -params * v, ("t", "q", "v"), False, "q", "t"),  # no t
        (lambda q, v, t: v, ("t", "q", "v"), False, "q", "t"),
        (lambda t, v, q: v, ("t", "q", "v"), False, "v", "q"),
        (lambda v, q: v @ q, ("q", "v"), True, "v", "q"),
        (lambda q, p: p @ p, ("q", "v"), True, "p", "v"),
        (lambda q, v: v @ v, ("q", "p"), True, "v", "p"),
        (lambda q, t: q, ("q",), True, "t", "params"),
        (lambda q, v, t=0.0: v @ v, ("q", "v"), True, "t", "params"),  # it would always be 0.0
        (lambda x, t: x @ x, ("x",), False, "t", "params"),
        (lambda params, x: x @ x, ("x",), False, "params", "x"),
        (lambda h, q0, q1: h, ("q0", "q1", "h"), True, "h", "q0"),
        (functools.partial(lambda k, v, q: k * v, 4.0), ("q", "v"), True, "v", "q"),
    ],
)
def test_names_of_the_interface_in_other_places_are_refused(function, arguments, timed, word, place):
    with pytest.raises(TypeError, match=rf"must have the signature force\(.* where {word} stands in the place of {place}: put"):
        UserFunction(function, "force", arguments, timed)


def keyword_params(q, v, *, params=None):
    return v @ v


AT = np.array([0, 7])
MEANT = {
    "clip": lambda q: q.at[AT].get(mode="clip"),
    "taken": lambda q: jnp.take(q, AT, mode="clip"),
    "one": lambda q: q.at[jnp.floor(q[0]).astype(int) + 5].get(mode="clip"),
    "fill": lambda q: q.at[AT].get(mode="fill", fill_value=0.0),
    "slice": lambda q: jax.lax.dynamic_slice(q, (jnp.floor(q[0]).astype(int) + 5,), (2,)),
}


@pytest.mark.parametrize("name", MEANT)
@pytest.mark.soak_of("clip")
def test_indices_may_be_outside_where_it_is_said_what_is_read_there(name):
    q = jnp.array([0.5, 1.5, 2.5])
    assert UserFunction(MEANT[name], "force", ("q",)).shape(q, None).dtype == float
    both = UserFunction(lambda q: jnp.sum(MEANT[name](q)) + q[jnp.floor(q[0]).astype(int) + 5], "force", ("q",))
    for function in (both, UserFunction(lambda q: jnp.take(q, AT), "force", ("q",))):
        with pytest.raises(ValueError, match=r"reads an entry .*out.of.bounds"):
            function.shape(q, None)


def keyword_time(q, v, *, t=0.0):
    return v @ v


def keyword_velocity(q, *, v):
    return v @ v


def test_an_argument_that_is_needed_and_taken_by_keyword_alone():
    with pytest.raises(TypeError, match=r"v by keyword alone: all are given by place, so take the \* before v away"):
        UserFunction(keyword_velocity, "lagrangian", ("q", "v"), True)


@pytest.mark.parametrize(("function", "word"), [(keyword_params, "params"), (keyword_time, "t")])
def test_what_is_taken_by_keyword_alone_would_never_be_given(function, word):
    with pytest.raises(TypeError, match=rf"takes {word} by keyword alone, so that it would never be given: take the \* before"):
        UserFunction(function, "force", ("q", "v"), True)
    UserFunction(functools.partial(function, **{word: 1.0}), "force", ("q", "v"), True)  # bound by the user


@pytest.mark.parametrize(
    "function, arguments, timed",
    [
        (lambda t, q, v, p: p * v, ("t", "q", "v"), False),  # params of another name
        (lambda q, v, x: x * v, ("q", "v"), True),
        (lambda t, q, v, k: k * v, ("q", "v"), True),
        (lambda a, b: b @ b, ("q", "v"), True),
        (lambda x: x @ x, ("q",), True),
        (lambda q: q @ q, ("x",), False),
        (lambda x0, x1, h: h, ("q0", "q1", "h"), True),
        (lambda q, v, p=2.0: p * v, ("q", "v"), True),  # an option of the user's own
    ],
)
def test_other_names_are_free(function, arguments, timed):
    UserFunction(function, "force", arguments, timed)


def test_forces_without_the_time_are_no_longer_forces_of_other_arguments():
    with pytest.raises(TypeError, match=r"forces\(t, q, v\[, params\]\).*<lambda> takes \(q, v, params\)"):
        dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2, forces=lambda q, v, params: -params * v)
