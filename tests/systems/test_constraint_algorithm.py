"""The constraint algorithm on systems whose chains are known by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx
from dirax.systems.constraint_algorithm import constraint_algorithm
from dirax.systems.implicit_system import ImplicitSystem


def dimensions(chain):
    return [level.dimension for level in chain.levels]


@pytest.fixture(scope="module")
def pendulum():
    """The planar pendulum as |q| = 1 with its tension as multiplier: q̇ = p, ṗ = −e_y + q u."""
    system = ImplicitSystem(
        E=lambda x: jnp.eye(5)[:, :4],
        f=lambda x: jnp.array([x[2], x[3], 0.0, -1.0, (x[0] ** 2 + x[1] ** 2 - 1.0) / 2]),
        B=lambda x: jnp.concatenate([jnp.zeros(2), x[:2], jnp.zeros(1)])[:, None],
        hamiltonian=lambda x: x[2:] @ x[2:] / 2 + x[1],
    )
    return constraint_algorithm(system, np.array([0.6, -0.81, 0.3, 0.2]))


def test_pendulum_has_a_hidden_constraint_and_its_tension(pendulum):
    assert (dimensions(pendulum), pendulum.index, pendulum.verdict) == ([3, 2, 2], 2, "determined")
    x = pendulum.point
    q, p = x[:2], x[2:]
    assert [q @ q, q @ p] == pytest.approx([1.0, 0.0], abs=1e-14)
    # q·p = 0 differentiated: |p|² − q_y + u = 0
    tension = q[1] - p @ p
    assert pendulum.multipliers(x)[0] == pytest.approx(tension, abs=1e-12)
    expected = np.concatenate([p, [0.0, -1.0] + tension * q])
    assert pendulum.field(x) == pytest.approx(expected, abs=1e-12)
    y = pendulum.project(x + np.array([0.02, 0.01, -0.03, 0.02]))
    assert [y[:2] @ y[:2], y[:2] @ y[2:]] == pytest.approx([1.0, 0.0], abs=1e-14)
    assert str(pendulum).startswith("level  new constraints") and "M_2" in str(pendulum)
    assert [row["count"] for row in pendulum.to_dict()["levels"]] == [1, 1, 0]


def test_points_off_the_final_manifold_are_refused_with_level_and_projection(pendulum):
    pendulum.check(pendulum.point)
    with pytest.raises(ValueError, match=r"off M_0.*nearest point of M_f.*chain.project"):
        pendulum.check(np.array([0.61, -0.8, 0.0, 0.0]))
    with pytest.raises(ValueError, match=r"off M_1"):
        pendulum.check(np.array([0.6, -0.8, 0.3, 0.2]))
    with pytest.raises(ValueError, match=r"must have shape \(4,\)"):
        pendulum.check(np.zeros(3))
    with pytest.raises(ValueError, match=r"project=True.*off M_1.*nearest point of M_f"):
        dx.simulate(pendulum.resolved(), dx.DiscreteDirac(), x=[0.6, -0.8, 0.3, 0.2], step=0.01, steps=1)


def test_method_2_on_a_chain_follows_the_pendulum_and_keeps_both_constraints(pendulum):
    start = np.array([0.6, -0.8, 0.0, 0.0])

    def swing(t, y):
        return [y[1], -np.sin(y[0])]

    angle = solve_ivp(swing, (0, 2), [np.arctan2(0.6, 0.8), 0.0], rtol=1e-12, atol=1e-12).y[0, -1]
    errors = []
    for steps in (20, 40, 80):
        sol = dx.simulate(pendulum.resolved(), dx.DiscreteDirac(), x=start, step=2 / steps, steps=steps)
        assert np.abs(sol.constraint_residual()).max() < 2e-15
        errors.append(np.abs(sol.x[-1, :2] - [np.sin(angle), -np.cos(angle)]).max())
    assert -np.diff(np.log2(errors)) == pytest.approx([2.0, 2.0], abs=0.1)
    assert np.ptp(sol.energy()) < 1e-3


@pytest.fixture(scope="module")
def tension():
    """The same pendulum with its tension as a third coordinate: L = m |q̇|²/2 − m y + λ (|q|² − 1), of index 4."""
    lagrangian = lambda q, v, m: m * (v[:2] @ v[:2] / 2 - q[1]) + q[2] * (q[:2] @ q[:2] - 1.0)
    return constraint_algorithm(dx.LagrangeDirac(lagrangian), {"q": [0.6, -0.81, 0.3], "v": [0.3, 0.2, 0.0]}, params=2.0)


def state_of_the_pendulum(angle, rate, m):
    """x = (q, λ, p) on M_f: q̈ = −e_y + 2λ q/m with |q| = 1 gives 2λ/m = y − |q̇|²."""
    q, v = np.array([np.sin(angle), -np.cos(angle)]), rate * np.array([np.cos(angle), np.sin(angle)])
    return np.concatenate([q, [m * (q[1] - rate**2) / 2], m * v, [0.0]])


@pytest.mark.parametrize("m", [2.0, 0.7])
@pytest.mark.soak_of("2.0")
def test_a_tension_that_is_a_coordinate(tension, m):
    """Four levels: p_λ = 0, |q| = 1, q·p = 0, the tension; λ̇ = 3 m ẏ/2 from differentiating that. For other params too."""
    assert (dimensions(tension), tension.index, tension.verdict) == ([5, 4, 3, 2, 2], 4, "determined")
    x = state_of_the_pendulum(0.9, 0.4, m)
    assert tension.constraints(x, m) == pytest.approx(np.zeros(4), abs=1e-14)
    v = x[3:5] / m
    expected = [*v, 1.5 * m * v[1], *(m * np.array([0.0, -1.0]) + 2 * x[2] * x[:2]), 0.0]
    assert tension.field(x, m) == pytest.approx(expected, abs=1e-12)
    assert tension.multipliers(x, m) == pytest.approx([1.5 * m * v[1]], abs=1e-12)  # u = λ̇, of the primary constraint
    away = x + 0.01 * np.cos(np.arange(6.0))
    assert tension.constraints(tension.project(away, m), m) == pytest.approx(np.zeros(4), abs=1e-14)


@pytest.mark.soak
def test_engines_agree_on_a_chain_of_four_levels(tension):
    start = state_of_the_pendulum(0.9, 0.4, 2.0)
    run = {"x": start, "params": 2.0, "step": 0.02, "steps": 50}
    ours, theirs = (dx.simulate(tension.resolved(), dx.DiscreteDirac(), engine=engine, **run) for engine in ("native", "xla"))
    for name in ("x", "multipliers"):
        np.testing.assert_allclose(theirs.fields[name], ours.fields[name], atol=1e-12)
    assert np.abs(ours.constraint_residual()).max() < 1e-14
    exact = solve_ivp(lambda t, y: [y[1], -np.sin(y[0])], (0, 1.0), [0.9, 0.4], rtol=1e-12, atol=1e-12).y[:, -1]
    half = dx.simulate(tension.resolved(), dx.DiscreteDirac(), **run | {"step": 0.01, "steps": 100})
    errors = [np.abs(sol.x[-1] - state_of_the_pendulum(*exact, 2.0)).max() for sol in (ours, half)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)


@pytest.mark.soak
def test_a_gradient_through_the_projection_and_a_run_against_finite_differences(tension):
    """By the mass, which moves the start, the tension and the motion; of both engines."""
    away = state_of_the_pendulum(0.9, 0.4, 2.0) + 0.01 * np.cos(np.arange(6.0))

    def end(m, engine="auto"):
        start = tension.project(away, m)
        run = {"x": start, "params": m, "step": 0.02, "steps": 10, "engine": engine}
        return dx.simulate(tension.resolved(), dx.DiscreteDirac(), **run).x[-1, 2]

    slope = (end(2.0 + 1e-4) - end(2.0 - 1e-4)) / 2e-4
    assert abs(slope) > 0.1
    for engine in ("native", "xla"):
        assert jax.jit(jax.grad(lambda m, engine=engine: end(m, engine)))(2.0) == pytest.approx(slope, rel=1e-7)


def test_rolling_disk_as_nonholonomic_mechanics():
    system = dx.NonholonomicMechanics(
        lambda q: jnp.diag(jnp.array([1.0, 1.0, 0.25, 0.5])),
        lambda q: 10 * jnp.sin(q[2]),
        lambda q: jnp.array([[1.0, 0, -jnp.cos(q[3]), 0], [0, 1.0, -jnp.sin(q[3]), 0]]),
    )
    q = np.array([0, 0, 0.3, np.pi / 3])
    chain = constraint_algorithm(system, {"q": q, "v": [5.0, 5 * np.sqrt(3), 10, 1.0]})
    assert (dimensions(chain), chain.index, chain.verdict) == ([6, 6], 1, "determined")
    # 1.25 θ̈ = −10 cos θ, ẍ = d/dt(cos φ θ̇) is the first multiplier
    acceleration = -8 * np.cos(0.3)
    expected = acceleration * np.array([np.cos(q[3]), np.sin(q[3])]) + 10 * np.array([-np.sin(q[3]), np.cos(q[3])])
    assert chain.multipliers(chain.point) == pytest.approx(expected, abs=1e-11)
    assert chain.field(chain.point)[4:] == pytest.approx([*expected, acceleration / 4, 0.0], abs=1e-11)


def test_phase_space_lagrangian_stops_at_the_graph_of_its_one_form():
    """L = p q̇ − H in the gauge α = (y + y³/3, 0): ẋ (1 + y²) = ∂H/∂y, ẏ (1 + y²) = −∂H/∂x."""
    system = dx.PhaseSpaceLagrangian(lambda q: jnp.array([q[1] + q[1] ** 3 / 3, 0.0]), lambda q: q @ q / 2)
    chain = constraint_algorithm(system, {"q": [0.4, 0.7]})
    assert (dimensions(chain), chain.index, chain.verdict) == ([2, 2], 1, "determined")
    assert chain.multiplier_names == ("u0", "u1")
    assert chain.field(chain.point)[:2] == pytest.approx([0.7 / 1.49, -0.4 / 1.49], abs=1e-12)


@pytest.mark.soak
def test_an_undetermined_coordinate_is_gauge_freedom():
    """L = (q̇_0 − q_1)²/2: p_1 = 0, then p_0 = 0, and q_1 is arbitrary."""
    chain = constraint_algorithm(dx.LagrangeDirac(lambda q, v: (v[0] - q[1]) ** 2 / 2), {"q": [0.1, 0.2], "v": [0.3, 0.4]})
    assert (dimensions(chain), chain.verdict, chain.freedom) == ([3, 2, 2], "gauge freedom", 1)
    assert chain.point[2:] == pytest.approx([0.0, 0.0], abs=1e-14)
    free = np.abs(chain.gauge(chain.point)[:, 0])
    assert free / free.max() == pytest.approx([0.0, 1.0, 0.0, 0.0], abs=1e-12)


@pytest.mark.soak
def test_momenta_not_affine_in_velocities_go_to_the_pontryagin_bundle():
    """L = √(1 − v_0²) + q_1 v_0 − q_1²/2: q_1 = v_0 by its own equation, then d/dt of p_0 = q_1 − v_0/√… = 0."""
    system = dx.LagrangeDirac(lambda q, v: jnp.sqrt(1 - v[0] ** 2) + q[1] * v[0] - q[1] ** 2 / 2)
    chain = constraint_algorithm(system, {"q": [0.1, 0.2], "v": [0.3, 0.0]})
    q, v, p = np.split(chain.point, 3)
    assert len(chain.coordinates) == 6 and chain.verdict == "determined"
    assert [p[1], p[0], q[1]] == pytest.approx([0.0, q[1] - v[0] / np.sqrt(1 - v[0] ** 2), v[0]], abs=1e-13)
    assert chain.dimension == 2  # q_0 and v_0; the others follow
    assert np.asarray(chain.field(chain.point))[[1, 2]] == pytest.approx([0.0, 0.0], abs=1e-12)


@pytest.mark.soak
def test_closed_ports_and_dirac_systems():
    """A mass tied to rest by its closed port has u = −force; the induced structure of a knife edge gives index 1."""
    port = dx.PortHamiltonian(
        lambda x: x @ x / 2, J=dx.canonical_two_form(2), B=[[0.0], [0.0], [1.0], [0.0]], closed=True
    )  # fmt: skip
    chain = constraint_algorithm(port, np.array([0.3, 0.1, 0.0, 0.5]))
    assert dimensions(chain) == [3, 3]
    assert chain.multipliers(chain.point) == pytest.approx([0.3], abs=1e-13)
    forms = lambda q: jnp.array([[jnp.sin(q[2]), -jnp.cos(q[2]), 0.0]])
    edge = dx.DiracSystem(dx.induced_dirac(forms, 3), lambda x: x[3:] @ x[3:] / 2)
    chain = constraint_algorithm(edge, np.array([0.0, 0.0, 0.3, np.cos(0.3), np.sin(0.3), 1.0]))
    assert dimensions(chain) == [5, 5]
    rate = np.array([np.cos(0.3), np.sin(0.3), 1.0, -np.sin(0.3), np.cos(0.3), 0.0])
    assert chain.field(chain.point) == pytest.approx(rate, abs=1e-12)


def test_redundant_constraints_leave_a_multiplier_free_and_nothing_else():
    """A free fall on the line x = 0, said twice."""
    system = ImplicitSystem(
        E=lambda x: jnp.eye(6)[:, :4],
        f=lambda x: jnp.array([x[2], x[3], 0.0, -1.0, x[0], 2 * x[0]]),
        B=lambda x: jnp.zeros((6, 2)).at[2].set(jnp.array([1.0, 2.0])),
    )
    chain = constraint_algorithm(system, np.array([0.1, 0.1, 0.2, 0.3]))
    assert (dimensions(chain), chain.verdict, chain.redundant) == ([3, 2, 2], "determined", 1)
    assert chain.field(chain.point) == pytest.approx([0.0, 0.3, 0.0, -1.0], abs=1e-13)


@pytest.mark.parametrize(
    "E, f, near, verdict, words",
    [
        (lambda x: jnp.diag(jnp.array([1.0, 0.0])), lambda x: jnp.ones(2), [0.0, 0.1], "empty", "do not vary"),
        (lambda x: jnp.diag(jnp.array([1.0, 0.0])), lambda x: jnp.array([1.0, x[0]]), [0.0, 0.1], "empty", "inconsistent"),
        (lambda x: jnp.diag(jnp.array([1.0, 0.0])), lambda x: 1 + x**2, [0.3, 0.1], "empty", "no common zero"),
        (lambda x: jnp.diag(jnp.stack([x[0], 1.0])), lambda x: x + 1, [0.0, 1.0], "irregular", "not constant"),
        (lambda x: jnp.diag(jnp.array([1.0, 0.0])), lambda x: x**2, [0.0, 0.1], "irregular", "vanish with their derivative"),
    ],
    ids=["0 = 1", "hidden 0 = 1", "no real zero", "singular point", "double zero"],
)  # fmt: skip
@pytest.mark.soak_of("hidden 0 = 1")
def test_what_goes_wrong_is_explained(E, f, near, verdict, words):
    chain = constraint_algorithm(ImplicitSystem(E, f), np.array(near))
    assert chain.verdict == verdict and words in chain.explanation
    with pytest.raises(ValueError, match="no final manifold"):
        chain.field(np.array(near))


@pytest.mark.soak
def test_secondary_constraints_that_exist_only_on_the_manifold():
    """ẋ_1 + x_1 ẋ_2 = x_0 − x_2 determines ẋ_2 off x_1 = 0; on it, where ẋ_1 = 0, it is the condition x_0 = x_2."""
    system = ImplicitSystem(
        E=lambda x: jnp.array([[1.0, 0, 0], [0, 0, 0], [0, 1.0, 0]]).at[2, 2].set(x[1]),
        f=lambda x: jnp.array([1.0, x[1], x[0] - x[2]]),
    )
    chain = constraint_algorithm(system, np.array([0.5, 0.2, 0.3]))
    assert (dimensions(chain), chain.verdict) == ([2, 1, 1], "determined")
    assert "appears only on M_0: off it the rank is 3" in str(chain)
    assert chain.field(chain.point) == pytest.approx([1.0, 0.0, 1.0], abs=1e-13)
    # the same by a rank of E that drops where the first condition vanishes
    dropping = ImplicitSystem(
        E=lambda x: jnp.diag(jnp.stack([1.0, 0.0, x[1]])), f=lambda x: jnp.array([1.0, x[1], x[0] - x[2]])
    )  # fmt: skip
    chain = constraint_algorithm(dropping, np.array([0.5, 0.2, 0.3]))
    assert (dimensions(chain), chain.verdict) == ([2, 1, 1], "determined")
    assert chain.field(chain.point) == pytest.approx([1.0, 0.0, 1.0], abs=1e-13)


def test_conditions_that_end_where_they_vanish_are_refused_with_the_way_out():
    """x_1 ẋ_2 = x_0 − x_2, said twice, the second time off by x_1: where that vanishes, there is no ẋ_2 to compare."""
    system = ImplicitSystem(
        E=lambda x: jnp.array([[1.0, 0, 0], [0, 0, 0], [0, 0, 0]]).at[1:, 2].set(x[1]),
        f=lambda x: jnp.array([1.0, x[0] - x[2], x[0] - x[2] + x[1]]),
    )
    chain = constraint_algorithm(system, np.array([0.5, 0.2, 0.3]))
    assert chain.verdict == "irregular" and "hold only there" in chain.explanation


def test_inputs_are_checked():
    with pytest.raises(TypeError, match=r"state it as dx\.ImplicitSystem"):
        constraint_algorithm(dx.ManifoldLagrangian, np.zeros(2))  # ty: ignore
    with pytest.raises(ValueError, match="E must have shape"):
        constraint_algorithm(ImplicitSystem(lambda x: x, lambda x: x), np.ones(2))
    with pytest.raises(ValueError, match="near must be finite"):
        constraint_algorithm(ImplicitSystem(lambda x: jnp.eye(2), lambda x: x), np.array([np.nan, 0.0]))


@pytest.mark.soak
def test_functions_of_the_chain_are_traceable_and_differentiable(pendulum):
    x = jnp.asarray(pendulum.point)
    derivative = jax.jit(jax.jacfwd(lambda x: pendulum.project(x)))(x)
    # the orthogonal projector onto T M_f
    normal = np.asarray(jax.jacfwd(pendulum.constraints)(x))
    projector = np.eye(4) - np.linalg.pinv(normal) @ normal
    assert np.abs(derivative - projector).max() < 1e-10
    assert np.abs(normal @ np.asarray(pendulum.field(x))).max() < 1e-12


ROLLING = dx.DiracStructure.from_annihilator(lambda x: jnp.stack([-x[1], 0.0, 1.0])[None])


@pytest.mark.parametrize("near", [(0.001, 0.001, 0.001), (0.0, 0.0, 0.1), (0.3, 0.1, 0.2)])
@pytest.mark.soak_of(but=["near0"])
def test_a_pivot_that_vanishes_on_the_manifold_is_chosen_again(near):
    """dH ∥ (−y, 0, 1) and dH = x: M_0 is x = y = 0, where the entry −y of the one-form is zero."""
    chain = constraint_algorithm(dx.DiracSystem(ROLLING, lambda x: x @ x / 2), near=np.array(near))
    assert (chain.verdict, chain.dimension, chain.index) == ("determined", 1, 1)
    np.testing.assert_allclose(chain.point[:2], 0.0, atol=1e-12)


@pytest.mark.soak
def test_the_point_of_a_chain_is_the_nearest_one():
    """dH = (y, x, z) ∥ (−y, 0, 1): x = 0 with y = 0, .22 away, or with z = −1, .8 away."""
    near = np.array([0.1, 0.2, -0.2])
    chain = constraint_algorithm(dx.DiracSystem(ROLLING, lambda x: x[2] ** 2 / 2 + x[0] * x[1]), near=near)
    np.testing.assert_allclose(chain.point, [0.0, 0.0, -0.2], atol=1e-12)
    sphere = dx.ImplicitSystem(lambda x: jnp.zeros((1, 3)), lambda x: jnp.stack([x @ x - 1.0]), lambda x: jnp.zeros((1, 0)))
    point = constraint_algorithm(sphere, near=near).point
    np.testing.assert_allclose(point, near / np.linalg.norm(near), atol=1e-10)


def test_a_search_that_ends_at_the_first_level_has_the_dimension_of_the_whole_space():
    chain = constraint_algorithm(dx.ImplicitSystem(lambda x: jnp.diag(x), lambda x: jnp.ones(2)), near=np.array([0.0, 1.0]))
    assert chain.verdict == "irregular" and not chain.levels and chain.dimension == 2


def turning(rows):
    """ẋ = y − s g/c, by two equations of rank one whose coefficients (cos z, sin z) turn with ż = 1; ẏ = −x."""

    def equations(x):
        c, s = jnp.cos(x[2]), jnp.sin(x[2])
        return jnp.array([[c, 0.0, 0.0], [s, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])[np.array(rows)]

    def right(x):
        c, s, g = jnp.cos(x[2]), jnp.sin(x[2]), x[0] ** 2 + x[1] ** 2 - 1
        return jnp.stack([c * x[1] - s * g, s * x[1] + c * g, -x[0], 1.0])[np.array(rows)]

    return dx.ImplicitSystem(equations, right)


@pytest.mark.parametrize(("near", "engine"), [([1.0, 0.0, 0.0], "native"), ([1.0, 0.0, 0.1], "xla")])
@pytest.mark.soak
def test_a_pivot_that_vanishes_along_a_run_is_left_for_another(near, engine):
    """M_f is the cylinder; the pivot cos z of its point is zero at a node of the run, z = π/2."""
    chain = constraint_algorithm(turning([0, 1, 2, 3]), near=np.array(near))
    assert (chain.verdict, chain.dimension) == ("determined", 2)
    side = np.array([0.9, 0.6, np.pi / 2])
    np.testing.assert_allclose(chain.project(side), [*side[:2] / np.hypot(*side[:2]), np.pi / 2], atol=1e-14)
    np.testing.assert_allclose(jax.jit(chain.field)(jnp.array([0.8, 0.6, np.pi / 2])), [0.6, -0.8, 1.0], atol=1e-14)
    h = np.pi / 40
    sol = dx.simulate(
        chain.resolved(), dx.DiscreteDirac(constraints="resolve"), x=[1.0, 0.0, 0.0], step=h, steps=60, engine=engine
    )
    assert sol.ok, sol.message
    np.testing.assert_allclose(np.hypot(*sol.x[:, :2].T), 1.0, atol=1e-14)
    angle = np.unwrap(np.arctan2(-sol.x[:, 1], sol.x[:, 0]))
    np.testing.assert_allclose(np.diff(angle), angle[1], atol=1e-13)  # every step is the same turn, whatever the pivot
    assert angle[-1] == pytest.approx(60 * h, rel=h**2)


def test_the_freedom_that_is_left_out_turns_with_the_point():
    """x × ẋ = Ax on the cone x·Ax = 0 leaves ẋ free along x, at half a turn along −x₀: ẋ is the rotation all the way round."""
    cross = lambda x: jnp.array([[0.0, x[2], -x[1]], [-x[2], 0.0, x[0]], [x[1], -x[0], 0.0]])
    cone = dx.DiracSystem(dx.DiracStructure.from_two_form(cross), lambda x: (x[0] ** 2 + x[1] ** 2 - x[2] ** 2) / 2)
    chain = constraint_algorithm(cone, near=np.array([1.0, 0.0, 1.0]))
    assert (chain.verdict, chain.freedom) == ("gauge freedom", 1)
    for angle in np.linspace(0, np.pi, 5):
        x = np.array([np.cos(angle), np.sin(angle), 1.0])
        np.testing.assert_allclose(chain.field(x), [np.sin(angle), -np.cos(angle), 0.0], atol=1e-12)


POLAR = dx.LagrangeDirac(lambda q, v: v[0] ** 2 / 2 + jnp.sin(q[0]) ** 2 * v[1] ** 2 / 2 + jnp.cos(q[0]))
"""The spherical pendulum in angles: ∂²L/∂v² = diag(1, sin²θ), of rank 1 at the pole alone."""


def crossing(force, unit):
    """L = (ẋ² + x²ẏ²)/2 + … with ∂²L/∂v² of rank 1 on the line x = 0 alone, y in other units."""
    kinetic = lambda q, v: (v[0] ** 2 + (q[0] * v[1] / unit) ** 2) / 2
    return {
        "potential": dx.LagrangeDirac(lambda q, v: kinetic(q, v) - (q[0] ** 2 + (q[1] / unit) ** 2) / 2),
        "friction": dx.LagrangeDirac(kinetic, forces=lambda t, q, v: -v / jnp.array([1.0, unit**2])),
        "driven": dx.LagrangeDirac(lambda t, q, v: kinetic(q, v) + q[1] / unit * jnp.sin(t)),
    }[force]


@pytest.mark.parametrize("force", ["potential", "friction", "driven"])
@pytest.mark.parametrize("unit", [1.0, 2.0**-40])
@pytest.mark.soak
def test_a_hessian_that_loses_rank_at_the_point_alone_is_irregular(force, unit):
    """It was taken for one of that rank everywhere: gauge freedom, or a final manifold that is none."""
    found = [
        constraint_algorithm(crossing(force, unit), {"q": [x, 0.2 * unit], "v": [0.3, 0.1 * unit]}) for x in (0.0, 1e-3, 1e-2)
    ]
    assert [chain.verdict for chain in found] == ["irregular", "determined", "determined"]
    assert "it is not constant" in found[0].explanation


@pytest.mark.soak
def test_a_hessian_whose_kernel_turns_has_one_rank():
    system = dx.LagrangeDirac(lambda q, v: ((v[0] * jnp.cos(q[2]) + v[1] * jnp.sin(q[2])) ** 2 + v[2] ** 2) / 2)
    for angle in (1e-8, 0.7):
        chain = constraint_algorithm(system, {"q": [0.1, 0.2, angle], "v": [0.3, 0.1, 0.2]})
        assert chain.verdict != "irregular" and "rank 2 of 3" in chain.explanation


@pytest.mark.parametrize("scheme", [dx.DiscreteDirac(constraints="resolve"), dx.Collocation(2)])
@pytest.mark.soak_of("scheme0")
def test_schemes_do_not_send_to_a_final_manifold_that_is_none(scheme):
    with pytest.raises(ValueError, match=r"is not found here: the rank of ∂²L/∂v² is 1 at the point and 2 around it"):
        dx.simulate(POLAR, scheme, q=[0.0, 0.2], v=[0.3, 0.5], step=0.1, steps=10)


def test_points_of_a_chain_with_a_clock_with_and_without_the_time():
    """x₀ = 2 cos t: by default the time is that of the point at which the chain was found."""
    chain = constraint_algorithm(dx.circuit([("V", 1, 0, jnp.cos), ("C", 1, 0, 2.0)]), near={"x": [1.0], "t": 0.3})
    assert chain.coordinates == ("x0", "t")
    for t, given in ((0.3, {}), (0.7, {"t": 0.7})):
        x, whole, charge = np.array([1.0]), np.array([1.0, t]), 2.0 * np.cos(t)
        np.testing.assert_allclose(chain.project(x, **given), [charge], atol=1e-14)
        np.testing.assert_allclose(chain.project(whole), [charge, t], atol=1e-14)
        np.testing.assert_allclose(chain.field(np.array([charge]), **given), [-2.0 * np.sin(t)], atol=1e-13)
        np.testing.assert_allclose(chain.field(np.array([charge, t])), [-2.0 * np.sin(t), 1.0], atol=1e-13)
        for function in (chain.constraints, chain.multipliers, chain.off_level):
            np.testing.assert_array_equal(function(x, **given), function(whole))
        assert chain.gauge(x, **given).shape == (1, 0) and chain.gauge(whole).shape == (2, 0)
        np.testing.assert_allclose(
            jax.jit(lambda x, given=given: chain.project(x, **given))(jnp.asarray(x)), [charge], atol=1e-14
        )
        chain.check([charge], **given)
    with pytest.raises(ValueError, match=r"nearest point of M_f is \[1\.910673\]"):
        chain.check([1.0])
    for function in (chain.project, chain.check, chain.field, chain.constraints, chain.off, chain.multipliers, chain.gauge):
        with pytest.raises(ValueError, match=r"shape \(2,\) = \(x0, t\), or \(1,\) without t, but it has shape \(3,\)"):
            function(np.zeros(3))
        with pytest.raises(ValueError, match=r"it has shape \(2,\) beside t=0\.5"):
            function(np.zeros(2), t=0.5)


def test_points_of_the_wrong_length(pendulum):
    with pytest.raises(ValueError, match=r"x must have shape \(4,\) = \(x0, x1, x2, x3\), but it has shape \(3,\)\.$"):
        pendulum.project(np.zeros(3))


def test_the_times_of_a_run_are_those_of_its_clock():
    """The rows of t = 1 to 2 were labelled by those from t0 on."""
    netlist = [("V", 1, 0, jnp.sin), ("C", 1, 0, 0.4), ("R", 1, 2, 1.0), ("C", 2, 0, 0.5)]
    chain = constraint_algorithm(dx.circuit(netlist), near={"x": [0.4 * np.sin(1.0), 0.0], "t": 1.0})
    system, resolved, later = chain.resolved(), dx.DiscreteDirac(constraints="resolve"), chain.project([0.36, 0.0, 2.0])
    run = {"x": chain.point, "step": 0.01, "steps": 20}
    for given in ({}, {"t0": 1.0}):
        sol = dx.simulate(system, resolved, **run, **given)
        assert sol.t[0] == 1.0 and np.max(np.abs(sol.t - sol.x[:, -1])) <= 1e-14
    prepared = dx.prepare(system, resolved, **run)
    assert prepared(x=later).t[0] == 2.0 and prepared().t[0] == 1.0 and prepared(t0=1.0, x=chain.point).t[0] == 1.0
    with pytest.raises(ValueError, match=r"t0 is 3, but the time is a coordinate of this system, and 1 at the start"):
        dx.simulate(system, resolved, t0=3.0, **run)
    with pytest.raises(ValueError, match=r"t0 is 1, but .* 2 at the start"):
        prepared(x=later, t0=1.0)
    with pytest.raises(ValueError, match=r"1 in the first one and 2 in another: run them one by one"):
        dx.simulate(system, resolved, **run | {"x": np.stack([chain.point, later])})


def test_a_point_of_positions_velocities_and_momenta_is_one_of_the_cotangent_bundle():
    system = dx.LagrangeDirac(lambda q, v: (v[0] ** 2 + v[1] ** 2) / 2 - q[1] - q[2] * (q[0] ** 2 + q[1] ** 2 - 1) / 2)
    q, v = np.array([np.sin(0.7), -np.cos(0.7), 0.9]), np.array([0.3, 0.2, 0.0])
    by_name = dx.constraint_algorithm(system, near={"q": q, "v": v})
    by_place = dx.constraint_algorithm(system, near=np.concatenate([q, v, v]))
    assert str(by_place) == str(by_name)
    np.testing.assert_array_equal(by_place.point, by_name.point)
