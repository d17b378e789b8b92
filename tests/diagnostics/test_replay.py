"""verify() takes every step again: a saved number off by a millionth is seen, in any field, and no right run is accused."""

import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax import gallery
from dirax.diagnostics.replay_lines import replayed
from dirax.numerics.inverses import LARGE

DAMAGE = 1e-6

PENDULUM = dx.LagrangeDirac(lambda q, v: v @ v / 2 - 9.81 * q[1], holonomic=lambda q: jnp.array([(q @ q - 1) / 2]))
HANGING = {"q": [np.sin(0.5), -np.cos(0.5)], "v": [0.0, 0.0]}
BLADE = dx.LagrangeDirac(
    lambda q, v: v @ v / 2 + 0.3 * v[2] ** 2 + q[0] + 0.2 * jnp.sin(q[1]),
    one_forms=lambda q: jnp.array([[jnp.sin(q[2]), -jnp.cos(q[2]), 0.0]]),
    forces=lambda t, q, v: -0.3 * v,
)
GLIDING = {"q": [0.0, 0.0, 0.4], "v": [np.cos(0.4), np.sin(0.4), 1.5]}
BLADE_WITHOUT_FORCES = dx.LagrangeDirac(lambda q, v: v @ v / 2 + 0.3 * v[2] ** 2 + q[0], BLADE.one_forms.function)
DRIVEN = dx.LagrangeDirac(
    lambda t, q, v: v @ v / 2 - q @ q / 2 + jnp.sin(t) * q[0], forces=lambda t, q, v, params: -params["c"] * v
)
CIRCUIT = dx.PortHamiltonian(
    lambda x: x[0] ** 2 / 2 + x[1] ** 4 / 4,
    np.array([[0.0, 1.0], [-1.0, 0.0]]),
    np.array([[0.0], [1.0]]),
    np.diag([0.0, 0.2]),
    inputs=lambda t, x: jnp.array([jnp.sin(t)]),
)
PLUS, MINUS, MIDPOINT = dx.PlusLagrangeDirac(), dx.MinusLagrangeDirac(), dx.LagrangeDAlembert()

RUNS = {
    "plain": (BLADE, MIDPOINT, GLIDING),
    "plus": (BLADE, PLUS, GLIDING),
    "minus": (BLADE_WITHOUT_FORCES, MINUS, GLIDING),
    "holonomic": (PENDULUM, MIDPOINT, HANGING),
    "holonomic plus": (PENDULUM, PLUS, HANGING),
    "Method 1": (BLADE, dx.DiscreteDirac(), GLIDING),
    "Method 2": (BLADE, dx.DiscreteDirac(constraints="resolve"), GLIDING),
    "composed": (PENDULUM, dx.Composition(MIDPOINT, "suzuki4"), HANGING),
    "composed with one-forms and forces": (BLADE, dx.Composition(MIDPOINT, "yoshida4"), GLIDING),
    "symmetric composition": (PENDULUM, dx.SymmetricComposition(PLUS), HANGING),
    "composed Method 1": (BLADE_WITHOUT_FORCES, dx.Composition(dx.DiscreteDirac(), "yoshida4"), GLIDING),
    "adjoint": (DRIVEN, dx.Adjoint(dx.DiscreteDirac(dx.Theta(0.3))), {"q": [1.0, 0.2], "v": [0.0, 0.5], "params": {"c": 0.1}}),
    "collocation": (DRIVEN, dx.Collocation(3), {"q": [1.0, 0.2], "v": [0.0, 0.5], "params": {"c": 0.1}}),
    "collocation with one-forms": (BLADE, dx.Collocation(3, nodes="lobatto"), GLIDING),
    "discrete gradient": (CIRCUIT, dx.DiscreteGradient(), {"x": [0.4, 0.1]}),
    "discrete gradient at rest": (CIRCUIT, dx.DiscreteGradient(), {"x": [0.0, 0.0]}),
}


def run(name, **options):
    system, scheme, start = RUNS[name]
    return dx.simulate(system, scheme, **({"step": 0.02, "steps": 60} | start | options))


