"""`dirax bench`: the programs agree on what they compute, are left out politely, and the table is consistent."""

import importlib.util
import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

import dirax as dx
from dirax import gallery
from dirax.cli.bench import run_machines, subject
from dirax.cli.commands import app
from dirax.diagnostics.bench import casadi_c, hinges, in_drake, in_pinocchio, machines, measure, ode_solvers
from dirax.diagnostics.bench.engines import plain_run
from dirax.diagnostics.bench.measure import PROGRAMS, SAME_STEPS, Bench, Row, bench
from dirax.diagnostics.bench.ode import eliminate, explicit_ode, pivot_order
from dirax.diagnostics.bench.subject import Skipped, Subject
from dirax.diagnostics.bench.timing import compiler, interleaved
from dirax.engines.native import Native
from dirax.gallery import bricard


def call(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def short(name, steps=50):
    return subject(gallery.get(name), steps)


def ode_of(example):
    one = subject(example, 1)
    return explicit_ode(one.system, one.arrays, one.leaves)


# ---------------------------------------------------------------------- the other programs compute the same trajectory


@pytest.mark.parametrize("name", ["kepler", "rolling-disk", "vortices"])
@pytest.mark.soak_of("kepler", "vortices")
def test_plain_jax_takes_the_steps_of_the_native_engine(name):
    s = short(name)
    state, _ = plain_run(s.one)()
    np.testing.assert_allclose(state, Native().run(s.one).last_state[0], rtol=1e-11, atol=1e-11)


@pytest.mark.skipif(importlib.util.find_spec("casadi") is None or compiler() is None, reason="needs casadi and a C compiler")
@pytest.mark.parametrize("name", ["kepler", "rolling-disk", "dc-motor"])
@pytest.mark.soak_of("kepler", "dc-motor")
def test_casadi_c_takes_the_steps_of_the_native_engine(name):
    s = short(name)
    _, state, _ = casadi_c.c_run(s.one)()
    np.testing.assert_allclose(state, Native().run(s.one).last_state[0], rtol=1e-11, atol=1e-11)


def test_batches_begin_along_the_trajectory():
    s = short("kepler", 20)
    rows = Native().run(dx_problem(s, save_every=1))
    batch = s.batch(rows, 5, 3)
    np.testing.assert_allclose(batch.state[:, :2], rows.fields["q"][0, [0, 5, 10, 15, 20]])
    after = Native().run(batch).last_state
    np.testing.assert_allclose(after[1], np.concatenate([rows.fields["q"][0, 8], rows.fields["p"][0, 8]]), rtol=1e-12)


def dx_problem(s, **changes):
    return type(s.one)(**{**vars(s.one), **changes})


# ---------------------------------------------------------------------- explicit equations against known solutions


def test_the_equations_of_a_nonholonomic_system_have_its_exact_solution():
    example = gallery.get("rolling-disk")
    ode = ode_of(example)
    end = ode_solvers.reference_end(ode, 2.0)
    np.testing.assert_allclose(end, example.exact(np.array([2.0]), **example.initial)[0], rtol=1e-10, atol=1e-10)


def test_the_equations_of_a_lagrangian_with_magnetic_and_mass_terms():
    """L = q0² v1²/2 + v0²/2 + q0 v1 − q1: by hand v̇0 = q0 v1² + v1, v̇1 = −(1 + v0 + 2 q0 v0 v1)/q0²."""
    system = dx.LagrangeDirac(lambda q, v: (q[0] * v[1]) ** 2 / 2 + v[0] ** 2 / 2 + q[0] * v[1] - q[1])
    q, v = np.array([1.3, 0.2]), np.array([0.4, -0.7])
    ode = explicit_ode(system, {"q": jnp.asarray(q), "v": jnp.asarray(v)}, None)
    expected = [*v, q[0] * v[1] ** 2 + v[1], -(1 + v[0] + 2 * q[0] * v[0] * v[1]) / q[0] ** 2]
    np.testing.assert_allclose(ode.derivative(0.0, ode.start), expected, rtol=1e-14)
    np.testing.assert_allclose(ode_solvers.compiled_field(ode)(0.0, ode.start), expected, rtol=1e-14)


def test_the_equations_of_a_driven_pendulum_on_a_moving_circle():
    """|q| = R = 1 + .1 sin t with friction: along the circle q̈ is −sin a − .3 R ȧ, outward it is R̈ − R ȧ²; at t = 0, R̈ = 0."""
    system = dx.LagrangeDirac(
        lambda q, v: v @ v / 2 - q[1],
        holonomic=lambda t, q: jnp.array([q @ q - (1 + 0.1 * jnp.sin(t)) ** 2]),
        forces=lambda t, q, v: -0.3 * v,
    )
    angle, rate = 0.4, 0.2
    out, along = np.array([np.sin(angle), -np.cos(angle)]), np.array([np.cos(angle), np.sin(angle)])
    data = {"q": jnp.asarray(out), "v": jnp.asarray(0.1 * out + rate * along)}
    ode = explicit_ode(system, data, None)
    acceleration = np.asarray(ode.derivative(0.0, ode.start))[2:]
    np.testing.assert_allclose(acceleration, (-np.sin(angle) - 0.3 * rate) * along - rate**2 * out, rtol=1e-12)


@pytest.mark.parametrize("name", ["vortices", "lotka-volterra", "heavy-top", "dc-motor"])
@pytest.mark.soak_of("vortices", "heavy-top")
def test_a_fine_run_of_dirax_approaches_the_reference(name):
    """Second order: halving the step quarters the distance, so both solve the same equations."""
    example = gallery.get(name)
    span = 8 * example.step
    reference = ode_solvers.reference_end(ode_of(example), span)
    errors = []
    for parts in (8, 16):
        sol = example.simulate(step=span / parts, steps=parts)
        errors.append(ode_solvers.end_error((sol.x if "x" in sol.fields else sol.q)[-1], reference))
    assert errors[1] < 0.3 * errors[0] < 1e-2, errors


def test_solvers_reach_the_end_error_that_is_asked_for():
    s = short("kepler", 100)
    ode = ode_of(gallery.get("kepler"))
    exact = gallery.get("kepler").exact(np.array([s.span]), **s.initial)[0]
    assert ode_solvers.end_error(ode_solvers.reference_end(ode, s.span), exact) < 1e-11
    errors = []
    for wanted in (1e-2, 1e-8):
        program = ode_solvers.dop853(ode, s.span, exact, wanted)
        program.run()
        errors.append(ode_solvers.end_error(program.end(), exact))
        assert errors[-1] <= wanted
    assert errors[1] < errors[0]
    with pytest.raises(Skipped, match="does not reach"):
        ode_solvers.dop853(ode, s.span, exact + 1e-3, 1e-8)


def test_elimination_with_fixed_pivots():
    rng = np.random.default_rng(0)
    matrix, right = rng.standard_normal((5, 5)), rng.standard_normal(5)
    matrix[0, 0] = 0.0
    order = pivot_order(matrix)
    assert sorted(order) == list(range(5)) and order[0] != 0
    found = eliminate(jnp.asarray(matrix), jnp.asarray(right), order)
    np.testing.assert_allclose(found, np.linalg.solve(matrix, right), rtol=1e-11)


@pytest.mark.parametrize(
    ("system", "data", "reason"),
    [
        (dx.LagrangeDirac(lambda q, v: v[0] ** 2 / 2 - q @ q / 2), {"q": [1.0, 0.0], "v": [0.0, 0.0]}, "singular"),
        (dx.PortHamiltonian(lambda x: x @ x / 2, np.array([[0.0, 1.0], [-1.0, 0.0]]), np.array([[0.0], [1.0]]), closed=True),
         {"x": [0.0, 1.0]}, "off the final manifold"),
        (dx.ImplicitSystem(lambda x: jnp.array([[1.0, 1.0]]), lambda x: x[:1]), {"x": [1.0, 0.0]}, "gauge freedom"),
    ],
)  # fmt: skip
def test_systems_without_an_explicit_equation_are_left_out(system, data, reason):
    with pytest.raises(Skipped, match=reason):
        explicit_ode(system, {k: jnp.asarray(a) for k, a in data.items()}, None)


# ---------------------------------------------------------------------- the table


def test_interleaved_calls_every_program_once_a_round():
    calls = []
    values = interleaved({name: lambda name=name: calls.append(name) or len(calls) for name in "ab"}, 2)
    assert "".join(calls) == "ababab" and values == {"a": [3, 5], "b": [4, 6]}


def test_ratios_are_those_of_the_medians():
    row = Row("one", "scheme", 0.1, 10, {"native": [1e-5, 3e-5, 2e-5], "xla": [8e-5, 6e-5, 1e-4]}, skipped={"heyoka": "no"})
    table = Bench([row], {"processor": "p", "cores": 1, "python": "3", "jax": "0"}, 3)
    assert row.ratio("xla") == pytest.approx(4.0) and row.microseconds == pytest.approx(2.0) and row.ratio("heyoka") is None
    assert "heyoka left out (one): no" in str(table) and len(table.cells()[0]) == len(table.header) == len(PROGRAMS) + 2


def test_missing_libraries_and_compositions_are_left_out(monkeypatch):
    for name in ("casadi", "heyoka", "diffrax", "scipy.integrate"):
        monkeypatch.setitem(sys.modules, name, None)
    oscillator = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2)
    data = {"q": np.array([1.0]), "v": np.array([0.0])}
    scheme = dx.LagrangeDAlembert()
    plain = Subject("spring", oscillator, scheme, data, 0.1, 20)
    composed = Subject("composed", oscillator, dx.Composition(scheme, "yoshida4"), data, 0.1, 20)
    first, second = bench([plain, composed], 1).rows
    assert first.skipped == {
        "CasADi C": "casadi is not installed",
        **dict.fromkeys(("collocation", "heyoka", "DOP853", "diffrax"), "scipy is not installed"),
    }
    assert set(first.seconds) == {"native", "native batch", "xla", "xla batch", "plain JAX", "plain JAX batch"}
    assert not second.seconds and set(second.skipped.values()) == {"the scheme is a composition"}


