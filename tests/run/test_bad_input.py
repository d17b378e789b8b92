"""Bad input gets one or two sentences that name the argument, what came, what was expected and the way out; nothing is lost."""

import dataclasses
import os
import re
import signal
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

OSCILLATOR = dx.LagrangeDirac(lambda q, v: (v @ v - q @ q) / 2)
SKATE = dx.LagrangeDirac(
    lambda q, v: v @ v / 2, lambda q: jnp.array([[jnp.sin(q[2]), -jnp.cos(q[2]), 0.0]])
)  # q = (x, y, direction)
PLUS = dx.PlusLagrangeDirac()
GOOD = {"q": [1.0, 0.0], "v": [0.0, 1.0], "step": 0.1, "steps": 3}


def complaint(kind, *words, system=OSCILLATOR, scheme=PLUS, **arguments) -> str:
    """The message of the error that a run with these arguments raises; every one of `words` must be in it."""
    return complaint_of(lambda: dx.simulate(system, scheme, **(GOOD | arguments)), kind, *words)


def complaint_of(action, kind, *words) -> str:
    with pytest.raises(kind) as caught:
        action()
    assert caught.type is kind
    text = str(caught.value)
    missing = [word for word in words if word not in text]
    assert not missing, f"{missing} not in: {text}"
    assert "\n" not in text and text.endswith((".", "?")) and len(text) < 600
    assert len(re.findall(r"[.?](?: |$)", re.sub(r"\S*\d\.\s|\[[^]]*\]", "", text))) <= 2, f"more than two sentences: {text}"
    return text


# ------------------------------------------------------------------------------------------ shapes, dtypes and arities


def test_shapes_of_initial_data():
    complaint(ValueError, "q must have shape (n,), or (B, n)", "(2, 2, 1)", q=np.zeros((2, 2, 1)), v=np.zeros((2, 2, 1)))
    complaint(ValueError, "q must have shape (n,)", "shape is ()", q=1.0)
    complaint(ValueError, "q must have shape", "(0,)", q=[], v=[])
    complaint(ValueError, "q and v must have the same length n", "(2,)", "(3,)", v=[0.0, 1.0, 2.0])
    complaint(
        ValueError, "q and v must hold the same number of trajectories", "(3, 2)", "(4, 2)", q=np.ones((3, 2)), v=np.ones((4, 2))
    )
    complaint(ValueError, "q must be an array of numbers", q=[[1.0], [1.0, 2.0]])


def test_combinations_of_initial_data():
    choices = "one of q=, v= · q=, p= · q0=, q1= · x="
    complaint(ValueError, choices, "q= alone was given", v=None)
    complaint(ValueError, choices, "p=, q=, v= was given", p=[0.0, 0.0])
    complaint(ValueError, choices, "none was given", q=None, v=None)
    complaint(ValueError, "starts from q=, v= · q=, p= · q0=, q1=", "x= was given", q=None, v=None, x=[0.0, 1.0])
    composition = dx.Composition(dx.LagrangeDAlembert(), "yoshida4")
    complaint(
        ValueError, "composition", "q0= and q1=", "give q= with v= or p=",
        scheme=composition, q=None, v=None, q0=[0.0], q1=[0.1],
    )  # fmt: skip


def test_dtypes_of_initial_data():
    complaint(TypeError, "q must hold real numbers", "complex128", q=[1j, 0.0])
    complaint(TypeError, "v must hold real numbers", "bool", v=[True, False])
    complaint(TypeError, "q must hold real numbers", "<U1", q=["a", "b"])


def test_numbers_that_are_none():
    """NumPy takes a masked number for what lies under it, and seconds for whole numbers."""
    masked = np.ma.array([5.0, 0.0], mask=[True, False])
    complaint(ValueError, "q has no number at [0]", "masked", "filled", q=masked)
    complaint(ValueError, "params has no number at [0]", params=masked)
    assert dx.simulate(OSCILLATOR, PLUS, **(GOOD | {"q": np.ma.array([1.0, 0.0])})).ok
    seconds = np.array([1, 2], "timedelta64[s]")
    complaint(TypeError, "q must hold real numbers", "timedelta64[s]", q=seconds)
    complaint(TypeError, "params must be a pytree of numbers", "timedelta64[s]", params=seconds)
    complaint(ValueError, "step must be a positive finite number", "timedelta64", step=seconds[0])


def test_numbers_too_large_for_a_float():
    complaint(ValueError, "step must be a positive finite number", "1329 bits", step=10**400)
    complaint(ValueError, "t0 must be a finite number", "1329 bits", t0=10**400)
    complaint(ValueError, "steps must be a whole number ≥ 1", "16610 bits", steps=-(10**5000))


def test_dictionaries_of_params_without_an_order():
    complaint(TypeError, "params has a dictionary with the keys 1, 'k'", "by texts", params=[{"a": {1: 1.0, "k": 1.0}}])


def test_shapes_of_user_functions():
    vector = dx.LagrangeDirac(lambda q, v: v * v)
    complaint(ValueError, "lagrangian(q, v) must return a scalar", "shape (2,)", "sum or index", system=vector)
    row = dx.LagrangeDirac(lambda q, v: v @ v / 2, lambda q: jnp.ones(2))
    complaint(ValueError, "one_forms(q) must return", "(m, n) = (m, 2)", "shape (2,)", "pair of brackets", system=row)
    wide = dx.LagrangeDirac(lambda q, v: v @ v / 2, lambda q: jnp.ones((1, 3)))
    complaint(ValueError, "(m, n) = (m, 2) with m ≤ 2", "shape (1, 3)", system=wide)
    many = dx.LagrangeDirac(lambda q, v: v @ v / 2, lambda q: jnp.ones((3, 2)))
    complaint(ValueError, "m ≤ 2", "shape (3, 2)", system=many)
    pair = dx.LagrangeDirac(lambda q, v: (v @ v, q @ q))
    complaint(TypeError, "lagrangian(q, v) must return one array", "returned tuple", system=pair)
    nothing = dx.LagrangeDirac(lambda q, v: None)
    complaint(TypeError, "lagrangian(q, v) must return one array", "NoneType", system=nothing)