def damaged(sol, seed=0, times=2):
    """The run with one saved number off by a millionth of the largest of its field: each field `times` times."""
    draw = np.random.default_rng(seed)
    for name, values in sol.fields.items():
        for _ in range(times):
            changed = np.array(values)
            place = tuple(draw.integers(size) for size in changed.shape)
            largest = np.nanmax(np.abs(changed))
            changed[place] += DAMAGE * (largest if largest > 1e-9 else 1.0)
            yield f"{name}{list(map(int, place))}", sol.replace(fields=sol.fields | {name: changed})


def side_by_side(sols):
    """Runs as the trajectories of one batch."""
    first = sols[0]
    join = lambda *arrays: np.stack(arrays) if first.batch is None else np.concatenate(arrays)
    joined = lambda of: jax.tree.map(join, *map(of, sols))
    params = {"params": joined(lambda sol: sol.given_params)} if first.batch_params else {}
    messages = np.ravel([sol.message for sol in sols]).tolist()
    return first.replace(fields=joined(lambda sol: sol.fields), ok=joined(lambda sol: sol.ok), message=messages, **params)


def assert_seen(sol, but: tuple[str, ...] = (), alone: bool = False):
    """Damages are looked for all at once, each in a trajectory of its own, and that of a time, which they share, alone. With
    `alone` every damage is, which takes longer: one a field, and none of a time."""
    assert (line := replayed(sol, None)).verdict == "ok", line
    names, sols = zip(*damaged(sol, times=1 if alone else 2), strict=True)
    if alone:
        seen = [name.startswith(but) or replayed(one, None).verdict == "VIOLATED" for name, one in zip(names, sols, strict=True)]
    else:
        line = replayed(side_by_side(sols), None)
        seen = np.max(np.reshape(line.details["per_trajectory"], (len(sols), -1)), axis=1) > line.tolerance
    assert [name for name, this in zip(names, seen, strict=True) if not this and not name.startswith(but)] == []
    if not alone:
        t = np.array(sol.t)
        t[len(t) // 2] += DAMAGE * sol.step
        assert replayed(sol.replace(t=t), None).verdict == "VIOLATED"


@pytest.mark.parametrize("name", RUNS)
@pytest.mark.soak_of(but=["plus", "collocation"])
def test_every_damage_is_seen(name):
    assert_seen(run(name))


@pytest.mark.parametrize("name", ["plain", pytest.param("composed", marks=pytest.mark.soak), "discrete gradient", "holonomic"])
@pytest.mark.soak
def test_also_where_not_every_step_is_saved(name):
    assert_seen(run(name, save_every=7))


FAR = 10_000


@pytest.mark.parametrize("name", ["plain", "holonomic", "discrete gradient"])
@pytest.mark.soak_of("plain", "holonomic")
def test_also_where_rows_are_far_apart(name):
    """In a moment: the steps are taken by the engine of the run."""
    sol = run(name, step=0.005, steps=3 * FAR, save_every=FAR)
    begun = time.perf_counter()
    line = replayed(sol, None)
    assert line.verdict == "ok" and time.perf_counter() - begun < 5.0
    for field in sol.equation.fields:
        if field not in ("constraint", "power", "power_terms", "work") and len(sol.fields[field]):
            changed = np.array(sol.fields[field])
            changed[1] *= 1.0 + DAMAGE
            assert replayed(sol.replace(fields=sol.fields | {field: changed}), None).verdict == "VIOLATED", field


@pytest.mark.parametrize(("apart", "verdict"), [(100, "ok"), (1000, "ok"), (FAR, "not checked")])
@pytest.mark.soak_of("100-ok", "1000-ok")
def test_roundoff_that_many_chaotic_steps_enlarge_is_no_damage(apart, verdict):
    potential = lambda q: 9.81 * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))
    system = dx.LagrangeDirac(lambda q, v: v[0] ** 2 + v[1] ** 2 / 2 + v[0] * v[1] * jnp.cos(q[0] - q[1]) + potential(q))
    sol = dx.simulate(system, MIDPOINT, q=[2.0, 1.0], v=[0.0, 0.0], step=0.02, steps=6 * apart, save_every=apart)
    line = replayed(sol, None)
    assert line.verdict == verdict
    assert verdict == "ok" or "roundoff grows to the size of what is saved" in line.explanation