def test_a_program_that_ends_in_an_error_is_left_out(monkeypatch):
    def broken(problem):
        raise RuntimeError("no such thing\nand more")

    monkeypatch.setitem(SAME_STEPS, "xla", broken)
    monkeypatch.setattr(measure, "explicit_ode", lambda *_: 1 / 0)
    (row,) = bench([short("kepler", 20)], 1).rows
    assert row.skipped["xla"] == "it ended in RuntimeError: no such thing"
    assert row.skipped["DOP853"] == "it ended in ZeroDivisionError: division by zero"
    assert {"native", "native batch", "xla batch", "plain JAX"} <= set(row.seconds) and "xla" not in row.seconds


def test_the_command_measures_and_stores(tmp_path):
    table, picture = tmp_path / "bench.json", tmp_path / "bench.png"
    result = call("bench", "kepler", "--steps", 60, "--repeats", 1, "--json", table, "--plot", picture)
    assert result.exit_code == 0, result.output
    assert "kepler" in result.stdout and "DOP853" in result.stdout
    stored = json.loads(table.read_text("utf-8"))
    assert stored["repeats"] == 1 and stored["machine"]["cores"] >= 1 and stored["machine"]["jax"] == jax.__version__
    (row,) = stored["rows"]
    programs = row["programs"]
    assert row["steps"] == 60
    assert programs["native"]["ratio"] == 1.0 and programs["DOP853"]["end_error"] <= programs["native"]["end_error"]
    assert programs["collocation"]["end_error"] <= programs["native"]["end_error"] and programs["collocation"]["stages"] in (4, 8)
    assert set(programs) | set(row["left_out"]) == set(PROGRAMS)
    assert all(entry["median"] > 0 for entry in programs.values())
    assert picture.stat().st_size > 5000