def test_dtypes_of_user_functions():
    whole = dx.LagrangeDirac(lambda q, v: 0)
    complaint(TypeError, "lagrangian(q, v)", "float64", "int64", ".astype(float)", system=whole)
    single = dx.LagrangeDirac(lambda q, v: (v @ v).astype(jnp.float32))
    complaint(TypeError, "lagrangian(q, v)", "float64", "float32", system=single)
    integer = dx.LagrangeDirac(lambda q, v: v @ v / 2, lambda q: jnp.array([[0, 1]]))
    complaint(TypeError, "one_forms(q)", "float64", "int64", ".astype(float)", system=integer)


def test_user_functions_that_do_not_trace():
    numpy = dx.LagrangeDirac(lambda q, v: np.sum(np.array(v)))
    complaint(TypeError, "lagrangian(q, v) could not be traced", "(2,), (2,)", "jax.numpy instead of numpy", system=numpy)
    branch = dx.LagrangeDirac(lambda q, v: v @ v if q[0] > 0 else q @ q)
    complaint(TypeError, "lagrangian(q, v) could not be traced", "jnp.where", system=branch)
    unpack = dx.LagrangeDirac(lambda q, v: sum((lambda a, b, c: (a, b, c))(*q)))
    complaint(TypeError, "lagrangian(q, v) could not be traced", "1 required positional argument", system=unpack)


def test_an_index_outside_the_data_is_not_clamped():
    """JAX clamps it silently, so that a coordinate that was forgotten would become another one."""
    three = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[2])
    complaint(ValueError, "lagrangian(q, v) reads an entry", "(2,), (2,)", "index 2 is out of bounds", system=three)
    listed = dx.LagrangeDirac(lambda q, v: jnp.sum(v[jnp.array([0, 5])] ** 2))
    complaint(ValueError, "lagrangian(q, v) reads an entry", "index 5", system=listed)
    form = dx.LagrangeDirac(lambda q, v: v @ v / 2, lambda q: jnp.stack([jnp.stack([q[7], q[0]])]))
    complaint(ValueError, "one_forms(q) reads an entry", "index 7", system=form)


def test_arities_of_user_functions():
    take = "must have the signature lagrangian(q, v[, params])"
    complaint_of(lambda: dx.LagrangeDirac(lambda q: q @ q), TypeError, take, "1 argument (q)")
    complaint_of(lambda: dx.LagrangeDirac(lambda q, v, a, b: 0.0), TypeError, take, "4 arguments (q, v, a, b)")
    complaint_of(lambda: dx.LagrangeDirac(lambda q, v, *, m: 0.0), TypeError, take, "3 arguments (q, v, m)")
    complaint_of(lambda: dx.LagrangeDirac(3.0), TypeError, "a function lagrangian(q, v[, params])", "3.0", "lambda")
    complaint_of(lambda: dx.LagrangeDirac(lambda q, v: 0.0, jnp.eye(2)), TypeError, "one_forms(q[, params])", "float64[2, 2]")
    complaint_of(lambda: dx.LagrangeDirac(lambda q, v: 0.0, lambda: 0), TypeError, "one_forms(q[, params])", "none")
    complaint_of(lambda: dx.PlusLagrangeDirac(lambda q0, q1: 0.0), TypeError, "discrete_lagrangian(q0, q1, h[, params])", "2 arg")
    complaint_of(lambda: dx.LagrangeDAlembert("left", lambda q: q), TypeError, "constraint(q0, q1, h[, params])", "1 argument")


def test_user_given_discrete_functions_of_wrong_shape():
    complaint(
        ValueError, "discrete_lagrangian(q0, q1, h) must return a scalar", "shape (2,)", "sum or index",
        scheme=dx.PlusLagrangeDirac(lambda q0, q1, h: q1 - q0),
    )  # fmt: skip
    complaint(
        ValueError, "constraint(q0, q1, h) must return an array of shape (1,)", "shape ()",
        system=SKATE, scheme=dx.LagrangeDAlembert("left", lambda q0, q1, h: q1[0] - q0[0]), q=[0.0] * 3, v=[1.0, 0.0, 0.0],
    )  # fmt: skip
    complaint(
        ValueError, "constraint is a function w_d", "no one_forms",
        scheme=dx.LagrangeDAlembert("left", lambda q0, q1, h: q1 - q0),
    )  # fmt: skip


def test_params():
    massive = dx.LagrangeDirac(lambda q, v, params: params["m"] * v @ v / 2)
    complaint(TypeError, "params=None", "pass params=", system=massive)
    complaint(TypeError, "params must be a pytree of numbers", "params['m'] is 'heavy'", system=massive, params={"m": "heavy"})
    complaint(TypeError, "params['m'] is a key of JAX: pass jax.random.key_data", params={"m": jax.random.key(0)}, system=massive)
    batch = "with batch_params=True every leaf of params needs the same leading batch axis"
    complaint(ValueError, batch, "(2,), (3,)", params=[np.ones(2), np.ones(3)], batch_params=True)
    complaint(ValueError, batch, "()", params=1.0, batch_params=True)
    complaint(ValueError, batch, "no leaves", batch_params=True)
    complaint(
        ValueError, "initial data are a batch of 3", "params a batch of 2", "equal",
        q=np.ones((3, 2)), v=np.ones((3, 2)), params=np.ones(2), batch_params=True,
    )  # fmt: skip