def hanging(links):
    """Points on rods, from rest: what is solved for is all zero, or far from it, where it begins."""

    def lengths(q):
        ends = jnp.concatenate([jnp.zeros((1, 2)), q.reshape(links, 2)])
        return (jnp.sum(jnp.diff(ends, axis=0) ** 2, axis=1) - 1 / links**2) * links / 2

    height = lambda q: jnp.sum(q.reshape(links, 2)[:, 1])
    return dx.LagrangeDirac(
        lambda q, v: (v @ v / 2 - 9.81 * height(q)) / links, holonomic=lengths, forces=lambda t, q, v: -0.1 * v / links
    )


@pytest.mark.parametrize(("scheme", "links"), [(MIDPOINT, 12), (dx.DiscreteDirac(constraints="resolve"), 5)])
@pytest.mark.soak
def test_also_of_many_unknowns(scheme, links):
    q = np.stack([np.arange(1, links + 1) / links, np.zeros(links)], axis=1).ravel()
    sol = dx.simulate(hanging(links), scheme, q=q, v=0 * q, step=1e-3, steps=10, save_every=2)
    assert sol.stats["unknowns"] > LARGE
    assert "could not be solved" not in replayed(sol, None).explanation
    # of the first momentum a step of Method 2 sees nothing along the forces of constraints; the last two are not solved for
    assert_seen(sol, but=("p[0,", "constraint", "work"), alone=True)


def test_also_in_a_batch():
    start = {
        "q": np.array([[1.0, 0.2], [0.4, 0.3], [0.0, -2.0]]),
        "v": np.ones((3, 2)),
        "params": {"c": np.array([0.1, 0.2, 0.0])},
    }
    assert_seen(run("collocation", batch_params=True, **start))


@pytest.mark.parametrize("scheme", [PLUS, MINUS, MIDPOINT])
def test_also_from_two_points(scheme):
    angle = dx.LagrangeDirac(lambda q, v: v @ v / 2 + 9.81 * jnp.cos(q[0]))
    assert_seen(dx.simulate(angle, scheme, q0=[0.5], q1=[0.51], step=0.02, steps=60))


@pytest.mark.soak
def test_also_on_manifolds():
    sphere = dx.Sphere(3)
    system = dx.ManifoldLagrangian(lambda q, v: v @ v / 2 - 9.81 * q[2], sphere)
    for scheme in (dx.InCharts(dx.RiemannianExp(sphere)), dx.DiscreteDirac(dx.SphereProjection())):
        assert_seen(dx.simulate(system, scheme, q=[1.0, 0.0, 0.0], v=[0.0, 2.0, 0.0], step=0.05, steps=60))


@pytest.mark.soak
def test_a_run_that_fails_is_replayed_up_to_its_end():
    falling = dx.LagrangeDirac(lambda q, v: v @ v / 2 - jnp.log(q[0]))
    sol = dx.simulate(falling, MIDPOINT, q=[1.0], v=[0.0], step=0.1, steps=60)
    assert not sol.ok
    assert sol.rows > 5
    assert_seen(sol)


@pytest.mark.soak
def test_the_xla_engine_compensated_sums_and_files(tmp_path):
    for options in ({"engine": "xla"}, {"compensated": True}):
        assert replayed(run("plain", **options), None).verdict == "ok"
    system, _, _ = RUNS["composed with one-forms and forces"]
    run("composed with one-forms and forces").save(tmp_path / "run.nc")
    assert replayed(dx.load(tmp_path / "run.nc"), None).verdict == "not checked"
    assert replayed(dx.load(tmp_path / "run.nc", system=system), None).verdict == "ok"