def test_the_command_refuses_what_it_cannot_do(tmp_path):
    for arguments, message in [
        (("kepplr",), "did you mean 'kepler'"),
        (("kepler", "--plot", tmp_path / "bench.doc"), "must end in"),
        (("kepler", "--json", tmp_path / "no" / "bench.json"), "does not exist"),
    ]:
        result = call("bench", *arguments)
        assert result.exit_code == 1 and message in result.stderr, result.output
    assert call("bench", "kepler", "--repeats", 0).exit_code == 2


def test_machines_are_measured_and_other_programs_are_columns_where_they_are_installed(tmp_path, monkeypatch):
    done = call("bench", "--machines", "--quick", "--steps", "60", "--json", tmp_path / "m.json")
    absent = any(importlib.util.find_spec(module) is None for module in machines.OTHERS.values())
    assert done.exit_code == 0 and ("left out: not installed" in done.output) == absent and "euler-disk" in done.output
    rows = {row["name"]: row for row in json.loads((tmp_path / "m.json").read_text())["rows"]}
    assert rows["car-axis"]["drift"] is None  # its constraints take the time
    assert rows["car-axis"]["constraint"] < 1e-12 and 0 < rows["car-axis"]["error"] < 1e-2
    assert 0 < rows["euler-disk"]["microseconds"] < 1e4 and 0 < rows["euler-disk"]["drift"] < 1e-2
    found, others = importlib.util.find_spec, machines.OTHERS.values()
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name == "mujoco" or (None if name in others else found(name)))
    shown = machines.bench_machines([gallery.get("euler-disk"), gallery.get("car-axis")], 1, 20)
    assert shown.installed == ("MuJoCo",)
    assert [line[-1] for line in shown.cells()] == [machines.NO_ROLLING, machines.NO_TIME]
    asked = []
    monkeypatch.setattr("dirax.cli.bench.bench_machines", lambda examples, *_: asked.extend(e.name for e in examples))
    run_machines(["four-bar", "bicycle"], 1, True)
    assert asked == ["four-bar", "bicycle", "bicycle M1", "bicycle M2", "bicycle M3"]
    refused = call("bench", "--machines", "kepler")
    assert refused.exit_code and "'kepler' is no machine" in refused.output