def test_systems_schemes_and_engines():
    complaint(TypeError, "system must be a dirax system such as dx.LagrangeDirac(…)", "'disk'", system="disk")
    complaint(
        TypeError,
        "scheme must be a dirax scheme",
        "the class PlusLagrangeDirac itself",
        "parentheses",
        scheme=dx.PlusLagrangeDirac,
    )
    complaint(ValueError, "engine must be one of 'auto', 'xla'", "'fortran'", engine="fortran")
    complaint(TypeError, "inputs=", "dx.PortHamiltonian", "LagrangeDirac", inputs=lambda t, x: x)
    rule = "discrete_lagrangian must be one of 'left', 'right', 'midpoint', 'trapezoidal' or a function of (q0, q1, h[, params])"
    complaint_of(lambda: dx.PlusLagrangeDirac("simpson"), ValueError, rule, "'simpson'")
    complaint_of(
        lambda: dx.LagrangeDAlembert("left", "trapezoidal"), ValueError, "constraint must be one of 'left', 'right', 'mid"
    )
    complaint_of(lambda: dx.LagrangeDAlembert(momentum="both"), ValueError, "momentum must be one of", "'outgoing'", "'both'")


def test_a_scheme_that_does_not_fit_the_system():
    structure = dx.DiracStructure.from_bivector(lambda x: jnp.array([[0.0, 1.0], [-1.0, 0.0]]))
    system = dx.DiracSystem(structure, lambda x: x @ x / 2)
    complaint(TypeError, "dx.LagrangeDirac", "DiracSystem", "use dx.DiscreteDirac", system=system, q=None, v=None, x=[1.0, 0.0])


# ----------------------------------------------------------------------------------------------------- values of numbers


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite(bad):
    complaint(ValueError, "q must be finite", f"q[1] is {bad}", q=[1.0, bad])
    complaint(ValueError, "v must be finite", f"v[1, 0] is {bad}", q=np.ones((3, 2)), v=[[1.0, 0.0], [bad, 0.0], [0.0, 0.0]])
    complaint(ValueError, "p must be finite", f"p[0] is {bad}", p=[bad, 0.0], v=None)
    complaint(ValueError, "q1 must be finite", f"q1[0] is {bad}", q=None, v=None, q0=[0.0], q1=[bad])
    complaint(ValueError, "params must be finite", f"params['m'][1] is {bad}", params={"m": [1.0, np.array(bad)]})
    complaint(ValueError, "step must be a positive finite number", str(bad), step=bad)
    complaint(ValueError, "t0 must be a finite number", str(bad), t0=bad)


@pytest.mark.parametrize("bad", [0, -0.1, "0.1", True, np.ones(2)])
def test_steps_sizes(bad):
    complaint(ValueError, "step must be a positive finite number", f"{bad!r} was given", step=bad)
    complaint(ValueError, "one of step= and tolerance= must be given", "none was", step=None)


@pytest.mark.parametrize(("name", "most"), [("steps", 2**63 - 1), ("save_every", 2**63 - 1), ("max_iterations", 10**6)])
def test_counts_beyond_what_is_counted(name, most):
    for value in (most + 1, 2**64, 2**80):
        complaint(ValueError, f"{name} must be at most", **{name: value})


@pytest.mark.parametrize("engine", ["native", pytest.param("xla", marks=pytest.mark.soak)])
@pytest.mark.soak
def test_largest_counts(engine):
    """Rows 0 and 3 alone are saved; the derivative takes as long as the run does."""
    run = lambda q, **more: dx.simulate(OSCILLATOR, PLUS, **(GOOD | {"q": q, "engine": engine, "save_every": 2**63 - 1} | more))
    sol, whole = run([1.0, 0.0], max_iterations=10**6), run([1.0, 0.0], save_every=1)
    np.testing.assert_array_equal(sol.q, whole.q[[0, 3]])
    np.testing.assert_array_equal(sol.t, whole.t[[0, 3]])
    slope = jax.grad(lambda q: run(q).q[-1, 0])(jnp.array([1.0, 0.0]))
    np.testing.assert_allclose(slope, jax.grad(lambda q: run(q, save_every=1).q[-1, 0])(jnp.array([1.0, 0.0])), rtol=1e-14)


def test_times_that_a_step_does_not_change():
    complaint(ValueError, "1e+20", "a step of 0.1 is lost", t0=1e20)
    complaint(ValueError, "9.0072e+15", "a step of 1 is lost", t0=2.0**53 - 5, step=1.0, steps=20)
    complaint(ValueError, "9.0072e+15", "a step of 1 is lost", t0=-(2.0**53) - 5, step=1.0, steps=20)
    complaint(ValueError, "end at t = t0 + steps·step = inf", step=1e308)
    assert dx.simulate(OSCILLATOR, PLUS, **(GOOD | {"t0": 2.0**52, "step": 1.0})).ok


def test_a_step_that_underflows():
    complaint(ValueError, "step must be at least 2.23e-308", "unit of time", step=5e-324)


@pytest.mark.parametrize("name", ["steps", "save_every", "max_iterations"])
@pytest.mark.parametrize("bad", [0, -3, 2.0, "2", True])
def test_counts(name, bad):
    complaint(ValueError, f"{name} must be a whole number ≥ 1", f"{bad!r} was given", **{name: bad})


def test_functions_that_are_not_finite_at_the_initial_data():
    pole = dx.LagrangeDirac(lambda q, v: v @ v / 2 + 1 / jnp.linalg.norm(q))
    complaint(ValueError, "lagrangian is inf at the initial data", "outside its domain", system=pole, q=[0.0, 0.0])
    complaint(ValueError, "lagrangian is inf", "of trajectory 1", system=pole, q=[[1.0, 0.0], [0.0, 0.0]])
    half = dx.LagrangeDirac(lambda q, v: v @ v / 2 - jnp.log(q[0]))  # its derivative is finite for q < 0
    complaint(ValueError, "lagrangian is nan at the initial data", system=half, q=[-1.0, 0.0])
    complaint(ValueError, "lagrangian is nan", system=half, q=None, v=None, q0=[-1.0], q1=[-0.9])
    corner = dx.LagrangeDirac(lambda q, v: v @ v / 2 - jnp.sqrt(q[0]))
    text = complaint(ValueError, "not finite at the initial data", "outside the domain", system=corner, q=[0.0, 0.0])
    assert "discrete Lagrange–d'Alembert equation 0" in text
    form = dx.LagrangeDirac(lambda q, v: v @ v / 2, lambda q: jnp.stack([jnp.sqrt(q)]))
    complaint(ValueError, "one_forms is not finite at the initial data", "outside its domain", system=form, q=[-1.0, 1.0])


