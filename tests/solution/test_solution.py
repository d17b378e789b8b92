"""Solution: derived quantities against closed forms, blocks, how it shows itself, pictures."""

import copy
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.solution import energy_code, trajectory
from dirax.solution.trajectory import MANY

SPRING = dx.LagrangeDirac(lambda q, v, params: (params["m"] * (v @ v) - params["k"] * (q @ q)) / 2)
SKATE = dx.LagrangeDirac(lambda q, v: v @ v / 2, lambda q: jnp.array([[jnp.sin(q[2]), -jnp.cos(q[2]), 0.0]]))


@pytest.fixture
def spring():
    params = {"m": np.array([1.0, 2.0]), "k": np.array([3.0, 1.0])}
    data = {"q": [[1.0, 0.0], [0.0, 1.0]], "v": [[0.0, 1.0], [1.0, 1.0]]}
    return dx.simulate(SPRING, dx.PlusLagrangeDirac(), **data, params=params, batch_params=True, step=0.1, steps=12)


@pytest.fixture
def skate():
    start = {"q": [0.0, 0.0, 0.3], "v": [np.cos(0.3), np.sin(0.3), 1.0]}
    return dx.simulate(SKATE, dx.LagrangeDAlembert(), **start, step=0.1, steps=12)


def spring_energy(sol):
    m, k = (sol.params[name][:, None] for name in "mk")
    return np.sum(sol.p**2, -1) / (2 * m) + k * np.sum(sol.q**2, -1) / 2


def test_energy_with_parameters_of_each_trajectory(spring):
    np.testing.assert_allclose(spring.energy(), spring_energy(spring), rtol=1e-14)
    assert spring.energy() is spring.energy()  # computed once


def test_momentum_map(spring):
    """Angular momentum q × p, which the rotations' generator gives; the left rule conserves it."""
    momentum = spring.momentum_map(lambda q: jnp.array([-q[1], q[0]]))
    by_hand = spring.q[..., 0] * spring.p[..., 1] - spring.q[..., 1] * spring.p[..., 0]
    np.testing.assert_allclose(momentum, by_hand, atol=1e-15)
    np.testing.assert_allclose(by_hand, by_hand[:, :1] * np.ones((1, 13)), atol=1e-14)


def test_what_is_no_generator_is_said(spring):
    with pytest.raises(TypeError, match="generator must be a function"):
        spring.momentum_map(None)
    for wrong, shape in ((lambda q: jnp.ones(3), r"\(3,\)"), (lambda q: q[0], r"\(\)")):
        with pytest.raises(ValueError, match=rf"shape \(2,\), as q has, but it returned shape {shape}"):
            spring.momentum_map(wrong)


@pytest.mark.parametrize("most", [0, 1000])
def test_momenta_and_energies_with_and_without_a_compilation(most, spring, monkeypatch):
    """Of short trajectories they are ready at once, of long ones XLA compiles them: the same numbers."""
    compiled = []
    monkeypatch.setattr(trajectory, "BY_NUMPY", most)
    along = trajectory._along
    monkeypatch.setattr(trajectory, "_along", lambda *given: compiled.append(given) or along(*given))
    rotation = lambda q: jnp.array([-q[1], q[0]])
    by_hand = spring.q[..., 0] * spring.p[..., 1] - spring.q[..., 1] * spring.p[..., 0]
    np.testing.assert_allclose(spring.momentum_map(rotation), by_hand, atol=1e-15)
    np.testing.assert_allclose(spring.energy(), spring_energy(spring), rtol=1e-14)
    assert bool(compiled) == (most == 0)


@pytest.mark.parametrize("rows", [1, 2, 5, 13, 26, 1000])
def test_rows_in_blocks(rows, spring, monkeypatch):
    """Long trajectories are worked through in blocks; the last one may be shorter."""
    monkeypatch.setattr(trajectory, "BLOCK", rows)
    values = spring.map_rows(lambda row, params: {"e": params["k"] * (row["q"] @ row["q"]), "q": row["q"]})
    np.testing.assert_allclose(values["e"], np.array([[3.0], [1.0]]) * np.sum(spring.q**2, -1), rtol=1e-14)
    np.testing.assert_array_equal(values["q"], spring.q)


def test_constraint_residual_is_that_of_the_steps(skate):
    middle, step = (skate.q[1:, 2] + skate.q[:-1, 2]) / 2, np.diff(skate.q, axis=0) / 0.1
    by_hand = np.sin(middle) * step[:, 0] - np.cos(middle) * step[:, 1]
    np.testing.assert_allclose(skate.constraint_residual()[:, 0], by_hand, atol=1e-13)
    assert skate.constraint_residual() is skate.constraint