def test_a_scheme_whose_state_is_not_saved_says_so():
    class Hidden(dx.AbstractScheme):
        def step_equation(self, system, shape):
            whole = MIDPOINT.step_equation(system, shape)
            fields = {"q": dx.Field((shape.n,))}
            return dataclasses.replace(whole, unpack=lambda *a: {"q": whole.unpack(*a)["q"]}, fields=fields)

    sol = dx.simulate(dx.LagrangeDirac(lambda q, v: (v @ v - q @ q) / 2), Hidden(), q=[1.0], v=[0.0], step=0.1, steps=9)
    line = replayed(sol, None)
    assert line.verdict == "not checked"
    assert "does not start from a saved row" in line.explanation


@pytest.mark.soak
def test_another_solution_of_the_equations_of_a_step_is_one():
    """sin has many: which of them Newton's method finds is no matter of right and wrong, and one is told from none."""
    pendulum = dx.LagrangeDirac(lambda q, v: v @ v / 2 + jnp.cos(q[0]))
    sol = dx.simulate(pendulum, dx.LagrangeDAlembert(), q=[1.0], v=[0.7], step=1000.0, steps=40)
    assert sol.ok and dx.verify(sol)["steps replayed"].verdict == "ok"
    for name, row, off in (("q", 17, 1e-9), ("p", 17, 1e-6), ("q", 30, 1e-9)):
        changed = np.array(sol.fields[name])
        changed[row] *= 1.0 + off
        assert dx.verify(sol.replace(fields=sol.fields | {name: changed}))["steps replayed"].verdict == "VIOLATED", (name, row)


@pytest.mark.parametrize(("scheme", "width", "rows"), [("yoshida4", 2e-3, (40, -1)), ("suzuki4", 5e-4, (-1,))])
@pytest.mark.soak
def test_also_of_several_solutions_of_parts_of_steps(scheme, width, rows):
    """A block that comes to rest by friction: back in time it may have come from either side, or have rested."""
    block = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2, forces=lambda t, q, v: -0.3 * jnp.tanh(v / width))
    sol = dx.simulate(block, dx.Composition(MIDPOINT, scheme), q=[-0.12], v=[0.03], step=0.01, steps=60)
    assert replayed(sol, None).verdict == "ok"
    for name, row, off in (("q", 3, 1e-9), *(("p", row, 1e-6) for row in rows)):
        changed = np.array(sol.fields[name])
        changed[row] += off
        assert replayed(sol.replace(fields=sol.fields | {name: changed}), None).verdict == "VIOLATED", (name, row)


def test_a_network_with_a_diode_is_replayed():
    """Multipliers far from those of the step lead Newton's method to an exponential that only comes down by a constant."""
    diode = lambda u: 0.2 * (jnp.exp(2 * u) - 1)
    parts = [("R", 1, 0, 1.0), ("R", 2, 1, 5.0), ("I", 1, 0, 10.0), ("L", 2, 0, 0.3), ("R", 2, 1, diode)]
    sol = dx.simulate(dx.circuit(parts), dx.DiscreteDirac(), x=[0.0], step=0.05, steps=20)
    line = replayed(sol, None)
    assert line.verdict == "ok" and "could not" not in line.explanation


ROLLING = dx.LagrangeDirac(
    lambda q, v: v @ v / 2 - q @ q / 2 - q[0] ** 4, one_forms=lambda q: jnp.array([[-0.3, jnp.sin(q[0]), 1.0]])
)
INSIDE, AT_THE_END = [("q", 9, 1e-9), ("p", 9, 1e-6), ("multipliers", 9, 1e-6)], [("q", -1, 1e-9)]
RUNS_OF_SEVERAL_ROOTS = [
    (1.5, 54, 160, INSIDE + AT_THE_END),
    (1.0, 13, 30, INSIDE[1:2] + AT_THE_END),
    (1.0, 26, 30, INSIDE[1:2]),
]