def test_the_same_machine_is_stated_for_mujoco():
    """Its joints, its places and its loops; where the program is installed, the motion is the same but for its soft loops."""
    from xml.etree import ElementTree

    from dirax.diagnostics.bench import in_mujoco

    example = gallery.get("four-bar")
    root = ElementTree.fromstring(in_mujoco.mjcf(example.model, 0.01))
    names = [joint.get("name") for joint in root.iter("joint")]
    ends = {body.get("name"): [site.get("name") for site in body.findall("site")] for body in root.iter("body")}
    loops = [(loop.get("site1"), loop.get("site2")) for loop in root.iter("connect")]
    assert sorted(names) == sorted(example.model.coordinates)
    assert loops == list(zip(ends["right"], ends["coupler"], strict=True)) and len(loops) == 2  # two points of the hinge's axis
    assert in_mujoco.is_stated(example.model) and not in_mujoco.is_stated(gallery.get("bicycle").model)
    pytest.importorskip("mujoco")
    assert error_by(in_mujoco, example) < 0.01


def error_by(program, example):
    """How far a program is after a second from steps of a tenth of the size."""
    cell = program.measured(example, 100, example.simulate(step=example.step / 10, steps=1000).q[-1], 1)
    return float(cell.split("error ")[1].split(",")[0])


def test_the_points_of_a_hinge_that_closes_a_loop_coincide():
    """Also where joints are away from the origin of their body's frame; and branches of the tree follow one another."""
    model = bricard.MODEL
    data = model.state({"rod 1": 0.2})
    frames = model.frames(data["q"], data["v"])
    starts, pairs = hinges.joint_frames(model), hinges.closing_points(model)
    assert len(pairs) == 2 and np.linalg.norm(pairs[1][0][1] - pairs[0][0][1]) == pytest.approx(1.0)
    for pair in pairs:
        first, second = (np.asarray(frames[name].point(x - starts[name])) for name, x in pair)
        assert first == pytest.approx(second, abs=1e-10)
    order = [joint.body for joint in hinges.branch_by_branch(gallery.get("four-bar").model)]
    assert order == ["left", "coupler", "right"]
    assert not in_drake.is_stated(model) and in_drake.is_stated(gallery.get("four-bar").model)


@pytest.mark.parametrize("name", ["pinocchio", "pydrake"])
@pytest.mark.parametrize("machine", ["robot-arm", "four-bar"])
def test_the_same_machine_is_stated_for_pinocchio_and_drake(name, machine):
    pytest.importorskip(name)
    assert error_by({"pinocchio": in_pinocchio, "pydrake": in_drake}[name], gallery.get(machine)) < 0.01


def test_the_same_machine_is_stated_for_exudyn():
    """Hinges, slides, balls and rolling; where the program is installed, the motion is the same as far as the step allows."""
    from dirax.diagnostics.bench import in_exudyn
    from dirax.gallery.bicycle import MANOEUVRES

    stated = {name: in_exudyn.is_stated(gallery.get(name).model) for name in ("bicycle", "four-bar", "euler-disk", "car-axis")}
    assert stated == {"bicycle": True, "four-bar": True, "euler-disk": False, "car-axis": False}  # thick, and no bodies
    pytest.importorskip("exudyn")
    example, steps = MANOEUVRES[1], 50
    end = example.simulate(step=example.step / 4, steps=4 * steps).q[-1]
    _, apart, energy = in_exudyn.measured(example, steps, end, 1).split(", ")
    assert float(apart.split()[1]) < 1e-3 and float(energy.split()[1]) < 1e-5