@pytest.mark.soak
def test_energy_inside_a_gradient():
    """∂E/∂k of the last row, E = p²/2m + k q²/2, by the recursion written out."""

    def last(k):
        sol = dx.simulate(SPRING, dx.PlusLagrangeDirac(), q=[1.0], v=[0.0], params={"m": 2.0, "k": k}, step=0.1, steps=3)
        return sol.energy()[-1]

    q, p, dq, dp, k = 1.0, 0.0, 0.0, 0.0, 3.0
    for _ in range(3):
        dp, p = dp - 0.1 * (q + k * dq), p - 0.1 * k * q
        dq, q = dq + 0.05 * dp, q + 0.05 * p
    assert jax.grad(last)(k) == pytest.approx(p * dp / 2 + q * q / 2 + k * q * dq, rel=1e-12)


def test_what_it_holds(spring, skate):
    assert (spring.batch, spring.rows, skate.batch, skate.rows) == (2, 13, None, 13)
    assert spring.nbytes == 8 * (13 + 2 * 13 * 4)
    with pytest.raises(AttributeError, match="this solution has no 'x'; it holds q, p, multipliers, constraint"):
        _ = skate.x
    with pytest.raises(AttributeError, match="no attribute 'velocity'"):
        _ = skate.velocity
    assert not hasattr(skate, "__array__")


def test_without_its_system(skate):
    skate.system = None
    with pytest.raises(ValueError, match=r"loaded without its system, .* no energy: use dx\.load\(path, system=system\)"):
        skate.energy()
    assert skate.constraint_residual().shape == (12, 1)


# -------------------------------------------------------------------------------------------------- how things show themselves


def hanging(q, v, params):
    return v @ v / 2 + params["g"] * jnp.cos(q[0])


def test_solutions_in_a_terminal(spring, skate):
    assert repr(skate).splitlines() == [
        "Solution",
        "  system: LagrangeDirac(lagrangian=lambda(q, v), one_forms=lambda(q))",
        "  scheme: LagrangeDAlembert(discrete_lagrangian='midpoint', constraint='midpoint', momentum='mean')",
        "  time: 0 to 1.2, step 0.1, every step saved",
        "  holds: q[13, 3], p[13, 3], multipliers[12, 1], constraint[12, 1]",
        "  ended: ok",
    ]
    assert "ended: all 2 trajectories ok" in repr(spring) and "energy" not in repr(spring)
    energy = spring.energy()
    assert f"energy: {energy[0, 0]:.9g} at the start, changes by at most {np.max(np.abs(energy - energy[:, :1])):.3g}" in repr(
        spring
    )


def test_failed_solutions_say_so():
    falling = dx.LagrangeDirac(lambda q, v: v @ v / 2 - jnp.log(q[0]))
    start = {"step": 0.1, "steps": 40}
    one = dx.simulate(falling, dx.PlusLagrangeDirac(), q=[1.0], v=[0.0], **start)
    assert f"ended: {one.message}" in repr(one)
    many = dx.simulate(falling, dx.PlusLagrangeDirac(), q=[[1.0], [1.0]], v=[[9.0], [0.0]], **start)
    assert f"1 of 2 trajectories failed, the first: {many.message[1]}" in repr(many)


def test_traced_solutions_can_be_printed():
    texts = []

    def run(q):
        sol = dx.simulate(SKATE, dx.PlusLagrangeDirac(), q=q, v=jnp.zeros(3), step=0.1, steps=2)
        texts.append(repr(sol))
        return sol.q

    jax.jit(run)(jnp.zeros(3))
    assert "holds: q[3, 3], p[3, 3], multipliers[2, 1], constraint[2, 1], traced" in texts[0]


def test_systems_schemes_and_equations_in_a_terminal():
    system = dx.LagrangeDirac(hanging)
    assert repr(system) == "LagrangeDirac(lagrangian=hanging(q, v, params), one_forms=None)"
    assert repr(dx.PlusLagrangeDirac()) == "PlusLagrangeDirac(discrete_lagrangian='left')"
    assert repr(dx.Composition(dx.PlusLagrangeDirac("midpoint"), "yoshida4")).startswith(
        "Composition(\n  scheme=PlusLagrangeDirac(discrete_lagrangian='midpoint'),\n  coefficients=(1.35"
    )
    assert "… 15 in all" in repr(dx.Composition(dx.DiscreteDirac(), "mclachlan8"))
    shape = dx.Shape(3, 1)
    assert repr(dx.make_step_equation(dx.PlusLagrangeDirac(), SKATE, shape)) == (
        "StepEquation(solves 4 unknowns; state 6 numbers, (q, p) on T*Q; "
        "saves q[3], p[3], multipliers[1] per step, constraint[1] per step)"
    )
    sequence = dx.make_step_equation(dx.SymmetricComposition(dx.PlusLagrangeDirac()), SKATE, shape)
    assert repr(sequence).startswith("StepSequence(2 stages of h·(0.5, 0.5); first StepEquation(solves ")


