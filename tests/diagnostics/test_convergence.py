"""Measured orders against the known ones, with closed forms and DOP853 as references."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx
from dirax import gallery

STEPS = (0.02, 0.01, 0.005, 0.0025)


def slope_by_hand(h, errors):
    return np.polyfit(np.log(h), np.log(errors), 1)[0]


@pytest.mark.parametrize(
    "scheme, order", [(dx.PlusLagrangeDirac(), 1), (dx.MinusLagrangeDirac(), 1), (dx.LagrangeDAlembert(), 2)]
)
@pytest.mark.soak_of(but=["scheme1-1"])
def test_orders_on_the_rolling_disk_in_q_p_and_multipliers(scheme, order):
    disk = gallery.get("rolling-disk")
    found = dx.convergence(
        disk.system, scheme, step_sizes=[0.02, 0.01, 0.005, 0.0025], time=1.0, params=disk.params, **disk.initial
    )
    assert set(found.orders) == {"q", "p", "multipliers"}
    assert list(found.orders.values()) == pytest.approx([order] * 3, abs=0.03)
    ax = found.plot()
    line, used, unused = ax.lines[:3]
    assert ax.get_xscale() == ax.get_yscale() == "log" and line.get_label() == f"$q$: order {found.order:.2f}"
    assert slope_by_hand(*line.get_data()) == pytest.approx(found.order)
    assert np.array_equal(used.get_ydata(), found.slopes["q"].errors) and len(unused.get_ydata()) == 0


@pytest.mark.parametrize("rule", ["midpoint", "trapezoidal"])
@pytest.mark.parametrize("name", ["kepler", "double-pendulum"])
@pytest.mark.soak_of(but=["kepler-trapezoidal"])
def test_second_order_against_an_independent_solution(rule, name):
    example = gallery.get(name)
    system, n = example.system, len(example.coordinates)
    # the continuous Euler–Lagrange equations, solved by scipy
    import jax

    lagrangian = lambda q, v: system.lagrangian(q, v, example.params)

    @jax.jit
    def field(y):
        q, v = y[:n], y[n:]
        mass = jax.hessian(lagrangian, 1)(q, v)
        mixed = jax.jacfwd(jax.grad(lagrangian, 1), 0)(q, v)
        return jnp.concatenate([v, jnp.linalg.solve(mass, jax.grad(lagrangian)(q, v) - mixed @ v)])

    start = np.concatenate([example.initial["q"], example.initial["v"]])
    solved = solve_ivp(
        lambda t, y: np.asarray(field(y)), (0, 1.2), start, method="DOP853", rtol=1e-12, atol=1e-12, dense_output=True
    )
    momentum = jax.jit(jax.vmap(jax.grad(lagrangian, 1)))

    def exact(t):
        y = solved.sol(t).T
        return {"q": y[:, :n], "p": momentum(y[:, :n], y[:, n:])}

    found = dx.convergence(
        system, dx.LagrangeDAlembert(rule), step_sizes=STEPS, time=1.2, reference=exact, params=example.params, **example.initial
    )
    assert found.orders["q"] == pytest.approx(2.0, abs=0.05)
    assert found.orders["p"] == pytest.approx(2.0, abs=0.05)
    assert found.order == pytest.approx(slope_by_hand(found.step_sizes, found.slopes["q"].errors), abs=1e-12)


oscillator = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2)
START = {"q": [1.0], "v": [0.0]}


def test_the_roundoff_plateau_is_left_out():
    scheme = dx.Composition(dx.LagrangeDAlembert(), "kahan-li8")
    exact = lambda t: {"q": np.cos(t)[:, None], "p": -np.sin(t)[:, None]}
    sizes = [1.0, 0.5, 0.25, 0.125, 0.0625, 0.03125]
    found = dx.convergence(oscillator, scheme, step_sizes=sizes, time=4.0, reference=exact, **START)
    used = found.slopes["q"].used
    assert used[:3].all() and not used[-1]
    assert found.order == pytest.approx(8.0, abs=0.4)
    assert "not used" in str(found) and "order" in found._repr_html_()
    assert found.to_dict()["quantities"]["q"]["used"] == used.tolist()


def test_a_refined_reference_does_not_bias_the_order():
    """Against itself refined and against cos t the same order comes out."""
    exact = lambda t: np.cos(t)[:, None]
    run = {"step_sizes": [0.2, 0.1, 0.05], "time": 2.0, **START}
    by_itself = dx.convergence(oscillator, dx.PlusLagrangeDirac(), **run)
    by_cosine = dx.convergence(oscillator, dx.PlusLagrangeDirac(), reference=exact, **run)
    assert by_itself.order == pytest.approx(by_cosine.order, abs=0.02)
    by_hand = dx.simulate(oscillator, dx.PlusLagrangeDirac(), step=0.1, steps=20, **START).q[-1, 0] - np.cos(2.0)
    assert by_cosine.slopes["q"].end_errors[1] == pytest.approx(abs(by_hand), rel=1e-9)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"step_sizes": [0.1, 0.05]}, "at least 3 different"),
        ({"step_sizes": [0.1, 0.05, 0.03]}, "must divide the largest"),
        ({"time": 0.05}, "must divide time"),
        ({"quantities": ["multipliers"]}, "are not in both"),
        ({"q0": [1.0], "q1": [1.0]}, "belong to one step size"),
    ],
)
def test_mistakes(changes, message):
    run = {"step_sizes": [0.1, 0.05, 0.025], "time": 1.0, **START, **changes}
    with pytest.raises(ValueError, match=message):
        dx.convergence(oscillator, dx.LagrangeDAlembert(), **run)


def test_a_scheme_that_is_exact_has_no_order_to_be_measured():
    """A free particle is solved up to roundoff by the midpoint rule, whatever the step; a constant error does not fall."""
    free, run = dx.LagrangeDirac(lambda q, v: v @ v / 2), {"step_sizes": [0.1, 0.05, 0.025], "time": 1.0}
    found = dx.convergence(free, dx.LagrangeDAlembert(), **run, q=[1.0], v=[0.3])
    assert np.isnan(found.order) and np.max(found.slopes["q"].errors) < 1e-14 and not found.slopes["q"].used.any()
    assert "q: 0 of the step sizes" in str(found) and "take larger steps" in found.notes[0]
    assert found.to_dict()["quantities"]["q"]["order"] is None and found.plot().lines[0].get_label() == "$q$: no order"
    off = dx.convergence(oscillator, dx.LagrangeDAlembert(), **run, **START, reference=lambda t: np.cos(t)[:, None] + 1)
    assert np.isnan(off.order) and off.slopes["q"].end_errors == pytest.approx([0.5] * 3, abs=1e-3)  # of 2 at most
    table = dx.compare(free, [dx.LagrangeDAlembert()], step=0.1, steps=10, repeats=1, q=[1.0], v=[0.3])
    entry = table["LagrangeDAlembert"]
    assert entry.order is None and entry.error < 1e-14 and "take larger steps" in entry.note


def test_a_failed_run_is_named():
    falling = dx.LagrangeDirac(lambda q, v: v @ v / 2 + jnp.sqrt(q[0]) - 2 * q[0])
    with pytest.raises(ValueError, match=r"the run with steps of 0\.1 failed"):
        dx.convergence(falling, dx.PlusLagrangeDirac(), step_sizes=[0.1, 0.05, 0.025], time=1.0, q=[0.1], v=[-1.0])


def test_explicit_equations_are_the_reference_where_there_are_some():
    run = {"step_sizes": [0.2, 0.1, 0.05], "time": 2.0}
    found = dx.convergence(oscillator, dx.LagrangeDAlembert(), **run, **START)
    exact = lambda t: {"q": np.cos(t)[:, None], "p": -np.sin(t)[:, None]}
    by_cosine = dx.convergence(oscillator, dx.LagrangeDAlembert(), reference=exact, **run, **START)
    assert "explicit equations" in found.reference
    assert found.agrees
    for name in ("q", "p"):
        np.testing.assert_allclose(found.slopes[name].errors, by_cosine.slopes[name].errors, rtol=1e-9)
    top = gallery.get("free-top")
    found = dx.convergence(top.system, top.scheme, step_sizes=[0.02, 0.01, 0.005], time=0.2, params=top.params, **top.initial)
    assert found.agrees is None
    assert "for want of another (no ordinary differential equation is derived" in found.reference


@pytest.mark.parametrize("name", ["kepler", "rolling-disk", "snakeboard", "lotka-volterra", "dc-motor"])
@pytest.mark.soak_of("kepler", "rolling-disk")
def test_the_explicit_solution_is_that_of_dop853(name):
    from dirax.diagnostics.bench.ode_solvers import compiled_field
    from dirax.diagnostics.explicit_solution import explicit_solution

    example, t = gallery.get(name), np.linspace(0.0, 1.0, 6)
    ours = explicit_solution(example.system, {"params": example.params, **example.initial})
    field = compiled_field(ours.ode)
    theirs = solve_ivp(field, (0.0, 1.0), ours.ode.start, method="DOP853", rtol=1e-13, atol=1e-14, t_eval=t).y.T
    found = next(iter(ours(t).values()))
    np.testing.assert_allclose(found, theirs[:, : found.shape[1]], rtol=1e-11, atol=1e-12)


class Heavier(dx.AbstractScheme):
    """The midpoint scheme of a mass that is larger by a tenth: of order 2, to another motion."""

    def step_equation(self, system, shape):
        other = dx.LagrangeDirac(lambda q, v: 1.1 * v @ v / 2 - q @ q / 2)
        return dx.LagrangeDAlembert().step_equation(other, shape)


def test_a_scheme_that_converges_to_something_else_has_no_order():
    run = {"step_sizes": [0.2, 0.1, 0.05], "time": 2.0, **START}
    found = dx.convergence(oscillator, Heavier(), **run)
    assert found.agrees is False and np.isnan(found.order)
    assert any("Heavier does not come to the explicit equations of motion" in note for note in found.notes)
    by_itself = dx.convergence(oscillator, Heavier(), reference=Heavier(), **run)
    assert by_itself.order == pytest.approx(2.0, abs=0.05)
    table = dx.compare(oscillator, [dx.LagrangeDAlembert(), Heavier()], step=0.1, steps=40, repeats=1, **START)
    assert "against the explicit equations of motion" in table.title
    assert table["LagrangeDAlembert"].order == pytest.approx(2.0, abs=0.05)
    assert table["Heavier"].order is None
    assert "does not come to" in table["Heavier"].note


@pytest.mark.soak
def test_orders_and_errors_in_other_units():
    """A skate in x = (q, p): by one norm of metres and momenta the order was 2.988 with a mass of 1, and 2 with one of 2⁻⁴⁰."""
    skate = dx.HamiltonDirac(
        lambda q, p, m: p @ p / m / 2 + m * (q @ q) / 2 + 0.3 * m * q[0] ** 2 * q[1] ** 2,
        lambda q: jnp.stack([jnp.stack([jnp.sin(q[2]), -jnp.cos(q[2]), 0.0])]),
    )
    found = [
        dx.convergence(
            skate, dx.DiscreteDirac(), step_sizes=[0.04, 0.02, 0.01], time=0.2, params=m,
            q=[1.0, 0.0, 0.0], p=np.array([0.5, 0.0, 0.3]) * m,
        )
        for m in (1.0, 2.0**-40, 2.0**60)
    ]  # fmt: skip
    for other in found[1:]:
        assert other.order == found[0].order and np.array_equal(other.slopes["x"].errors, found[0].slopes["x"].errors)


def test_a_coordinate_that_stays_zero_is_measured_by_the_others():
    """In a plane cos t beside 0, and beside a rounding: the errors and the order are those of the line."""
    plane, run = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2), {"step_sizes": [0.2, 0.1, 0.05], "time": 2.0}
    line = dx.convergence(oscillator, dx.LagrangeDAlembert(), **run, **START)
    for still in (0.0, 1e-17):
        noisy = lambda t, still=still: np.stack([np.cos(t), still * np.sign(np.sin(1e3 * t))], axis=1)
        found = dx.convergence(plane, dx.LagrangeDAlembert(), **run, reference=noisy, q=[1.0, 0.0], v=[0.0, 0.0])
        assert found.order == pytest.approx(line.order, abs=1e-6)
        np.testing.assert_allclose(found.slopes["q"].errors, line.slopes["q"].errors, rtol=1e-6)


def test_impulses_of_composed_steps_have_the_order_of_the_composition():
    rows = lambda q: jnp.array([[0.4 + 0.3 * q[1], 0.2 * q[0], 1.0]])
    system = dx.LagrangeDirac(lambda q, v: (1 + 0.3 * q[0] ** 2) * v @ v / 2 + 0.3 * q[1] * v[0] - q @ q / 2, rows)
    q = np.array([0.3, 0.2, 0.1])
    along, v = np.asarray(rows(q))[0], np.array([0.2, 0.3, -0.1])
    run = {"q": q, "v": v - along * (along @ v) / (along @ along), "step_sizes": [0.1, 0.05, 0.025], "time": 1.0}
    found = dx.convergence(system, dx.Composition(dx.LagrangeDAlembert(), "suzuki4"), **run)
    assert abs(found.slopes["multipliers"].order - 4.0) < 0.05, str(found)


def test_equations_with_a_root_in_them_are_solved_explicitly_too():
    body = dx.EulerPoincare(dx.SO3(), lambda xi: jnp.sqrt(1.0 + xi @ (jnp.array([1.0, 2.0, 3.0]) * xi))).lie_poisson()
    found = dx.convergence(body, dx.DiscreteDirac(), x=[0.5, 0.3, 0.4], time=1.0, step_sizes=[0.2, 0.1, 0.05])
    assert found.reference == "the explicit equations of motion"
    assert found.orders["x"] == pytest.approx(2.0, abs=0.05)


def test_runs_that_an_event_ends_have_no_common_times():
    thrown = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[1] - q[0] ** 4)
    run = {"events": [dx.Event(lambda q: q[1], direction=-1, terminal=True)]}
    for q, v in (([0.0, 1.0], [0.3, 1.0]), ([[0.0, 1.0], [0.0, 9.0]], [[0.3, 1.0], [0.3, 1.0]])):
        with pytest.raises(ValueError, match=r"an event has ended the run with steps of 0.2 before t = 4, .* stop before them"):
            dx.convergence(thrown, dx.LagrangeDAlembert(), q=q, v=v, step_sizes=[0.2, 0.1, 0.05], time=4.0, **run)
    assert np.isfinite(
        dx.convergence(thrown, dx.Collocation(1), q=q[0], v=v[0], step_sizes=[0.2, 0.1, 0.05], time=1.0, **run).order
    )