@pytest.mark.parametrize(("h", "seed", "steps", "damages"), RUNS_OF_SEVERAL_ROOTS)
@pytest.mark.soak
def test_also_where_the_step_after_says_what_a_row_holds(h, seed, steps, damages):
    """Mean momenta belong to the steps on both sides, each with several solutions; the last two runs fail, and no step says which
    momentum their last row has. The last one is followed rightly only from a very short step on, which takes its time."""
    start = np.random.default_rng(seed)
    q, v = start.normal(size=3) / 2, start.normal(size=3) / 2
    sol = dx.simulate(ROLLING, MIDPOINT, q=q, v=v, step=h, steps=steps, project=True)
    assert replayed(sol, None).verdict == "ok" and sol.ok == (h == 1.5)
    for name, row, off in damages:
        changed = np.array(sol.fields[name])
        changed[row] *= 1.0 + off
        assert replayed(sol.replace(fields=sol.fields | {name: changed}), None).verdict == "VIOLATED", (name, row)


@pytest.mark.parametrize(
    ("name", "scheme"),
    [
        ("knife-edge", dx.Collocation(2, "lobatto")),
        ("spherical-pendulums", dx.LagrangeDAlembert()),
        ("mass-spring-damper", dx.DiscreteGradient()),
        ("suslov", None),
    ],
)
@pytest.mark.soak_of(but=["knife-edge-scheme0"])
def test_a_part_of_a_run_is_right_where_the_run_is(name, scheme):
    """Its first row is none that a run began at: what no row holds goes on from there. A damage is seen as in the whole."""
    part = gallery.get(name).simulate(*([scheme] if scheme else []), steps=14)[4:11]
    assert dx.verify(part).ok, dx.verify(part)
    field = "x" if "x" in part.fields else "p"
    values = np.array(part.fields[field])
    values[3, 0] += 1e-6 * np.abs(values).max()
    assert replayed(part.replace(fields=part.fields | {field: values}), None).verdict == "VIOLATED"


@pytest.mark.parametrize("scheme", [dx.LagrangeDAlembert(), dx.LagrangeDAlembert("left"), dx.LagrangeDAlembert("trapezoidal")])
@pytest.mark.parametrize("way", ["held", "interpolated"])
@pytest.mark.soak_of(but=["held-scheme1"])
def test_a_control_in_a_table_hides_no_damage(scheme, way):
    """Rounding noise moved the index: what the steps say seemed to be known to nothing. t/h is a whole number at every row."""
    h, steps = 0.1, 50
    u, times = jnp.asarray(np.random.default_rng(0).normal(size=steps + 1)), jnp.arange(steps + 1.0) * h
    held = lambda t, u: u[jnp.clip(jnp.floor(t / h).astype(int), 0, steps)]
    control = held if way == "held" else lambda t, u: jnp.interp(t, times, u)
    forces = lambda t, q, v, params: control(t, params["u"])[None] - 0.1 * v
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2, forces=forces)
    sol = dx.simulate(system, scheme, q=[1.0], v=[0.0], params={"u": u}, step=h, steps=steps)
    assert sol.stats["engine"] == "native" and dx.verify(sol).ok
    for row in (1, 43, 44, steps):
        damaged = np.array(sol.q)
        damaged[row] += 1e-8
        assert replayed(sol.replace(fields={**sol.fields, "q": damaged}), None).verdict == "VIOLATED", row


def test_every_row_of_a_short_run_of_a_large_system_is_taken_again():
    """Of 301 rows of five bobs on rods 22 were, and damage between them was not seen."""
    n = 5

    def rods(q):
        ends = jnp.concatenate([jnp.zeros((1, 2)), q.reshape(n, 2)])
        return jnp.sum(jnp.diff(ends, axis=0) ** 2, axis=1) - 1

    chain = dx.LagrangeDirac(lambda q, v: v @ v / 2 - 9.81 * jnp.sum(q[1::2]), holonomic=rods, forces=lambda t, q, v: -0.1 * v)
    q = np.cumsum(np.tile([0.6, -0.8], (n, 1)), axis=0).ravel()
    sol = dx.simulate(chain, dx.DiscreteDirac(constraints="resolve"), q=q, v=0 * q, step=0.01, steps=300)
    work = np.array(sol.work)
    work[157] *= 1 + 1e-3
    damaged = sol.replace(fields={**sol.fields, "work": work})
    assert dx.verify(sol)["steps replayed"].explanation.startswith("every number of each row")
    assert dx.verify(damaged)["steps replayed"].verdict == "VIOLATED"