# -------------------------------------------------------------------------------------------- constraints and solvability


def test_initial_data_off_the_constraint():
    skid = {"system": SKATE, "q": [0.0, 0.0, 0.0], "v": [1.0, 0.25, 0.0]}
    complaint(ValueError, "off the constraint", "[-0.25]", "largest 0.25", "project=True", "check_initial=False", **skid)
    complaint(ValueError, "off the constraint", "[-0.25]", **(skid | {"v": None, "p": skid["v"]}))
    batch = {"q": np.zeros((3, 3)), "v": [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.5, 0.0]]}
    complaint(ValueError, "of trajectory 2 are off the constraint", "[-0.5]", **(skid | batch))
    points = {"q": None, "v": None, "q0": [0.0, 0.0, 0.0], "q1": [0.1, 0.025, 0.0]}
    complaint(ValueError, "off the constraint", "[-0.25]", "choose q1 on the discrete constraint", **(skid | points))


def test_both_ways_out_of_data_off_the_constraint():
    q, v = [0.0, 0.0, 0.0], [1.0, 0.25, 0.0]
    projected = dx.simulate(SKATE, PLUS, q=q, v=v, step=0.1, steps=3, project=True)
    np.testing.assert_allclose(projected.q[-1], [0.3, 0.0, 0.0], atol=1e-15)
    accepted = dx.simulate(SKATE, PLUS, q=q, v=v, step=0.1, steps=3, check_initial=False)
    np.testing.assert_array_equal(accepted.p[0], v)