def test_everything_in_a_notebook(skate):
    equation = skate.equation
    for thing in (skate, skate.system, skate.scheme, equation):
        text = thing._repr_html_()
        text = text[text.index("</iframe>") + 9 :].lstrip() if thing is skate else text  # the motion first, in a frame
        assert text.startswith("<table>") and text.endswith("</table>") and text.count("<tr>") == text.count("</tr>") > 0
    skate.message, skate.ok = "<script>alert(1)</script>", False
    assert "<script>" not in skate._repr_html_() and "&lt;script&gt;" in skate._repr_html_()


# ------------------------------------------------------------------------------------------------------------------- pictures


@pytest.mark.parametrize("name", ["plot", "plot_trajectory", "plot_energy", "plot_phase", "plot_constraint"])
def test_pictures_draw_the_solution(name, skate):
    from matplotlib.figure import Figure

    picture = getattr(skate, name)()
    figure = picture if isinstance(picture, Figure) else picture.figure
    assert any(line.get_xdata().size >= 12 for ax in figure.axes for line in ax.lines)


def on_a_string(q, v, params):
    return v @ v / 2 - params["g"] * q[0]


def on_a_circle(q):
    return jnp.array([q @ q - 1.0])


@pytest.mark.parametrize("batch", [False, True])
@pytest.mark.soak_of("False")
def test_solutions_are_pickled_and_copied_in_depth(batch):
    q = np.array([[0.6, 0.8], [0.0, 1.0]])[: 2 if batch else 1]
    given = {"q": q if batch else q[0], "v": np.zeros_like(q) if batch else np.zeros(2), "params": {"g": 9.8}}
    sol = dx.simulate(dx.LagrangeDirac(on_a_string, holonomic=on_a_circle), dx.LagrangeDAlembert(), **given, step=0.01, steps=20)
    for other in (pickle.loads(pickle.dumps(sol)), copy.deepcopy(sol)):
        assert all(np.array_equal(other.fields[name], values) for name, values in sol.fields.items())
        assert np.array_equal(other.energy(), sol.energy()) and str(other) == str(sol)
        assert str(dx.verify(other)) == str(dx.verify(sol))
        with pytest.raises(ValueError, match="knows how to go on"):
            other.extend(3)


@pytest.mark.parametrize("batched", [False, True])
def test_the_energy_of_many_rows_is_that_of_few(batched):
    """By machine code: (1 + q²) v²/2 + q⁴/4 with p = (1 + q²) v, of which NumPy finds v by Newton's method."""
    system = dx.LagrangeDirac(lambda q, v, k: (1 + q[0] ** 2) * v[0] ** 2 / 2 - k * q[0] ** 4 / 4)
    q, k = ([[1.0], [0.5], [0.2]], np.array([1.0, 2.0, 3.0])) if batched else ([1.0], 2.0)
    run = {"q": q, "v": [0.3], "params": k, "batch_params": batched, "step": 0.01}
    sol = dx.simulate(system, dx.LagrangeDAlembert(), steps=MANY, **run)
    x, p = sol.q[..., 0], sol.p[..., 0]
    expected = p**2 / (1 + x**2) / 2 + (k[:, None] if batched else k) * x**4 / 4
    np.testing.assert_allclose(sol.energy(), expected, rtol=1e-14)
    few = dx.simulate(system, dx.LagrangeDAlembert(), steps=100, **run)
    np.testing.assert_allclose(few.energy(), sol.energy()[..., :101], rtol=1e-14)


def test_where_machine_code_and_numpy_disagree_machine_code_is_not_taken(monkeypatch):
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2)
    sol = dx.simulate(system, dx.LagrangeDAlembert(), q=[1.0], v=[0.0], step=0.1, steps=MANY)
    monkeypatch.setattr(energy_code, "_run", lambda *_: np.full((1, MANY + 1), 0.5 + 1e-9))
    np.testing.assert_allclose(sol.energy(), 0.5, rtol=1e-11)


def test_rows_of_which_machine_code_has_no_energy_are_not_lost():
    """The mass of the second coordinate is zero at q = 0, and its momentum too: NumPy finds the smallest velocity."""
    system = dx.LagrangeDirac(lambda q, v: v[0] ** 2 / 2 + q[0] ** 2 * v[1] ** 2 / 2)
    count = MANY + 1
    q, p = np.linspace(0.0, 1.0, 2 * count).reshape(2, count).T.copy(), np.ones((count, 2))
    q[100], p[100] = 0.0, [1.0, 0.0]
    sol = dx.simulate(system, dx.LagrangeDAlembert(), q=[1.0, 0.0], v=[0.0, 0.0], step=0.1, steps=MANY)
    changed = sol.replace(fields={**sol.fields, "q": q, "p": p})
    found = changed.energy()
    assert np.all(np.isfinite(found))
    np.testing.assert_allclose(found[90:110], changed[90:110].energy(), rtol=1e-12)
