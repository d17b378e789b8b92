"""Holonomic constraints: pendulums in Cartesian coordinates against their angles, linkages with redundant bars, bad input.

The oracles are scipy's DOP853 at tight tolerance in angles, SHAKE and RATTLE written out in numpy, and closed forms.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx
from dirax import gallery
from dirax.diagnostics.verify import verify
from dirax.gallery.cartesian_double_pendulum import from_angles

MIDPOINT, TRAPEZOIDAL = dx.LagrangeDAlembert("midpoint"), dx.LagrangeDAlembert("trapezoidal")


def slopes(errors) -> np.ndarray:
    """log2 of successive ratios, for halved steps."""
    errors = np.asarray(errors)
    return np.log2(errors[:-1] / errors[1:])


def along(field, start, times):
    return solve_ivp(field, (times[0], times[-1]), start, method="DOP853", rtol=1e-13, atol=1e-13, t_eval=times).y


# ------------------------------------------------------------------------------------------------- one pendulum

# a spring in y makes the force nonlinear, so that the rules differ
PENDULUM = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[1] - q[1] ** 3 / 3, holonomic=lambda q: jnp.array([q @ q - 1.0]))
ANGLE = np.array([1.0, 0.5])
SWING = lambda t, y: [y[1], -np.sin(y[0]) * (1 + np.cos(y[0]) ** 2)]


def on_circle(angle, rate):
    """(q, v) of the pendulum."""
    s, c = np.sin(angle), np.cos(angle)
    return np.stack([s, -c], -1), rate[..., None] * np.stack([c, s], -1)


START = dict(zip("qv", on_circle(*ANGLE), strict=True))


def pendulum_errors(sol):
    """Largest errors of q, p and of the tension, which per unit of time is λ/h, where −2λq is the force."""
    angle, rate = along(SWING, ANGLE, sol.t)
    q, v = on_circle(angle, rate)
    tension = (rate**2 + np.cos(angle) * (1 + np.cos(angle) ** 2)) / 2
    return [np.max(np.abs(sol.q - q)), np.max(np.abs(sol.p - v)), np.max(np.abs(sol.multipliers[:, 0] / sol.step - tension[:-1]))]


@pytest.mark.parametrize(
    ("scheme", "order"),
    [(MIDPOINT, 2), (TRAPEZOIDAL, 2), (dx.PlusLagrangeDirac("left"), 1), (dx.MinusLagrangeDirac("right"), 1)],
)
@pytest.mark.soak_of("scheme0-2", "scheme1-2")
def test_a_pendulum_in_cartesian_coordinates(scheme, order):
    errors = []
    for steps in (50, 100, 200):
        sol = dx.simulate(PENDULUM, scheme, step=2.0 / steps, steps=steps, **START)
        errors.append(pendulum_errors(sol))
        assert np.max(np.abs(sol.constraint)) < 1e-15
        assert np.max(np.abs(np.sum(sol.q * sol.p, axis=1))) < 1e-15
    assert slopes(errors) == pytest.approx(order, abs=0.1)


def test_the_trapezoidal_rule_is_shake_and_its_saved_momentum_is_that_of_rattle():
    h, q, p = 0.05, START["q"], START["v"]
    force = lambda q: np.array([0.0, -1 - q[1] ** 2])
    rows = [(q, p)]
    for _ in range(200):
        free = q + h * p + h * h / 2 * force(q)
        b, c = q @ free, free @ free - 1.0
        q1 = free - c / (b + np.sqrt(b * b - c)) * q  # |free − s q| = 1
        p = (q1 - q) / h + h / 2 * force(q1)
        q, p = q1, p - (q1 @ p) * q1
        rows.append((q, p))
    sol = dx.simulate(PENDULUM, TRAPEZOIDAL, step=h, steps=200, **START)
    np.testing.assert_allclose(sol.q, np.array(rows)[:, 0], atol=2e-12)
    np.testing.assert_allclose(sol.p, np.array(rows)[:, 1], atol=2e-12)


def test_methods_1_and_2_of_discretization_maps():
    """Method 1 has the distribution of g alone, and keeps this g because it is quadratic; Method 2 keeps g and its rate."""
    for scheme, of_rate in ((dx.DiscreteDirac(), 1e-2), (dx.DiscreteDirac(constraints="resolve"), 1e-15)):
        errors = []
        for steps in (50, 100, 200):
            sol = dx.simulate(PENDULUM, scheme, step=2.0 / steps, steps=steps, **START)
            angle, rate = along(SWING, ANGLE, sol.t)
            errors.append(np.max(np.abs(sol.q - on_circle(angle, rate)[0])))
            assert np.max(np.abs(sol.constraint_residual()[:, 0])) < 1e-13
            assert np.max(np.abs(sol.constraint_residual()[:, 1])) < of_rate
        assert slopes(errors) == pytest.approx(2.0, abs=0.1)


@pytest.mark.soak
def test_the_constraint_algorithm_resolves_holonomic_constraints():
    """S_0 ends at the tangent circle after two steps, and Method 2 of the chain keeps it."""
    chain = dx.constraint_algorithm(PENDULUM, near=START)
    x = np.concatenate([START["q"], START["v"]])
    errors = []
    for steps in (50, 100, 200):
        sol = dx.simulate(chain.resolved(), dx.DiscreteDirac(constraints="resolve"), x=x, step=2.0 / steps, steps=steps)
        angle, rate = along(SWING, ANGLE, sol.t)
        errors.append(np.max(np.abs(sol.x - np.concatenate(on_circle(angle, rate), axis=1))))
        assert np.max(np.abs(np.sum(sol.x[:, :2] ** 2, axis=1) - 1)) < 1e-14
    assert slopes(errors) == pytest.approx(2.0, abs=0.15)


@pytest.mark.soak
def test_composition_raises_the_order():
    errors = []
    for steps in (20, 40, 80):
        sol = dx.simulate(PENDULUM, dx.Composition(MIDPOINT, "suzuki4"), step=2.0 / steps, steps=steps, **START)
        errors.append(pendulum_errors(sol)[:2])
        assert np.max(np.abs(np.sum(sol.q**2, axis=1) - 1)) < 1e-14
    assert slopes(errors) == pytest.approx(4.0, abs=0.2)


PIVOT = lambda t: 0.3 * np.cos(2 * t)
MOVING = dx.LagrangeDirac(
    lambda q, v: v @ v / 2 - q[1], holonomic=lambda t, q: jnp.stack([(q[0] - 0.3 * jnp.cos(2 * t)) ** 2 + q[1] ** 2 - 1.0])
)


@pytest.mark.soak
def test_a_moving_pivot():
    """x²-pivot at 0.3 cos 2t: g depends on time, and v satisfies G v + ∂g/∂t = 0."""
    field = lambda t, y: [y[1], -np.sin(y[0]) + 1.2 * np.cos(2 * t) * np.cos(y[0])]
    errors = []
    for steps in (50, 100, 200):
        times = 0.2 + np.linspace(0.0, 2.0, steps + 1)
        angle, rate = along(field, ANGLE, times)
        q, v = on_circle(angle, rate)
        q[:, 0] += PIVOT(times)
        v[:, 0] -= 0.6 * np.sin(2 * times)
        sol = dx.simulate(MOVING, MIDPOINT, q=q[0], v=v[0], step=2.0 / steps, steps=steps, t0=0.2)
        tension = (rate**2 + np.cos(angle) + 1.2 * np.cos(2 * times) * np.sin(angle)) / 2
        errors.append(
            [
                np.max(np.abs(sol.q - q)),
                np.max(np.abs(sol.p - v)),
                np.max(np.abs(sol.multipliers[:, 0] / sol.step - tension[:-1])),
            ]
        )
    assert slopes(errors) == pytest.approx(2.0, abs=0.1)
    assert np.max(np.abs(sol.constraint)) < 1e-14
    assert np.max(np.abs(np.asarray(sol.map_rows(MOVING.constraint_at)))) < 1e-13


# ------------------------------------------------------------------------------------------------- double pendulum

DOUBLE = dx.LagrangeDirac(
    lambda q, v: v @ v / 2 - q[1] - q[3],
    holonomic=lambda q: jnp.stack([q[:2] @ q[:2] - 1.0, (q[2:] - q[:2]) @ (q[2:] - q[:2]) - 1.0]),
)
ANGLES = np.array([0.8, 1.1, 0.3, -0.4])


def double_field(t, y):
    """Unit masses and lengths: [[2, c], [c, 1]] θ̈ = …, c = cos(θ1 − θ2)."""
    a, b, u, w = y
    c, s = np.cos(a - b), np.sin(a - b)
    right = [-s * w * w - 2 * np.sin(a), s * u * u - np.sin(b)]
    return np.concatenate([[u, w], np.linalg.solve([[2.0, c], [c, 1.0]], right)])


def cartesian(y, xp=np):
    """(q, v) of shape (8,) for angles and rates (4,)."""
    a, b, u, w = y
    first, second = xp.stack([xp.sin(a), -xp.cos(a)]), xp.stack([xp.sin(b), -xp.cos(b)])
    du, dw = u * xp.stack([xp.cos(a), xp.sin(a)]), w * xp.stack([xp.cos(b), xp.sin(b)])
    return xp.concatenate([first, first + second, du, du + dw])


STATE = cartesian(ANGLES)
DOUBLE_START = {"q": STATE[:4], "v": STATE[4:]}


def test_a_double_pendulum_in_cartesian_coordinates():
    errors = []
    for steps in (100, 200, 400):
        sol = dx.simulate(DOUBLE, MIDPOINT, step=2.0 / steps, steps=steps, **DOUBLE_START)
        y = along(double_field, ANGLES, sol.t)
        exact = np.stack([cartesian(row) for row in y.T])
        rates = np.stack([double_field(0.0, row) for row in y.T])[:, 2:]
        # the outer mass: its acceleration less gravity is −2λ_2 (q2 − q1) per unit of time
        arm, inner = exact[:, 2:4] - exact[:, :2], exact[:, :2]
        turned = lambda q: np.stack([-q[:, 1], q[:, 0]], 1)
        acceleration = sum(
            r[:, None] * turned(q) - (w**2)[:, None] * q for r, w, q in ((rates[:, 0], y[2], inner), (rates[:, 1], y[3], arm))
        )
        tension = -np.sum((acceleration + np.array([0.0, 1.0])) * arm, axis=1) / 2
        errors.append(
            [
                np.max(np.abs(sol.q - exact[:, :4])),
                np.max(np.abs(sol.p - exact[:, 4:])),
                np.max(np.abs(sol.multipliers[:, 1] / sol.step - tension[:-1])),
            ]
        )
    assert slopes(errors) == pytest.approx(2.0, abs=0.15)


@pytest.mark.soak
def test_constraints_stay_at_roundoff_and_the_energy_bounded_over_many_steps():
    sol = dx.simulate(DOUBLE, MIDPOINT, step=0.01, steps=100_000, save_every=10, engine="native", **DOUBLE_START)
    assert sol.ok and np.max(np.abs(sol.constraint)) < 1e-14
    hidden = np.asarray(sol.map_rows(DOUBLE.constraint_at))
    assert np.max(np.abs(hidden)) < 1e-14
    energy = sol.energy()
    assert np.max(np.abs(energy - energy[0])) < 1e-3
    assert verify(sol)["energy"].verdict == "bounded"


@pytest.mark.parametrize("scheme", [MIDPOINT, pytest.param(dx.PlusLagrangeDirac("left"), marks=pytest.mark.soak)])
@pytest.mark.soak
def test_the_two_form_of_the_constraint_manifold_is_preserved(scheme):
    """Pulled back to angles and rates, dq ∧ dp before and after a step are the same two-form."""
    inside = lambda y: cartesian(y, jnp)

    def after(y):
        x = inside(y)
        sol = dx.simulate(DOUBLE, scheme, q=x[:4], v=x[4:], step=0.1, steps=1, check_initial=False)
        return jnp.concatenate([sol.q[-1], sol.p[-1]])

    form = np.block([[np.zeros((4, 4)), np.eye(4)], [-np.eye(4), np.zeros((4, 4))]])
    before, later = (np.asarray(jax.jit(jax.jacfwd(f))(jnp.asarray(ANGLES))) for f in (inside, after))
    pulled = [J.T @ form @ J for J in (before, later)]
    assert np.max(np.abs(pulled[1] - pulled[0])) < 2e-13 < 0.5 < np.max(np.abs(pulled[0]))
    assert np.max(np.abs(later - before)) > 0.05


@pytest.mark.soak
def test_engines_and_batches_agree():
    run = {"step": 0.02, "steps": 50}
    batch = {name: np.stack([DOUBLE_START[name], DOUBLE_START[name] * sign]) for name, sign in (("q", 1.0), ("v", -0.5))}
    native, xla = (dx.simulate(DOUBLE, MIDPOINT, engine=e, **batch, **run) for e in ("native", "xla"))
    for name, tolerance in (("q", 1e-13), ("p", 1e-13), ("multipliers", 1e-11)):
        np.testing.assert_allclose(native.fields[name], xla.fields[name], atol=tolerance)
    alone = dx.simulate(DOUBLE, MIDPOINT, **DOUBLE_START, **run)
    np.testing.assert_array_equal(alone.q, native.q[0])


@pytest.mark.soak
def test_a_gradient_against_finite_differences():
    def end(turn):
        angle = 1.0 + turn
        q = jnp.stack([jnp.sin(angle), -jnp.cos(angle)])
        sol = dx.simulate(PENDULUM, MIDPOINT, q=q, v=jnp.stack([-q[1], q[0]]) * (0.5 - turn), step=0.1, steps=12)
        return sol.q[-1, 0] + sol.p[-1, 1] + sol.multipliers[5, 0]

    slope = jax.jit(jax.grad(end))(0.0)
    assert slope == pytest.approx((float(end(1e-5)) - float(end(-1e-5))) / 2e-5, rel=1e-7)


@pytest.mark.parametrize("scheme", [MIDPOINT, dx.PlusLagrangeDirac("left"), dx.MinusLagrangeDirac("left")])
@pytest.mark.soak
def test_verify_finds_the_discrete_dirac_structure_of_the_constraint_distribution(scheme):
    sol = dx.simulate(PENDULUM, scheme, step=0.02, steps=100, **START)
    report = verify(sol)
    assert report.ok, report
    assert [line.verdict for line in report.lines[:5]] == ["ok"] * 5 and report.lines[-1].verdict == "ok"
    assert report["hidden constraint"].value < 1e-15
    sol.fields["p"] = sol.p + 1e-13 * sol.q
    sol.fields["multipliers"] = sol.multipliers * (1 + 1e-9)
    report = verify(sol)
    assert report["hidden constraint"].verdict == report["saved p and multipliers"].verdict == "VIOLATED"


def test_the_gallery_has_it_beside_its_angles():
    in_angles = gallery.get("double-pendulum").simulate(steps=500)
    sol = gallery.get("cartesian-double-pendulum").simulate(steps=500)
    y = np.asarray(in_angles.q)
    first = np.stack([np.sin(y[:, 0]), -np.cos(y[:, 0])], 1)
    both = np.concatenate([first, first + np.stack([np.sin(y[:, 1]), -np.cos(y[:, 1])], 1)], 1)
    assert np.max(np.abs(sol.q - both)) < 1e-3  # two schemes of order 2
    assert np.max(np.abs(sol.constraint)) < 1e-14
    hanging = gallery.get("cartesian-double-pendulum").simulate(steps=500, **from_angles([0.0, 0.0], [0.0, 0.0]))
    np.testing.assert_allclose(hanging.multipliers / hanging.step, [[2 * 9.81, 9.81]] * 500, rtol=1e-11)


# ------------------------------------------------------------------------------------ holonomic and nonholonomic together


MIXED = dx.LagrangeDirac(
    lambda q, v: v @ v / 2,
    lambda q: jnp.stack([0.0 * q[0], 0.0 * q[0], 1.0 + 0.0 * q[0], -q[1]])[None],
    holonomic=lambda q: jnp.stack([q[0] ** 2 + q[1] ** 2 - 1.0]),
)


@pytest.mark.soak
def test_both_kinds_of_constraints():
    """x² + y² = 1 and dz = y ds, free otherwise: θ = ωt, ṡ = ṡ0/√(1 + sin²θ)."""
    errors = []
    for steps in (50, 100, 200):
        sol = dx.simulate(MIXED, MIDPOINT, q=[1.0, 0.0, 0.0, 0.0], v=[0.0, 1.0, 0.0, 0.8], step=2.0 / steps, steps=steps)
        sine, rate = np.sin(sol.t), 0.8 / np.sqrt(1 + np.sin(sol.t) ** 2)
        force = np.cos(sol.t) * rate / (1 + sine**2)  # −z̈
        errors.append(
            [
                np.max(np.abs(sol.q[:, :2] - np.stack([np.cos(sol.t), sine], 1))),
                np.max(np.abs(sol.p[:, 2:] - np.stack([sine * rate, rate], 1))),
                np.max(np.abs(sol.multipliers[:, 0] / sol.step + force[:-1])),
                np.max(np.abs(sol.multipliers[:, 1] / sol.step - 0.5)),
            ]
        )
    assert slopes(errors) == pytest.approx(2.0, abs=0.1)


@pytest.mark.soak
def test_verify_of_constraints_that_move_and_of_both_kinds():
    report = verify(dx.simulate(MOVING, MIDPOINT, q=[1.3, 0.0], v=[0.0, 0.4], step=0.02, steps=100))
    assert report.ok and report["energy"].verdict == "not checked", report
    for scheme in (MIDPOINT, dx.PlusLagrangeDirac(), dx.LagrangeDAlembert("trapezoidal", "left", "outgoing")):
        report = verify(dx.simulate(MIXED, scheme, q=[1.0, 0.0, 0.0, 0.0], v=[0.0, 1.0, 0.0, 0.8], step=0.02, steps=100))
        assert report.ok and report.lines[-1].verdict == "ok", report


# ------------------------------------------------------------------------------------------------ redundant constraints

WIDTH = 2.0


def bars(q, *, extra=True):
    """A parallelogram of two unit cranks at (0, 0) and (2, 0), and a bar between the middles of the cranks."""
    a, b, d = q[:2], q[2:], jnp.array([WIDTH, 0.0])
    square = lambda r: r @ r
    found = [square(a) - 1.0, square(b - a) - WIDTH**2, square(b - d) - 1.0]
    return jnp.stack(found + [square((a - b - d) / 2) - WIDTH**2] * extra)


WEIGHTS = lambda q, v: v @ v / 2 - q[1] - q[3]
BRACED, REGULAR = dx.LagrangeDirac(WEIGHTS, holonomic=bars), dx.LagrangeDirac(WEIGHTS, holonomic=lambda q: bars(q, extra=False))


def linkage(angle, rate):
    """(q, v) of the cranks at an angle from the horizontal."""
    point, speed = np.stack([np.cos(angle), np.sin(angle)], -1), rate[..., None] * np.stack([-np.sin(angle), np.cos(angle)], -1)
    return np.concatenate([point, point + np.array([WIDTH, 0.0])], -1), np.concatenate([speed, speed], -1)


@pytest.mark.soak
def test_a_redundant_bar_is_reported_and_carries_nothing():
    q, v = linkage(*np.array([1.1, 0.3]))
    errors = []
    for steps in (50, 100, 200):
        sol = dx.simulate(BRACED, MIDPOINT, q=q, v=v, step=1.0 / steps, steps=steps)
        exact = linkage(*along(lambda t, y: [y[1], -np.cos(y[0])], [1.1, 0.3], sol.t))
        errors.append([np.max(np.abs(sol.q - exact[0])), np.max(np.abs(sol.p - exact[1]))])
    assert slopes(errors) == pytest.approx(2.0, abs=0.1)
    assert sol.stats["redundant_constraints"] == [3]
    assert np.all(sol.multipliers[:, 3] == 0.0) and np.max(np.abs(sol.constraint)) < 1e-13


@pytest.mark.soak
def test_redundant_constraints_in_a_batch_and_projected():
    q, v = linkage(*np.array([1.1, 0.3]))
    sol = dx.simulate(BRACED, MIDPOINT, q=q, v=v, step=0.01, steps=50)
    report = verify(sol)
    assert report.ok and "number 3 left out" in report["constraint"].explanation, report
    regular = dx.simulate(REGULAR, MIDPOINT, q=q, v=v, step=0.01, steps=50)
    np.testing.assert_allclose(regular.q, sol.q, atol=1e-12)
    batch = dx.simulate(BRACED, MIDPOINT, q=np.stack([q, q]), v=np.stack([v, 2 * v]), step=0.01, steps=50)
    np.testing.assert_array_equal(batch.q[0], sol.q)
    moved = dx.simulate(BRACED, MIDPOINT, q=q * 1.01, v=v, step=0.01, steps=5, project=True)
    assert moved.ok and np.max(np.abs(bars(jnp.asarray(moved.q[0])))) < 1e-14


@pytest.mark.soak
def test_a_one_form_that_says_what_a_constraint_says_is_left_out():
    """On the surface z = x²/2 the one-form dz − x dx follows from the constraint, which holds the position too and stays."""
    on = lambda q: jnp.stack([q[2] - q[0] ** 2 / 2])
    L = lambda q, v: v @ v / 2 - q[2]
    given = {"q": [1.0, 0.0, 0.5], "v": [0.3, 0.2, 0.3], "step": 0.05, "steps": 200}
    twice = dx.simulate(dx.LagrangeDirac(L, lambda q: jnp.stack([-q[0], 0.0, 1.0])[None], holonomic=on), MIDPOINT, **given)
    once = dx.simulate(dx.LagrangeDirac(L, holonomic=on), MIDPOINT, **given)
    assert twice.stats["redundant_constraints"] == [0] and np.all(twice.multipliers[:, 0] == 0.0)
    assert np.max(np.abs(twice.q[:, 2] - twice.q[:, 0] ** 2 / 2)) < 1e-14
    np.testing.assert_array_equal(twice.q, once.q)
    np.testing.assert_array_equal(twice.multipliers[:, 1], once.multipliers[:, 0])


def test_a_singular_configuration_is_not_redundancy():
    q, v = linkage(*np.array([0.0, 0.3]))
    with pytest.raises(ValueError, match="rank 2 of 3, but have rank 3 nearby: a singular configuration"):
        dx.simulate(REGULAR, MIDPOINT, q=q, v=v, step=0.01, steps=2)


@pytest.mark.parametrize(
    "scheme", [MIDPOINT, dx.PlusLagrangeDirac(), dx.DiscreteDirac(), dx.DiscreteDirac(constraints="resolve")]
)
@pytest.mark.soak_of(but=["scheme2"])
def test_dependent_one_forms_go_on_with_the_independent_ones(scheme):
    edge = lambda q: jnp.stack([jnp.sin(q[2]), -jnp.cos(q[2]), 0.0 * q[0]])
    one, twice = lambda q: edge(q)[None], lambda q: jnp.stack([edge(q), -3.0 * edge(q)])
    given = {"q": [0.0, 0.0, 0.3], "v": [np.cos(0.3), np.sin(0.3), 0.7], "step": 0.05, "steps": 40}
    make = [lambda forms: dx.LagrangeDirac(lambda q, v: v @ v / 2, forms)]
    if isinstance(scheme, dx.DiscreteDirac):
        make.append(lambda forms: dx.NonholonomicMechanics(lambda q: jnp.eye(3), lambda q: 0.0 * q[0], forms))
    for system in make:
        single, double = (dx.simulate(system(forms), scheme, **given) for forms in (one, twice))
        np.testing.assert_allclose(double.q, single.q, atol=1e-13)
        np.testing.assert_allclose(double.multipliers, single.multipliers * [1.0, 0.0], atol=1e-13)
        assert double.stats["redundant_constraints"] == [1] and "redundant_constraints" not in single.stats


@pytest.mark.soak
def test_constraints_that_contradict_each_other():
    L = lambda q, v: v @ v / 2
    given = {"q": [0.0, 0.0, 0.0], "v": [1.0, 0.0, 0.0], "step": 0.1, "steps": 3}
    heights = dx.LagrangeDirac(L, holonomic=lambda q: jnp.stack([q[2], q[2] - 1e-3]))
    for more in ({}, {"project": True}, {"check_initial": False}):
        with pytest.raises(ValueError, match=r"constraints \(holonomic\) contradict each other .*rank is 1 of 2.*0.0005"):
            dx.simulate(heights, MIDPOINT, **given, **more)
    speeds = lambda b: dx.LagrangeDirac(
        L, lambda q: jnp.array([[0.0, 1.0, 0.0], [0.0, 2.0, 0.0]]), affine=lambda q: jnp.array([-0.5, b])
    )
    with pytest.raises(ValueError, match="contradict each other"):
        dx.simulate(speeds(1.0), MIDPOINT, **given)
    sol = dx.simulate(speeds(-1.0), MIDPOINT, **given, project=True)
    np.testing.assert_allclose(sol.q[-1], [0.3, 0.15, 0.0], atol=1e-15)
    with pytest.raises(ValueError, match=r"constraint 1 .*has no direction"):
        dx.simulate(dx.LagrangeDirac(L, holonomic=lambda q: jnp.stack([q[2], q[2] ** 2])), MIDPOINT, **given)


# ------------------------------------------------------------------------------------------------------------- bad input


def test_initial_data_off_the_constraint_are_refused_or_projected():
    with pytest.raises(ValueError, match=r"off the constraint, whose residual is .*project=True"):
        dx.simulate(PENDULUM, MIDPOINT, q=[0.6, -0.7], v=[0.0, 0.0], step=0.1, steps=2)
    with pytest.raises(ValueError, match=r"off the constraint"):
        dx.simulate(PENDULUM, MIDPOINT, q=[0.6, -0.8], v=[0.0, 1.0], step=0.1, steps=2)
    with pytest.raises(ValueError, match=r"off the constraint"):
        dx.simulate(PENDULUM, MIDPOINT, q0=[0.6, -0.8], q1=[0.6, -0.7], step=0.1, steps=2)
    sol = dx.simulate(PENDULUM, MIDPOINT, q=[0.6, -0.7], v=[1.0, 1.0], step=0.1, steps=2, project=True)
    assert abs(sol.q[0] @ sol.q[0] - 1) < 1e-15 and abs(sol.q[0] @ sol.p[0]) < 1e-15
    # moved along the normal at the given point
    assert (sol.q[0] - [0.6, -0.7]) @ [0.7, 0.6] == pytest.approx(0.0, abs=1e-14)


def test_two_points_are_rows_0_and_1():
    first = dx.simulate(PENDULUM, MIDPOINT, step=0.1, steps=20, **START)
    again = dx.simulate(PENDULUM, MIDPOINT, q0=first.q[0], q1=first.q[1], step=0.1, steps=20)
    np.testing.assert_allclose(again.q, first.q, atol=1e-12)
    np.testing.assert_allclose(again.p, first.p, atol=1e-12)


def test_wrong_shapes_and_values():
    L = lambda q, v: v @ v / 2 - q[1]
    run = lambda g: dx.simulate(dx.LagrangeDirac(L, holonomic=g), MIDPOINT, q=[1.0, 0.0], v=[0.0, 1.0], step=0.1, steps=2)
    with pytest.raises(ValueError, match=r"holonomic\(q\) must return an array of shape \(c,\).*shape \(\): put it in a pair"):
        run(lambda q: q @ q - 1.0)
    with pytest.raises(ValueError, match=r"holonomic\(q\) must return an array of shape \(c,\).*shape \(1, 2\)"):
        run(lambda q: q[None])
    with pytest.raises(TypeError, match=r"holonomic\(q\[, params\]\) or holonomic\(t, q\[, params\]\), but"):
        run(lambda q, v, w: q)
    with pytest.raises(ValueError, match="holonomic is not finite at the initial data"):
        run(lambda q: jnp.log(q[1:] - 1.0))