def test_dependent_one_forms():
    """Those that follow from the others are reported (tests/systems/test_holonomic.py); these have no such meaning."""
    crossing = dx.LagrangeDirac(
        lambda q, v: v @ v / 2, lambda q: jnp.stack([jnp.array([1.0, 0.0]), jnp.stack([1.0 + 0 * q[0], q[1]])])
    )
    words = ("dependent at the initial data", "rank 1 of 2", "rank 2 nearby", "singular configuration")
    complaint(ValueError, *words, system=crossing, q=[0.0] * 2, v=[0.0, 1.0])
    sometimes = dx.LagrangeDirac(lambda q, v: v @ v / 2, lambda q: jnp.stack([jnp.stack([q[0], q[1], q[0]])]))
    batch = {"q": [[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], "v": np.zeros((2, 3))}
    complaint(ValueError, "constraint 0", "no direction", "of trajectory 1", system=sometimes, **batch)


@pytest.mark.soak
def test_a_lagrangian_singular_together_with_its_constraints():
    """[PY] (21): q1 occurs neither in L's velocities nor in the constraint."""
    loose = dx.LagrangeDirac(lambda q, v: v[0] ** 2 / 2 - q[1] * q[0])
    complaint(ValueError, "no unique solution", "(21)", "rank 1 of 2", "[0. 1.]", "singular together with", system=loose)
    held = dx.LagrangeDirac(lambda q, v: v[0] ** 2 / 2, lambda q: jnp.array([[1.0, 0.0, 0.0]]))
    words = ("rank 2 of 4", "remove the coordinates that it does not determine")
    complaint(ValueError, *words, system=held, q=[0.0] * 3, v=[0.0, 1.0, 0.0])
    bound = dx.LagrangeDirac(lambda q, v: v[0] ** 2 / 2, lambda q: jnp.array([[0.0, 1.0]]))
    assert dx.simulate(bound, PLUS, q=[0.0, 1.0], v=[1.0, 0.0], step=0.1, steps=2).ok  # the constraint makes it regular


@pytest.mark.soak
def test_a_projection_that_a_singular_lagrangian_does_not_determine():
    """q2 = q0 whatever the motion, which Method 1 finds; the velocity that belongs to p on the circle is not determined."""
    rod = dx.LagrangeDirac(
        lambda q, v: (v[0] ** 2 + v[1] ** 2) / 2 - q[1] - q[2] ** 2 / 2 + q[2] * q[0],
        holonomic=lambda q: jnp.array([(q[0] ** 2 + q[1] ** 2 - 1) / 2]),
    )
    start = {"q": [0.6, -0.8, 0.6], "v": [0.4, 0.3, 0.4], "step": 0.01, "steps": 3}
    with pytest.raises(
        ValueError, match=r"rank 7 of 8.*this scheme saves.*take dx\.DiscreteDirac\(\), which projects nothing\.$"
    ):
        dx.simulate(rod, dx.LagrangeDAlembert(), **start)
    solution = dx.simulate(rod, dx.DiscreteDirac(), **start)
    assert solution.ok and solution.q[1:, 2] + solution.q[:-1, 2] == pytest.approx(solution.q[1:, 0] + solution.q[:-1, 0])


def test_singular_only_in_one_trajectory_of_a_batch():
    stiff = dx.LagrangeDirac(lambda q, v, params: v[0] ** 2 / 2 + params * v[1] ** 2 / 2)
    batch = {"q": np.zeros((3, 2)), "v": np.ones((3, 2)), "params": np.array([1.0, 1.0, 0.0]), "batch_params": True}
    complaint(ValueError, "rank 1 of 2", "of trajectory 2", system=stiff, **batch)


def test_small_units_are_not_singular():
    """Masses of 1e-30 and 1e30 together are regular."""
    odd = dx.LagrangeDirac(lambda q, v: (1e-30 * v[0] ** 2 + 1e30 * v[1] ** 2) / 2)
    sol = dx.simulate(odd, PLUS, q=[0.0, 0.0], v=[1.0, 2.0], step=0.5, steps=4)
    np.testing.assert_allclose(sol.q[-1], [2.0, 4.0], rtol=1e-14)


# ------------------------------------------------------------------------------------------------------------- in the run

HALF_LINE = dx.LagrangeDirac(lambda q, v: v @ v / 2 - jnp.log(q[0]))
"""q̈ = −1/q falls into q = 0, beyond which L is not defined, although its derivatives are."""


def explicit_half_line(q, v, h, steps):
    """The left rule written out: p_{k+1} = p_k − h/q_k, q_{k+1} = q_k + h p_{k+1}, as long as q is positive."""
    rows, p = [], v
    while q > 0 and len(rows) <= steps:
        rows.append(q)
        p = p - h / q
        q = q + h * p
    return np.array(rows)


@pytest.mark.parametrize("engine", ["xla", "native"])
@pytest.mark.soak_of("xla")
def test_leaving_the_domain_keeps_what_was_computed(engine):
    rows = explicit_half_line(1.0, 0.0, 0.01, 1000)
    last = len(rows) - 1
    assert 50 < last < 200
    sol = dx.simulate(HALF_LINE, PLUS, q=[1.0], v=[0.0], step=0.01, steps=1000, t0=2.0, engine=engine)
    assert sol.ok is False
    np.testing.assert_allclose(sol.q[:, 0], rows, rtol=1e-10)
    assert len(sol.t) == len(sol.q) == len(sol.p) == last + 1
    assert sol.t[-1] == pytest.approx(2.0 + 0.01 * last)
    time = f"{2.0 + 0.01 * last:.6g}"
    assert sol.message.startswith(f"step {last + 1} (from t = {time}) failed: ")
    assert "domain of the system's functions" in sol.message
    assert sol.message.endswith(f"kept up to step {last} (t = {time}).")


def test_the_last_good_step_is_kept_between_saved_rows():
    every = explicit_half_line(1.0, 0.0, 0.01, 1000)
    sol = dx.simulate(HALF_LINE, PLUS, q=[1.0], v=[0.0], step=0.01, steps=1000, save_every=64)
    last = len(every) - 1
    assert last % 64
    np.testing.assert_allclose(sol.q[:, 0], np.append(every[:last:64], every[last]), rtol=1e-10)
    np.testing.assert_allclose(sol.t, 0.01 * np.append(np.arange(0, last, 64), last))


def test_the_rest_of_a_batch_goes_on():
    q, v = np.array([[1.0], [1.0], [0.5]]), np.array([[0.0], [40.0], [0.0]])
    sol = dx.simulate(HALF_LINE, PLUS, q=q, v=v, step=0.01, steps=200)
    assert sol.ok.tolist() == [False, True, False]
    for lane in (0, 2):
        rows = explicit_half_line(q[lane, 0], v[lane, 0], 0.01, 200)
        np.testing.assert_allclose(sol.q[lane, : len(rows), 0], rows, rtol=1e-10)
        assert np.all(np.isnan(sol.q[lane, len(rows) :])) and np.all(np.isnan(sol.p[lane, len(rows) :]))
        assert f"kept up to step {len(rows) - 1} " in sol.message[lane]
    np.testing.assert_allclose(sol.q[1, :, 0], explicit_half_line(1.0, 40.0, 0.01, 200), rtol=1e-12)
    assert sol.message[1] == ""


def test_a_failed_run_inside_a_transformation_is_nan_not_silence():
    def run(v):
        sol = dx.simulate(HALF_LINE, PLUS, q=[0.1], v=jnp.stack([v]), step=0.01, steps=60)
        return sol.q[:, 0], sol.ok

    q, ok = jax.jit(run)(0.0)
    rows = explicit_half_line(0.1, 0.0, 0.01, 60)
    assert not ok and len(rows) < 60
    np.testing.assert_allclose(q[: len(rows)], rows, rtol=1e-9)
    assert np.all(np.isnan(q[len(rows) :]))


def test_newton_that_does_not_converge():
    sol = dx.simulate(OSCILLATOR, dx.PlusLagrangeDirac("midpoint"), q=[1.0], v=[0.0], step=0.1, steps=9, max_iterations=1)
    assert not sol.ok and sol.q.shape == (1, 1)
    assert "step 1 (from t = 0) failed: Newton did not converge in 1 iterations" in sol.message
    assert "condition number 1" in sol.message and "smaller step may help" in sol.message


def test_a_step_without_a_solution_from_rest_is_not_too_small():
    """Back in time by friction: Newton's method stays about the least of a residual that has no root there."""
    block = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2, forces=lambda t, q, v: -0.3 * jnp.tanh(v / 1e-3))
    sol = dx.simulate(block, dx.Composition(dx.LagrangeDAlembert(), "yoshida4"), q=[1.0], v=[0.0], step=0.01, steps=9)
    assert not sol.ok and "a smaller step may help" in sol.message and "too small" not in sol.message


def test_a_run_that_grows_beyond_all_bounds_is_not_told_to_take_larger_steps():
    linear = dx.LagrangeDirac(lambda q, v: jnp.stack([-q[1] - q[1] ** 3 / 15, 0.15 * q[0] ** 2]) @ v - q @ q / 2)
    sol = dx.simulate(linear, dx.PlusLagrangeDirac(), q=[0.8, 0.3], v=[0.0, 0.0], step=0.1, steps=40)
    assert not sol.ok and np.max(np.abs(sol.q)) > 1e30 and "too small" not in sol.message


