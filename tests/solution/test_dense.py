"""sol.at(t): its order, its ends, batches, derivatives, and what it refuses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax import gallery

HENON = gallery.get("henon-heiles")
TIMES = np.linspace(0.013, 3.97, 101)


@pytest.fixture(scope="module")
def exact():
    return HENON.simulate(dx.Collocation(8), step=0.1, steps=40).at(TIMES)


@pytest.mark.parametrize(
    ("scheme", "order"),
    [
        (dx.Collocation(2), 3),
        (dx.Collocation(4), 5),
        (dx.Collocation(3, nodes="lobatto"), 3),
        (dx.EnergyCollocation(2), 3),
        (dx.LagrangeDAlembert(), 2),
        (dx.DiscreteDirac(), 2),
        (dx.PlusLagrangeDirac(), 1),
        (dx.Composition(dx.LagrangeDAlembert(), "suzuki4"), 4),
    ],
    ids=repr,
)
@pytest.mark.soak_of("Collocation(stages=2, nodes='gauss')-3")
def test_the_order_between_rows(scheme, order, exact):
    errors = []
    for steps in (10, 20, 40):
        found = HENON.simulate(scheme, step=4.0 / steps, steps=steps).at(TIMES)
        errors.append([np.max(np.abs(getattr(found, name) - getattr(exact, name))) for name in ("q", "p")])
    slopes = -np.polyfit(np.arange(3), np.log2(errors), 1)[0]
    assert np.all(slopes > order - 0.25), (slopes, errors)


CONSTRAINED = {
    "rod": (
        dx.LagrangeDirac(lambda q, v: v @ v / 2 - 9.81 * q[1], holonomic=lambda q: jnp.array([(q @ q - 1) / 2])),
        {"q": [0.6, -0.8], "v": [0.8, 0.6]},
    ),
    "blade": (
        dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[0], lambda q: jnp.array([[jnp.sin(q[2]), -jnp.cos(q[2]), 0.0]])),
        {"q": [0.0, 0.0, 0.2], "v": [np.cos(0.2), np.sin(0.2), 0.3]},
    ),
}


@pytest.mark.parametrize("affine", [0.0, 0.2])
@pytest.mark.parametrize(
    ("scheme", "order"),
    [(dx.EnergyCollocation(2), 3), (dx.EnergyCollocation(3), 4), (dx.Collocation(3, nodes="lobatto"), 3)],
    ids=lambda value: repr(value),
)
@pytest.mark.soak_of(but=["EnergyCollocation(stages=2, points=8, frame=None)-3-0.0"])
def test_the_order_between_rows_with_one_forms(scheme, order, affine):
    """A blade in a wind: v = u e − b n with e = (cos φ, sin φ), n = (sin φ, −cos φ), φ̇ = ω and u̇ = bω − cos φ."""
    rows = CONSTRAINED["blade"][0].one_forms.function
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[0], rows, affine=lambda q: jnp.array([affine]))
    begun, rate, speed = 0.2, 1.3, 1.0

    def velocity(t):
        angle = begun + rate * t
        along = speed + affine * rate * t - (np.sin(angle) - np.sin(begun)) / rate
        return np.array([along * np.cos(angle) - affine * np.sin(angle), along * np.sin(angle) + affine * np.cos(angle), rate])

    errors = []
    for step in (0.1, 0.05, 0.025):
        sol = dx.simulate(system, scheme, q=[0.0, 0.0, begun], v=velocity(0.0), step=step, steps=round(1 / step))
        t = 0.4 + step * np.array([0.13, 0.37, 0.81])
        found = sol.at(t)
        errors.append([np.max(np.abs(found.p - np.stack([velocity(at) for at in t])))])
        if affine and "work" in found.fields:
            errors[-1].append(np.max(np.abs(np.sum(found.p**2, axis=1) / 2 + found.q[:, 0] - found.work - sol.energy()[0])))
    slopes = -np.polyfit(np.arange(3), np.log2(errors), 1)[0]
    assert np.all(slopes > order - 0.25), (slopes, errors)


@pytest.mark.parametrize("name", CONSTRAINED)
@pytest.mark.parametrize(
    "scheme",
    [
        dx.Collocation(3, nodes="lobatto"),
        dx.LagrangeDAlembert(),
        dx.DiscreteDirac(constraints="resolve"),
        dx.Composition(dx.LagrangeDAlembert(), "suzuki4"),
    ],
    ids=lambda scheme: type(scheme).__name__,
)
@pytest.mark.soak_of("Collocation-rod", "Collocation-blade", "Composition-rod", "Composition-blade")
def test_the_rows_are_joined(name, scheme):
    system, start = CONSTRAINED[name]
    sol = dx.simulate(system, scheme, step=0.02, steps=8, **start)
    rows = sol.at(sol.t)
    for field in ("q", "p"):
        assert np.max(np.abs(getattr(rows, field) - sol.fields[field])) <= 1e-13
    near = sol.at(0.06 + 0.02 * np.array([-1e-6, 1e-6]))
    assert np.max(np.abs(near.q - sol.q[3])) <= 1e-6 and np.max(np.abs(near.p - sol.p[3])) <= 1e-4
    if "multipliers" in rows.fields:
        assert np.array_equal(sol.at(0.07).multipliers, sol.multipliers[3])


@pytest.mark.parametrize("name", ["rigid-body", "lc-ladder", "heavy-top-so3"])
def test_systems_of_other_kinds(name):
    example = gallery.get(name)
    sol = example.simulate(steps=6)
    fine = example.simulate(step=example.step / 4, steps=24)
    field = "x" if "x" in sol.fields else "q"
    t = sol.t[0] + 2.5 * sol.step
    scale = np.max(np.abs(np.diff(np.asarray(sol.fields[field]), axis=0)))
    assert np.max(np.abs(getattr(sol.at(t), field) - fine.fields[field][10])) <= 0.05 * scale


def test_thinned_rows_and_batches_have_what_single_runs_with_every_row_have():
    q, v = np.array([[0.0, 0.1], [0.1, -0.2]]), np.array([[0.4, 0.0], [0.3, 0.1]])
    own = np.array([[0.1, 1.0, 2.2], [0.4, 0.05, 2.5]])
    for scheme in (dx.Collocation(3), dx.LagrangeDAlembert()):
        batch = dx.simulate(HENON.system, scheme, q=q, v=v, step=0.25, steps=10)
        thin = dx.simulate(HENON.system, dx.Collocation(3), q=q, v=v, step=0.25, steps=10, save_every=4)
        for lane in range(2):
            one = dx.simulate(HENON.system, scheme, q=q[lane], v=v[lane], step=0.25, steps=10)
            assert np.array_equal(batch.at(own).q[lane], one.at(own[lane]).q)
            assert np.array_equal(batch[lane].at(own[lane]).p, one.at(own[lane]).p)
            assert batch.at(1.1).q.shape == (2, 2) and one.at(1.1).q.shape == (2,)
            if isinstance(scheme, dx.Collocation):
                assert np.max(np.abs(thin.at(own).q[lane] - one.at(own[lane]).q)) <= 1e-13


@pytest.mark.parametrize("scheme", [dx.Collocation(2), dx.LagrangeDAlembert()], ids=lambda s: type(s).__name__)
@pytest.mark.soak
def test_derivatives_go_through_it(scheme):
    run = lambda x: dx.simulate(HENON.system, scheme, q=jnp.stack([x, 0.1]), v=jnp.array([0.3, 0.2]), step=0.1, steps=4)
    slope = jax.jit(jax.grad(lambda x: run(x).at(0.237).q[1]))(0.05)
    above, below = (float(run(np.float64(0.05 + e)).at(0.237).q[1]) for e in (1e-5, -1e-5))
    assert abs(slope - (above - below) / 2e-5) <= 1e-9


def test_times_that_are_refused():
    sol = HENON.simulate(dx.Collocation(2), step=0.1, steps=10)
    for t in (-0.1, 1.1, np.nan, [0.5, np.inf]):
        with pytest.raises(ValueError, match=r"inside the run, from 0 to 1, but (-0\.1|1\.1|nan|inf) is not among them"):
            sol.at(t)
    with pytest.raises(TypeError, match="a time or an array of times"):
        sol.at("now")
    with pytest.raises(ValueError, match=r"shape \(1, 1\)"):
        sol.at([[0.5]])
    with pytest.raises(ValueError, match="only one"):
        sol[:1].at(0.0)


@pytest.mark.soak
def test_an_engine_without_scalar_programs_is_not_asked_for_them():
    def lagrangian(q, v):
        return v @ v / 2 - jax.scipy.special.i0(q[0])

    sol = dx.simulate(dx.LagrangeDirac(lagrangian), dx.Collocation(2), q=[0.4], v=[0.2], step=0.1, steps=3, engine="xla")
    assert np.max(np.abs(sol.at(sol.t).q - sol.q)) <= 1e-13
    assert sol.at(0.123).q.shape == (1,)


@pytest.mark.parametrize("scheme", [dx.LagrangeDAlembert(), dx.Composition(dx.LagrangeDAlembert(), "suzuki4")], ids=repr)
@pytest.mark.soak
def test_rows_that_were_not_saved(scheme):
    """They are those of the run, far from saved ones too, and momenta between them have the order of the scheme: half of the
    impulse of the constraints is that of a step of one length before and after."""
    disk = gallery.get("rolling-disk")
    run = lambda h, steps, **more: disk.simulate(scheme, step=h, steps=steps, **more)
    whole, thin = run(0.02, 200), run(0.02, 200, save_every=200)
    some = np.array([3, 70, 141, 199])
    for name in ("q", "p"):
        np.testing.assert_allclose(getattr(thin.at(whole.t[some]), name), getattr(whole, name)[some], rtol=0, atol=1e-13)
    exact = disk.simulate(dx.Collocation(4, "lobatto"), step=0.0125, steps=240)
    times, p = exact.t[[57, 99, 222]], exact.p[[57, 99, 222]]
    errors = [np.max(np.abs(run(0.04 / k, 80 * k, save_every=80 * k).at(times).p - p)) for k in (1, 2, 4)]
    order = 4 if isinstance(scheme, dx.Composition) else 2
    assert np.log2(errors[0] / errors[2]) / 2 > order - 0.25, errors


@pytest.mark.soak
def test_rows_on_manifolds_are_the_runs_own():
    """The polynomial of the momenta meets those of the rows up to its order alone."""
    sol = gallery.get("spherical-pendulums").simulate(dx.Collocation(2), steps=12, save_every=3)
    rows = sol.at(sol.t)
    assert all(np.array_equal(rows.fields[name], sol.fields[name]) for name in ("q", "p"))


@pytest.mark.parametrize("scheme", [dx.LagrangeDAlembert(), dx.Composition(dx.LagrangeDAlembert())])
@pytest.mark.soak_of("scheme0")
def test_momenta_just_after_a_row_have_their_digits(scheme):
    """A step so short has lost its impulses in rounding: p was off by 2e-3 there."""
    sphere = dx.ManifoldLagrangian(lambda q, v: v @ v / 2 - q[2], dx.Sphere(3))
    sol = dx.simulate(sphere, scheme, q=[1.0, 0.0, 0.0], v=[0.0, 1.0, 0.3], step=0.1, steps=9)
    later = np.array([1e-4, 1e-6, 1e-9, 1e-12, 3e-13])
    moved = sol.at(sol.t[7] + later).p - sol.p[7]
    rate = moved[0] / later[0]
    assert np.max(np.abs(moved - later[:, None] * rate) / later[:, None]) <= 1e-3 * np.max(np.abs(rate)) + 1e-16 / later[-1]


@pytest.mark.parametrize("q", [[1.0, 0.0], [[1.0, 0.0], [0.5, 0.0]]], ids=["one", "batch"])
def test_no_times_are_no_moments(q):
    free = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2)
    sol = dx.simulate(free, dx.LagrangeDAlembert(), q=q, v=np.zeros_like(q), step=0.1, steps=4)
    assert sol.at([]).q.shape == (*np.shape(q)[:-1], 0, 2)
