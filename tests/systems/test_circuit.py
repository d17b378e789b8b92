"""dx.circuit: linear ones as implicit systems, diode-like resistors and sources in time as Circuits, against exact solutions."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import dirax as dx

MIDPOINT = dx.DiscreteDirac()
DIODE = ("R", 1, 2, lambda u: 0.1 * jnp.expm1(5.0 * u))


@pytest.mark.soak
def test_a_transformer_transforms_an_inductor():
    """A capacitor sees n²L through a transformer: ω = 1/√(n² L C)."""
    system = dx.circuit([("C", 1, 0, 2.0), ("T", (1, 0), (2, 0), 3.0), ("L", 2, 0, 0.5)])
    assert isinstance(system, dx.ImplicitSystem)
    sol = dx.simulate(system, dx.Composition(MIDPOINT, "suzuki8"), x=[1.0, 0.0], step=0.5, steps=40)
    np.testing.assert_allclose(sol.x[:, 0], 1.0 * np.cos(sol.t / 3.0), atol=1e-10)


@pytest.mark.parametrize("value", [2.0, lambda t: 2.0 + 0.0 * t], ids=["constant", "function"])
def test_a_current_source_charges_a_capacitor(value):
    """From the ground into node 1: q̇ = I − u/R, q = I R C (1 − exp(−t/RC))."""
    system = dx.circuit([("I", 0, 1, value), ("C", 1, 0, 0.5), ("R", 1, 0, 4.0)])
    sol = dx.simulate(system, MIDPOINT, x=[0.0], step=0.01, steps=200)
    np.testing.assert_allclose(sol.x[:, 0], 4.0 * (1 - np.exp(-sol.t / 2.0)), atol=1e-4)


def test_a_diode_discharges_a_capacitor_as_it_should():
    """q̇ = −I_s (exp(q/C v) − 1), solved by exp(−u/v) − 1 = (exp(−u_0/v) − 1) exp(−…): w = 1 − e^{−5u} decays by e^{−t/2}."""
    system = dx.circuit([("C", 1, 0, 1.0), ("R", 1, 0, lambda u: 0.1 * jnp.expm1(5.0 * u))])
    assert isinstance(system, dx.Circuit)
    errors = []
    for step in (0.02, 0.01):
        sol = dx.simulate(system, MIDPOINT, x=[0.8], step=step, steps=round(2 / step))
        w = (1 - np.exp(-4.0)) * np.exp(-0.5 * sol.t)
        errors.append(np.max(np.abs(sol.x[:, 0] + np.log1p(-w) / 5.0)))
    assert errors[1] < 2e-4 and np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("engine", ["native", "xla"])
@pytest.mark.soak_of("xla")
def test_the_books_of_a_rectifier_close(engine):
    """The midpoint rule keeps a quadratic energy but for what sources and resistors exchange, to roundoff."""
    netlist = [("V", 1, 0, lambda t: jnp.sin(t)), DIODE, ("C", 2, 0, 2.0), ("L", 2, 3, 1.0), ("R", 3, 0, 5.0)]
    system = dx.circuit(netlist)
    sol = dx.simulate(system, MIDPOINT, x=[0.0, 0.0], step=0.05, steps=200, engine=engine)
    assert sol.ok and sol.stats["engine"] == engine
    e1, e2, e3, current = sol.multipliers.T
    np.testing.assert_allclose(e1, np.sin(sol.t[:-1] + 0.025), atol=1e-13)
    lost = np.asarray(jax.vmap(DIODE[3])(e1 - e2)) * (e1 - e2) + e3**2 / 5.0
    np.testing.assert_allclose(np.diff(sol.energy()), 0.05 * (-e1 * current - lost), atol=1e-14)
    assert sol.x[-1, 0] > 0.5 and "drifts" not in str(dx.verify(sol)).split("energy")[0]


def test_a_linear_circuit_is_the_same_as_a_function():
    """One with a constant source stated as a number and one stated as a function of the time."""
    elements = [("C", 2, 0, 2.0), ("R", 1, 2, 3.0), ("L", 2, 0, 1.5)]
    one, other = (
        dx.simulate(dx.circuit([("V", 1, 0, value), *elements]), MIDPOINT, x=[0.3, 0.1], step=0.05, steps=50)
        for value in (1.5, lambda t: 1.5 + 0.0 * t)
    )
    np.testing.assert_allclose(one.x, other.x, atol=1e-13)
    np.testing.assert_allclose(one.multipliers, other.multipliers, atol=1e-12)


@pytest.mark.parametrize(
    "element, error, message",
    [
        (("D", 1, 0, 1.0), ValueError, "an element is"),
        (("R", 1, 1, 1.0), ValueError, "between two nodes"),
        (("L", 1, 0, -1.0), ValueError, "value > 0"),
        (("T", 1, 0, 1.0), ValueError, r"a transformer is \(T, \(a, b\), \(c, d\), ratio\)"),
        (("C", 1, 0, lambda t: t), TypeError, r"capacitance\(\[, params\]\), .* where t stands in the place of params"),
        (("C", 1, 0, lambda: 1.0), TypeError, r"capacitance must be a number, the name of .* function capacitance\(params\)"),
        (("T", (1, 0), (2, 0), "n"), TypeError, "only C, L, R, V and I may be functions, or names of params; .* was given"),
        (("V", 1, 0, None), TypeError, "a finite number, or, but for T, the name of one of the params or a function"),
        (("R", 1, 0, lambda u: -u), ValueError, "has the sign of its voltage"),
        (("R", 1, 0, lambda u: u / (1 + 100 * u * u)), ValueError, "never falls"),
        (("C", 5, 6, 1.0), ValueError, "not connected to the ground"),
        (("C", "a", 0, 1.0), TypeError, "nodes are whole numbers, 0 that of the ground"),
        (("C", None, 0, 1.0), TypeError, "nodes are whole numbers"),
        (("T", (1, 1), (2, 0), 1.0), ValueError, "between two nodes"),
        (("T", (1, 0), (2, 0), 0.0), ValueError, "ratio of a transformer is not zero"),
        (("V", 1, 0, math.sin), TypeError, r"voltage\(t\) could not be traced"),
        (("V", 1, 0, lambda t: jnp.stack([t, t])), TypeError, r"voltage\(t\) must return one number, .* shape \(2,\)"),
        (("I", 1, 0, lambda t, phase, more: t + phase), TypeError, r"current\(t\[, params\]\), but <lambda> takes 3 arguments"),
        (("R", 1, 0, lambda u: u if u > 0 else 0.0), TypeError, r"current\(u\) could not be traced .* jnp\.where"),
        (("R", 1, 0, lambda u: jnp.expm1(2000 * u)), ValueError, "it is inf"),
    ],
)
def test_what_is_no_element_is_refused(element, error, message):
    with pytest.raises(error, match=message):
        dx.circuit([("C", 1, 0, 1.0), element])


@pytest.mark.parametrize("netlist", [[], None, "C 1 0 2", {"C": 1}])
def test_what_is_no_netlist_is_refused(netlist):
    with pytest.raises(TypeError, match="netlist must be a list of elements"):
        dx.circuit(netlist)


def test_data_of_the_wrong_length_and_off_the_laws():
    for resistor in (2.0, lambda u: u / 2.0):
        system = dx.circuit([("C", 1, 0, 1.0), ("R", 1, 0, resistor)])
        with pytest.raises((TypeError, ValueError), match=r"x are the charges and then the fluxes .*, 1 numbers, not 2"):
            dx.simulate(system, MIDPOINT, x=[0.0, 1.0], step=0.1, steps=2)
    system = dx.circuit([("V", 1, 0, jnp.sin), ("C", 1, 0, 1.0)])
    with pytest.raises(ValueError, match="x are the charges"):
        dx.simulate(system, MIDPOINT, x=[0.0, 1.0], step=0.1, steps=2)
    with pytest.raises(ValueError, match="off the constraint"):
        dx.simulate(system, MIDPOINT, x=[1.0], step=0.1, steps=2)


@pytest.mark.parametrize(
    ("netlist", "message"),
    [
        ([("V", 1, 0, 1.0), ("V", 1, 0, 2.0), ("C", 1, 0, 1.0)], r"\('V', 1, 0, 2\.0\) contradicts .* node 1 is at 1 of node 0"),
        ([("V", 2, 1, 0.5), ("V", 1, 0, 1.0), ("V", 0, 2, 1.5), ("C", 1, 0, 1.0)], r"node 0 is at -1\.5 of node 2"),
        (
            [("I", 0, 1, 2.0), ("I", 1, 0, 0.5), ("C", 2, 0, 1.0)],
            r"nodes \[1\] of the circuit, into which 1\.5 flows",
        ),
        ([("I", 0, 1, 2.0), ("R", 1, 2, 1.0), ("C", 3, 0, 1.0)], r"nodes \[1, 2\] of the circuit, into which 2 flows"),
    ],
)
def test_sources_that_contradict_each_other(netlist, message):
    with pytest.raises(ValueError, match=f"{message}.*no initial data help"):
        dx.circuit(netlist)


def test_sources_that_agree_are_not_refused():
    dx.circuit([("V", 1, 0, 0.1), ("V", 2, 1, 0.2), ("V", 2, 0, 0.3), ("C", 1, 0, 1.0)])
    dx.circuit([("V", 1, 0, 1.0), ("V", 1, 0, jnp.cos), ("C", 1, 0, 1.0)])  # what functions are is not looked at
    dx.circuit([("I", 0, 1, 2.0), ("I", 1, 0, 2.0), ("I", 1, 2, 1.0), ("R", 2, 0, 1.0), ("C", 1, 0, 1.0)])
    dx.circuit([("I", 0, 1, 2.0), ("T", (1, 0), (2, 0), 3.0), ("L", 2, 0, 1.0)])


def test_a_circuit_without_state_is_refused_and_arrays_of_one_number_are_numbers():
    with pytest.raises(ValueError, match="no capacitor and no inductor"):
        dx.circuit([("V", 1, 0, 1.0), ("R", 1, 0, 2.0)])
    ends = []
    for value in (2.0, np.array(2.0), jnp.asarray(2.0), np.float32(2.0)):
        tank = dx.circuit([("C", 1, 0, value), ("L", 1, 0, 1.0)])
        ends.append(dx.simulate(tank, dx.DiscreteDirac(), x=[1.0, 0.0], step=0.1, steps=5).x[-1])
    assert all(np.array_equal(end, ends[0]) for end in ends)


def test_circuits_that_are_stated_anew_are_equal():
    stated = lambda: dx.circuit([("V", 1, 0, lambda t: jnp.sin(t)), ("R", 1, 2, lambda u: u + u**3), ("C", 2, 0, 1.0)])
    assert stated() == stated()


OF_PARAMS = [
    ("V", 1, 0, lambda t, params: params["amplitude"] * jnp.sin(t)),
    ("R", 1, 2, "resistance"),
    ("R", 2, 0, lambda u, params: u / params["load"]),
    ("C", 2, 0, lambda params: params["tau"] / params["resistance"]),
]
VALUES = {"amplitude": 1.5, "resistance": 2.0, "load": 4.0, "tau": 0.7}


def charge(t, amplitude, resistance, load, tau):
    """q̇ = A sin(t)/R − q/T with 1/T = (1 + R/R')/τ, from q = 0."""
    rate = (1 + resistance / load) / tau
    return amplitude / resistance * (rate * np.sin(t) - np.cos(t) + np.exp(-rate * t)) / (1 + rate**2)


@pytest.mark.parametrize("engine", ["native", pytest.param("xla", marks=pytest.mark.soak)])
def test_values_of_params(engine):
    """A closed form; and the derivative of the last charge in each of the params against differences of runs."""
    system = dx.circuit(OF_PARAMS)

    def run(params):
        return dx.simulate(system, MIDPOINT, x=[0.0], step=0.01, steps=200, params=params, engine=engine)

    sol = run(VALUES)
    np.testing.assert_allclose(sol.x[:, 0], charge(sol.t, **VALUES), atol=1e-5)
    np.testing.assert_allclose(sol.energy(), sol.x[:, 0] ** 2 / (2 * 0.35), rtol=1e-14)
    slopes = jax.jit(jax.grad(lambda params: run(params).x[-1, 0]))({name: jnp.asarray(value) for name, value in VALUES.items()})
    for name, value in VALUES.items():
        more, less = (run(VALUES | {name: value * (1 + e)}).x[-1, 0] for e in (1e-4, -1e-4))
        assert slopes[name] == pytest.approx((more - less) / (2e-4 * value), rel=1e-7)


def test_a_sweep_over_params(tmp_path):
    loads = [1.0, 2.0, 8.0]
    case = lambda load: {"x": [0.0], "params": VALUES | {"load": load}}
    given = dict(over={"load": loads}, case=case, step=0.01, steps=200, to=tmp_path / "loads.zarr")
    data = dx.sweep(dx.circuit(OF_PARAMS), MIDPOINT, **given)
    ends = [charge(2.0, **(VALUES | {"load": load})) for load in loads]
    np.testing.assert_allclose(np.asarray(data["x"])[:, -1, 0], ends, atol=1e-5)


@pytest.mark.parametrize(
    ("changed", "error", "message"),
    [
        ({"resistance": -1.0}, ValueError, r"value > 0\), but \('R', 1, 2, 'resistance'\) was given, and here it is -1"),
        ({"load": -1.0}, ValueError, "diode-like resistor is zero at zero and has the sign"),
        ({"tau": 0.0}, ValueError, "value > 0"),
        ({"tau": jnp.ones(2)}, TypeError, r"capacitance\(\) must return one number"),
        (None, TypeError, "pass params="),
    ],
)
def test_params_that_are_no_values(changed, error, message):
    with pytest.raises(error, match=message):
        dx.simulate(dx.circuit(OF_PARAMS), MIDPOINT, x=[0.0], step=0.1, steps=2, params=changed and VALUES | changed)
    with pytest.raises(TypeError, match=r"resistance\(\) could not be traced by JAX: KeyError.* has the keys 'load'"):
        dx.simulate(dx.circuit(OF_PARAMS[1:]), MIDPOINT, x=[0.0], step=0.1, steps=2, params={"load": 1.0})
    with pytest.raises(TypeError, match=r"resistance\(\) could not be traced by JAX with params=None \(it takes params"):
        dx.simulate(dx.circuit(OF_PARAMS[1:]), MIDPOINT, x=[0.0], step=0.1, steps=2)


def test_functions_are_user_functions():
    functions = dx.circuit([*OF_PARAMS, ("C", 1, 0, 1.0), DIODE]).functions
    assert [f is not None and f.signature for f in functions] == [
        "lambda(t, params)", "OfParams(params)", "lambda(u, params)", "lambda(params)", False, "lambda(u)",
    ]  # fmt: skip


@pytest.mark.parametrize("nodes", [3, 140])
@pytest.mark.soak_of("140")
def test_the_laws_of_few_and_of_many_nodes(nodes):
    """By their residual, written out: a chain of C to the ground and L between nodes, with a source and a transformer."""
    chain = [element for n in range(1, nodes) for element in (("C", n, 0, 1.0 + n), ("L", n, n + 1, 2.0))]
    system = dx.circuit([("I", 0, 1, jnp.cos), *chain, ("R", nodes, 0, 3.0), ("T", (1, 0), (nodes, 0), 4.0), ("V", 2, 0, 5.0)])
    assert isinstance(system, dx.Circuit)
    pairs = nodes - 1
    x, v, e = (np.random.default_rng(i).normal(size=size) for i, size in enumerate((2 * pairs, 2 * pairs, nodes)))
    left = np.asarray(system.relation(jnp.asarray(x), jnp.asarray(v), jnp.asarray([*e, 0.6, 0.7]), 0.3))
    flow, into = x[pairs:] / 2.0, np.zeros(nodes)
    into[:-1] += v[:pairs] + flow
    into[1:] -= flow
    into[0] += -np.cos(0.3) + 0.7
    into[1] += 0.6
    into[-1] += e[-1] / 3.0 - 4.0 * 0.7
    voltages = v[pairs:] - (e[:-1] - e[1:]), x[:pairs] / (2.0 + np.arange(pairs)) - e[:-1], [5.0 - e[1]]
    np.testing.assert_allclose(left, np.concatenate([into, *voltages, [4.0 * e[-1] - e[0]]]), atol=1e-13)


@pytest.mark.parametrize("t0", [0.0, 0.4])
@pytest.mark.parametrize("source", [0.5, lambda t: 0.5 * jnp.cos(t)], ids=["constant", "in time"])
@pytest.mark.soak_of(but=["constant-0.4"])
def test_the_advice_for_a_start_off_the_laws_works_as_written(source, t0):
    """A source beside a capacitor, which the initial charge contradicts."""
    system, x = dx.circuit([("V", 1, 0, source), ("C", 1, 0, 2.0), ("R", 1, 2, 1.0), ("C", 2, 0, 3.0)]), np.array([0.0, 0.6])
    run = {"step": 0.01, "steps": 20, "t0": t0}
    with pytest.raises(ValueError, match="off the constraint") as refused:
        dx.simulate(system, MIDPOINT, x=x, **run)
    advice = str(refused.value).split("where ")[1].split(" finds a point")[0]
    found = eval(advice, {"dx": dx, "system": system, "x": x})
    voltage = source if np.isscalar(source) else 0.5 * np.cos(t0)
    np.testing.assert_allclose(found, [2.0 * voltage, 0.6], atol=1e-14)
    sol = dx.simulate(system, MIDPOINT, x=found, **run)
    assert sol.ok and sol.x[-1, 0] == pytest.approx(2.0 * (source if np.isscalar(source) else 0.5 * np.cos(t0 + 0.2)), abs=1e-4)


def test_nodes_that_float_are_named_with_the_way_out():
    """A bridge of diodes that let nothing through backwards: the source between nodes 1 and 2 hangs in the air when all block."""
    diode = lambda u: 1e-12 * jnp.expm1(u / 0.02585)
    bridge = [("R", 1, 3, diode), ("R", 2, 3, diode), ("R", 0, 1, diode), ("R", 0, 2, diode)]
    netlist = [("V", 1, 2, lambda t: 10 * jnp.sin(100 * jnp.pi * t)), *bridge, ("C", 3, 0, 1e-4), ("R", 3, 0, 1000.0)]
    run = {"x": [0.0], "step": 5e-5, "steps": 400}
    sol = dx.simulate(dx.circuit(netlist), MIDPOINT, **run)
    assert not sol.ok and "nothing determines the potential of node 1" in sol.message and "a large resistor" in sol.message
    helped = dx.simulate(dx.circuit([*netlist, ("R", 1, 0, 1e9)]), MIDPOINT, **run)
    assert helped.rows > sol.rows or helped.ok, helped.message


@pytest.mark.parametrize("engine", ["native", pytest.param("xla", marks=pytest.mark.soak)])
def test_a_diode_behind_a_source_that_is_switched(engine):
    """The first update of Newton's method leaves all the voltage on the diode, e¹⁹³, and every other one takes a kT/e of it off.
    Against the roots of the same equations in one number, which brackets find."""
    source = lambda t, xp: 5.0 * xp.where(xp.sin(2 * xp.pi * 50 * t) > 0, 1.0, -1.0)
    diode = lambda u: 1e-12 * jnp.expm1(u / 0.02585)
    rectifier = dx.circuit(
        [("V", 1, 0, lambda t: source(t, jnp)), ("R", 1, 2, 10.0), ("R", 2, 3, diode), ("C", 3, 0, 1e-5), ("R", 3, 0, 1e3)]
    )
    sol, h, charge = dx.simulate(rectifier, MIDPOINT, x=[0.0], step=1e-4, steps=250, engine=engine), 1e-4, 0.0
    assert sol.ok and "followed" in sol.stats["iteration"]
    for k, found in enumerate(sol.x[1:, 0]):
        over = lambda i, q=charge: (q + h / 2 * i) / (1e-5 + h / 2 / 1e3)  # the capacitor's voltage in the middle of the step
        missed = lambda i, k=k, over=over: 10.0 * i + 0.02585 * np.log1p(i / 1e-12) + over(i) - source((k + 0.5) * h, np)
        current = -1e-12 if missed(0.0) > 0.0 else brentq(missed, 0.0, 10.0, xtol=1e-22, rtol=1e-15)
        charge += h * (current - over(current) / 1e3)
        assert found == pytest.approx(charge, rel=1e-9, abs=1e-15)


@pytest.mark.parametrize(
    "netlist",
    [
        [("L", 0, 1, 1.0), ("R", 1, 2, 0.1), ("V", 2, 0, 1.0)],
        [("V", 1, 0, -2.516339715003551), ("R", 1, 2, 3.545017486152915), ("C", 2, 0, 1.6115212004542414)],
        [("R", 1, 0, 0.24189488619574726), ("C", 2, 0, 1.7247021973291805), ("I", 1, 0, -1.959881624692813)],
    ],
)
def test_laws_of_sources_alone_hold_up_to_rounding(netlist):
    """The potential that a source fixes is a number, found to a rounding: what is left of its law has terms all the same."""
    assert dx.simulate(dx.circuit(netlist), MIDPOINT, x=[0.3], step=0.05, steps=3).ok


def test_a_nonlinear_resistor_has_no_chain():
    """The algorithm would take its slope at no voltage for all of it."""
    of_resistor = lambda r: dx.circuit(
        [("V", 1, 0, jnp.sin), ("L", 1, 2, 1.0), ("C", 2, 0, 1.0), ("R", 2, 3, 1.0), ("R", 3, 0, r)]
    )
    assert dx.constraint_algorithm(of_resistor(2.0), near=[0.3, 0.1]).verdict == "determined"
    assert dx.constraint_algorithm(of_resistor(lambda u: u / 2), near=[0.3, 0.1]).verdict == "determined"
    with pytest.raises(TypeError, match=r"those of this Circuit are not in potential of node 3.*linearized"):
        dx.constraint_algorithm(of_resistor(lambda u: u + u**3), near=[0.3, 0.1])


@pytest.mark.parametrize(
    ("netlist", "near"),
    [
        ([("C", 1, 0, 1.69), ("L", 2, 3, 1.39), ("L", 1, 2, 1.83)], [-0.0346, 1e-16, -2e-16]),
        ([("L", 1, 0, 0.7), ("L", 2, 0, 1.3), ("C", 2, 0, 1.3), ("L", 1, 3, 0.3), ("R", 2, 3, 0.5), ("L", 3, 4, 0.9)], None),
        ([("L", 0, 1, 1.357), ("T", (2, 0), (1, 0), 0.4505), ("L", 2, 1, 1.581), ("L", 2, 0, 0.5255)], None),
    ],
    ids=["open", "star with an open branch", "inductors alone"],
)
@pytest.mark.soak
def test_a_current_that_is_zero_has_the_size_that_it_could_have(netlist, near):
    """Its equation has one term, which is the roundoff of zero: points that the constraint algorithm had found were refused, with
    residuals of 1e-15, and right runs called VIOLATED."""
    system, count = dx.circuit(netlist), sum(element[0] in "CL" for element in netlist)
    near = np.random.default_rng(2).normal(size=count) / 2 if near is None else np.array(near)
    chain = dx.constraint_algorithm(system, near=near)
    x = chain.project(near)
    run = {"x": x, "step": 0.02, "steps": 100}
    sol, other = dx.simulate(system, dx.DiscreteDirac(), **run), dx.simulate(chain.resolved(), dx.DiscreteDirac(), **run)
    assert sol.ok and other.ok and dx.verify(sol).ok and dx.verify(other).ok, (dx.verify(sol), dx.verify(other))
    np.testing.assert_allclose(sol.x, other.x, atol=1e-4)
    with pytest.raises(ValueError, match="off the constraint"):
        dx.simulate(system, dx.DiscreteDirac(), **(run | {"x": x + np.eye(count)[-1] * 1e-6}))