@pytest.mark.parametrize("scheme", [dx.LagrangeDAlembert(), dx.PlusLagrangeDirac()])
@pytest.mark.soak_of("scheme0")
def test_a_step_that_is_too_small_for_double_precision(scheme):
    """g(q)/h carries ε/h ≈ 2·10⁻⁸ of noise: more of it in a smaller step, which is not what is advised. Method 2 has none."""
    pendulum = dx.LagrangeDirac(lambda q, v: v @ v / 2 - 9.81 * q[1], holonomic=lambda q: jnp.stack([q @ q - 1.0]))
    run = {"q": [0.6, -0.8], "v": [0.8, 0.6], "steps": 20}
    sol = dx.simulate(pendulum, scheme, step=1e-8, **run)
    assert not sol.ok and "too small for double precision" in sol.message and "take a larger step" in sol.message
    assert "smaller step may help" not in sol.message
    assert dx.simulate(pendulum, scheme, step=1e-5, **run).ok
    resolved = dx.simulate(pendulum, dx.DiscreteDirac(constraints="resolve"), step=1e-8, **run)
    assert resolved.ok and np.abs(resolved.multipliers + 4.424).max() < 2e-6  # h λ̇, with λ = (g cos α − 1)/2 at the start


def test_a_step_that_becomes_singular():
    """The mass 1 − q1 of q0 is zero when q1 = k/8 arrives at 1."""
    fading = dx.LagrangeDirac(lambda q, v: (1 - q[1]) * v[0] ** 2 / 2 + v[1] ** 2 / 2)
    sol = dx.simulate(fading, PLUS, q=[0.0, 0.0], v=[0.0, 1.0], step=0.125, steps=20)
    assert not sol.ok
    np.testing.assert_array_equal(sol.q, np.stack([np.zeros(9), np.arange(9) / 8], axis=1))
    assert "step 9 (from t = 1) failed: the Jacobian of the step is singular (condition number inf)" in sol.message
    assert sol.message.endswith("kept up to step 8 (t = 1).")


@pytest.mark.parametrize("engine", ["xla", "native"])
@pytest.mark.parametrize("batch", [False, True])
@pytest.mark.soak_of(but=["True-native"])
def test_ctrl_c_keeps_what_was_computed(batch, engine):
    """The signal itself, sent while the run reports its progress."""
    seen = []

    def stop(done, total):
        seen.append((done, total))
        if len(seen) == 2:
            os.kill(os.getpid(), signal.SIGINT)

    shape = (3, 1) if batch else (1,)
    q, v = np.ones(shape), np.zeros(shape)
    run = {"step": 1e-3, "steps": 10_000_000, "save_every": 5, "progress": stop, "engine": engine}
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell's background job ignores
    try:
        sol = dx.simulate(OSCILLATOR, PLUS, q=q, v=v, **run)
    finally:
        signal.signal(signal.SIGINT, before)
    assert seen[-1][1] == 10_000_000 and 0 < seen[-1][0] < 10_000_000
    assert not np.any(sol.ok)
    message = sol.message[2] if batch else sol.message
    kept = int(re.fullmatch(r"interrupted by the user; kept up to step (\d+) \(t = [\d.]+\)\.", message)[1])
    assert kept >= seen[1][0] // 5 * 5 > 0
    steps = np.unique(np.append(np.arange(0, kept + 1, 5), kept))  # one trajectory ends at its last step, saved or not
    row = sol.q[0, : len(steps), 0] if batch else sol.q[:, 0]
    assert len(row) == len(steps)
    angle = 2 * np.arcsin(1e-3 / 2)  # of the symplectic Euler method, q_k = cos((k + ½) θ)/cos(θ/2) from p_0 = 0
    np.testing.assert_allclose(row, np.cos((steps + 0.5) * angle) / np.cos(angle / 2), atol=1e-9)
    np.testing.assert_allclose(sol.t[: len(steps)], 1e-3 * steps)


# ------------------------------------------------------------------------------------------------------- names and files


def test_unknown_gallery_names():
    gallery = pytest.importorskip("dirax.gallery")
    with pytest.raises(ValueError, match=r"no system 'rolling-disc' in the gallery: did you mean 'rolling-disk'\?"):
        gallery.get("rolling-disc")


def test_unreadable_files(tmp_path):
    """More in test_files.py."""
    (tmp_path / "notes.nc").write_text("not a trajectory")
    complaint_of(lambda: dx.load(tmp_path / "notes.nc"), ValueError, "notes.nc cannot be loaded")
    complaint_of(lambda: dx.load(tmp_path / "nothing.nc"), FileNotFoundError, "there is no file", "check the path")


def test_more_rows_than_memory():
    complaint(ValueError, "rows of this run would take", "GiB", "save_every=", steps=10**13)
    run = GOOD | {"steps": 10**6, "save_every": 10**5}
    assert dx.simulate(OSCILLATOR, PLUS, **run).rows == 11


def test_a_wrong_key_of_params():
    system = dx.LagrangeDirac(lambda q, v, params: params["m"] * v @ v / 2 - params["k"] * q @ q)
    complaint(TypeError, "KeyError: 'k'", "params has the keys 'K', 'm'", system=system, params={"m": 1.0, "K": 2.0})


@pytest.mark.parametrize(
    ("params", "read", "said"),
    [
        ((1.0, 2.0), 3, "params is a tuple of length 2."),
        ([1.0, 2.0], "k", "params is a list of length 2."),
        (np.ones(2), "k", "params is an array of shape (2,)."),
        (3.0, "k", "params is a number."),
    ],
)
def test_an_entry_that_params_do_not_have(params, read, said):
    system = dx.LagrangeDirac(lambda q, v, params: v @ v / 2 - params[read] * q @ q)
    complaint(TypeError, said, system=system, params=params)


def test_other_errors_than_of_entries_say_nothing_of_params():
    system = dx.LagrangeDirac(lambda q, v, params: v @ v / 2 - params[0] * q @ jnp.zeros(5))
    with pytest.raises(TypeError, match="lagrangian") as found:
        dx.simulate(system, PLUS, **GOOD, params=[1.0])
    assert "params" not in str(found.value)


def test_method_2_of_a_singular_lagrangian_needs_its_final_manifold():
    """A coil and three capacitors, with Kirchhoff's laws of two nodes as one-forms ([PY] §7)."""
    circuit = dx.LagrangeDirac(
        lambda q, v: v[0] ** 2 / 2 - (q[1] ** 2 + q[2] ** 2 / 2 + 2 * q[3] ** 2) / 2,
        lambda q: jnp.array([[-1.0, 0.0, 1.0, 1.0], [0.0, 1.0, -1.0, 0.0]]),
    )
    data = {"q": [1.0, 0.2, 0.3, 0.1], "v": np.zeros(4)}
    complaint(
        ValueError, "the Lagrangian is singular", "needs its final manifold", "constraint_algorithm", ".resolved()",
        system=circuit, scheme=dx.DiscreteDirac(constraints="resolve"), **data,
    )  # fmt: skip


@pytest.mark.parametrize("scheme", [dx.DiscreteDirac(constraints="resolve"), dx.EnergyCollocation(2)])
@pytest.mark.soak_of("scheme1")
def test_a_degenerate_two_form_needs_its_final_manifold(scheme):
    form = dx.DiracStructure.from_two_form(lambda x: jnp.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    system = dx.DiracSystem(form, lambda x: x @ x / 2 - x[0] * x[2])
    complaint(
        ValueError, "rank 2 of 3", "needs its final manifold", "constraint_algorithm",
        system=system, scheme=scheme, x=[0.7, 0.3, 0.7], q=None, v=None,
    )  # fmt: skip


@pytest.mark.parametrize("name", ["project", "check_initial", "compensated", "batch_params"])
def test_what_is_neither_true_nor_false(name):
    complaint(TypeError, f"{name} must be True or False", "'maybe'", **{name: "maybe"})


def test_progress_that_says_nothing():
    for bad in ("x", 1, None):
        complaint(TypeError, "progress must be True, False or a function", repr(bad), progress=bad)
        complaint_of(lambda bad=bad: dx.prepare(OSCILLATOR, PLUS, **GOOD)(progress=bad), TypeError, "progress must be")
        complaint_of(lambda bad=bad: dx.simulate(OSCILLATOR, PLUS, **GOOD).extend(2, bad), TypeError, "progress must be")


def test_data_that_cannot_be_projected_are_not_to_be_projected_again():
    """An ellipse beside which the forces of the constraint lead past it."""
    ellipse = dx.LagrangeDirac(lambda q, v: v @ v / 2, holonomic=lambda q: jnp.stack([q[0] ** 2 / 100 + q[1] ** 2 - 1]))
    given = {"q": [30.0, 5.0], "v": [0.0, 0.0], "project": True}
    text = complaint(ValueError, "off the constraint", "project=True", "found no place on it", system=ellipse, **given)
    assert "pass project=True" not in text


def test_stores_that_no_file_can_be(tmp_path):
    complaint(TypeError, "to must be the path of a zarr store", "3", to=3)
    complaint(ValueError, "has 305 bytes", to=tmp_path / f"{'x' * 300}.zarr")
    complaint(ValueError, "the character of number 0", to=tmp_path / "a\0b.zarr")


def test_numbers_of_diagnostics_that_say_nothing():
    data = {"q": GOOD["q"], "v": GOOD["v"]}
    with pytest.raises(ValueError, match="must sum to 1"):
        dx.Composition(PLUS, [np.nan])
    with pytest.raises(ValueError, match="time must be a positive finite number"):
        dx.convergence(OSCILLATOR, PLUS, step_sizes=[0.1, 0.05, 0.025], time=np.inf, **data)
    with pytest.raises(ValueError, match="repeats must be a whole number"):
        dx.compare(OSCILLATOR, [PLUS], step=0.1, steps=3, repeats=0, **data)
    with pytest.raises(ValueError, match="tolerance must be a number"):
        dx.verify(dx.simulate(OSCILLATOR, PLUS, **GOOD), tolerance=np.nan)


def test_32_bit_floats_are_refused_by_name():
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2)
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.raises(ValueError, match=r'set to 32-bit floats since dirax was imported.*update\("jax_enable_x64", True\)'):
            dx.simulate(system, dx.LagrangeDAlembert(), q=[1.0], v=[0.0], step=0.1, steps=2)
    finally:
        jax.config.update("jax_enable_x64", True)


def test_params_that_no_function_takes_are_said():
    free = dx.LagrangeDirac(lambda q, v: v @ v / 2)
    run = {"q": [0.0], "v": [1.0], "step": 0.1, "steps": 2, "params": {"k": 1.0}}
    for start in (dx.simulate, dx.prepare):
        with pytest.warns(UserWarning, match=r"none of the functions \(lagrangian\) takes them"):
            start(free, dx.DiscreteDirac(), **run)
    pulled = dx.LagrangeDirac(lambda q, v: v @ v / 2, forces=lambda t, q, v, params: -params["k"] * q)
    dx.simulate(pulled, dx.DiscreteDirac(), **run)
    dx.simulate(free, dx.DiscreteDirac(), **run, events=[dx.Event(lambda q, params: q[0] - params["k"])])


def test_what_looks_at_numbers_refuses_traced_ones():
    spring = dx.LagrangeDirac(lambda q, v, params: v @ v / 2 - params * q @ q / 2)
    start = {"q": [1.0], "v": [0.0]}
    calls = {
        "dx.verify": lambda k: dx.verify(dx.simulate(spring, PLUS, params=k, step=0.1, steps=2, **start)),
        "dx.compare": lambda k: dx.compare(spring, [PLUS], params=k, step=0.1, steps=2, **start),
        "dx.convergence": lambda k: dx.convergence(spring, PLUS, params=k, step_sizes=[0.4, 0.2, 0.1], time=1.0, **start),
        "dx.linearize": lambda k: dx.linearize(spring, {"q": [0.0], "v": [0.0]}, params=k),
        "dx.sweep": lambda k: dx.sweep(
            spring, PLUS, over={"x": [1.0]}, case=lambda x: {"q": [x]}, params=k, step=1, steps=1, to="a"
        ),
    }
    for name, call in calls.items():
        with pytest.raises(ValueError, match=rf"^{name} looks at numbers.*outside of jax\.grad, jit and vmap\."):
            jax.jit(call)(2.0)


def test_functions_in_params_are_refused_with_the_way_to_learn_a_network():
    with pytest.raises(
        TypeError, match=r"params\['act'\] is .*eqx\.filter\(module, eqx\.is_array\), and join it there by eqx\.combine"
    ):
        dx.simulate(dx.LagrangeDirac(lambda q, v, params: v @ v), PLUS, params={"act": jnp.tanh}, **GOOD)


class OwnMidpoint(dx.AbstractScheme):
    """The midpoint rule for q̇ = p, ṗ = −q, with one function of the step equation replaced."""

    name: str = ""
    function: Callable = lambda *_: None

    def step_equation(self, system, shape):
        turned = lambda x: jnp.concatenate([x[1:], -x[:1]])
        functions = {
            "start": lambda data, h, params: (jnp.concatenate([data["q"], data["p"]]), jnp.zeros(2)),
            "residual": lambda u, x, t, h, params: u - turned(x + h / 2 * u),
            "advance": lambda u, x, t, h, params: x + h * u,
            "unpack": lambda x, u, t, h, params: {"q": x[:1], "p": x[1:]},
        }
        fields = {"q": dx.Field((1,)), "p": dx.Field((1,))}
        return dx.StepEquation(
            **functions | ({self.name: self.function} if self.name else {}), state_size=2, unknowns=2, fields=fields
        )


@pytest.mark.parametrize(
    ("name", "function", "words"),
    [
        (
            "start",
            lambda data, h, params: (data["q"], jnp.zeros(2)),
            r"start .* the state of shape \(2,\).* float64 of shape \(1,\)",
        ),
        ("start", lambda data, h, params: data["q"], r"start .* two vectors"),
        ("residual", lambda u, x, t, h, params: u[:1], r"residual .* r of shape \(2,\) in float64, as unknowns=2 says"),
        ("residual", lambda u, x, t, h, params: (u - x).astype(jnp.float32), "it returned float32"),
        ("residual", lambda u, x, t, h, params: None, "it returned None"),
        ("advance", lambda u, x, t, h, params: x[:1], "advance .* the next state"),
        ("unpack", lambda x, u, t, h, params: {"q": x[:1]}, "a dict of its fields, q, p, but it returned q"),
        ("unpack", lambda x, u, t, h, params: {"q": x, "p": x[1:]}, r"q of shape \(1,\), as fields say"),
    ],
)
def test_a_step_equation_whose_functions_return_other_sizes(name, function, words):
    run = {"q": [1.0], "v": [0.0], "step": 0.1, "steps": 5}
    oscillator = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2)
    with pytest.raises(ValueError, match=words):
        dx.simulate(oscillator, OwnMidpoint(name, function), **run)
    sol = dx.simulate(oscillator, OwnMidpoint(), **run)
    assert abs(sol.q[-1, 0] - np.cos(0.5)) < 1e-3 and dx.verify(sol).ok
    nowhere = OwnMidpoint("unpack", lambda x, u, t, h, params: {"q": x[:1], "p": jnp.arccos(x[:1] + t)})
    assert "p is not finite in a row or more, first at t = 0.1" in str(dx.verify(dx.simulate(oscillator, nowhere, **run)))


@jax.tree_util.register_dataclass
@dataclasses.dataclass
class Spring:
    stiffness: float

    def __post_init__(self):
        if not self.stiffness > 0.0:
            raise ValueError("a spring pulls back")


def test_params_that_ask_for_their_values_are_named():
    """JAX makes them of what has no values; the Lagrangian was blamed for an if that is not its."""
    system = dx.LagrangeDirac(lambda q, v, spring: v @ v / 2 - spring.stiffness * q @ q / 2)
    message = complaint(TypeError, r"Spring.__post_init__ asks for the values", system=system, params=Spring(2.0))
    assert "Python's if" not in message


@jax.tree_util.register_dataclass
@dataclasses.dataclass
class Degrees:
    angle: float

    def __post_init__(self):
        self.angle = np.pi / 180 * self.angle


def test_params_that_change_what_they_are_made_of_are_refused():
    """An angle in degrees was turned into radians once more wherever JAX went through it."""
    system = dx.LagrangeDirac(lambda q, v, params: v @ v / 2 - params["slope"].angle * q @ q / 2)
    for angle in (90.0, np.float32(90.0)):
        given = {"system": system, "params": {"slope": Degrees(angle)}}
        complaint(ValueError, "params['slope'].angle is 1.5707963", "but 0.0274155", **given)


@pytest.mark.parametrize(
    "scheme", [dx.LagrangeDAlembert(), dx.DiscreteDirac(), dx.Collocation(2)], ids=lambda s: type(s).__name__
)
def test_a_step_that_leads_out_of_the_domain_is_told_from_data_outside(scheme):
    falling = dx.LagrangeDirac(lambda q, v: v @ v / 2 + jnp.sqrt(q[0]))
    with pytest.raises(ValueError, match=r"first step is not finite .* the step is too long: it leads out of the domain"):
        dx.simulate(falling, scheme, q=[1.0], v=[-1.0], step=5.0, steps=3)
    with pytest.raises(ValueError, match="the data lie outside"):
        dx.simulate(falling, scheme, q=[-1.0], v=[0.0], step=0.1, steps=3)


def test_a_part_of_a_composition_that_goes_back_in_time_is_named():
    """ẋ = −x by the midpoint rule, 1 + h/2 = 0: in the middle part of three."""
    decay = dx.PortHamiltonian(lambda x: x @ x / 2, np.zeros((1, 1)), R=np.ones((1, 1)))
    back = 1 - 2 / (2 - 2 ** (1 / 3))
    sol = dx.simulate(decay, dx.Composition(dx.DiscreteDirac(), "yoshida4"), x=[1.0], step=-2 / back, steps=3)
    assert not sol.ok and "singular" in sol.message
    assert "in a part of the composition that goes back in time" in sol.message and "dx.Collocation" in sol.message
