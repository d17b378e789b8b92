"""[BLM] §6: what Methods 1 and 2 keep of the vortices, in several gauges; nonlinear one-forms; the paper's runs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax import gallery
from dirax.gallery import guiding_centre, lotka_volterra, vortices

FOUR = jnp.array(vortices.FOUR)
PAIR, AT = vortices.point_vortices([1.0, 2.0]), jnp.array([0.3, -0.4, 0.2, -0.5])  # small, and no symmetry helps it


def in_gauge(system, gauge):
    """The same dynamics with α + dS."""
    one_form = lambda q, params: system.one_form(q, params) + jax.grad(gauge)(q)
    return dx.PhaseSpaceLagrangian(one_form, lambda q, params: system.hamiltonian(q, params))


GAUGES = {
    "as given": lambda q: 0.0 * q[0],
    "quadratic S": lambda q: 0.4 * q[0] * q[-1] + 0.1 * q[1] ** 2,
    "nonlinear S": lambda q: 0.02 * jnp.sin(q[0]) * q[-1] ** 2 + 0.01 * q[1] ** 3,
}


def map_and_derivative(system, scheme, data, h, params=None):
    """(state, next state, D of the step): Newton's method and the implicit function theorem, written here."""
    shape = dx.Shape(*system.sizes(data, params))
    equation = dx.make_step_equation(scheme, system, shape)

    @jax.jit
    def step(data):
        state, u = equation.start(system.complete(data, params, True), h, params)
        f = lambda u, state: equation.residual(u, state, 0.0, h, params)
        u = jax.lax.fori_loop(0, 20, lambda _, u: u - jnp.linalg.solve(jax.jacfwd(f)(u, state), f(u, state)), u)
        ru, rs = jax.jacfwd(f, argnums=(0, 1))(u, state)
        au, a_s = jax.jacfwd(lambda u, s: equation.advance(u, s, 0.0, h, params), argnums=(0, 1))(u, state)
        return state, equation.advance(u, state, 0.0, h, params), a_s - au @ jnp.linalg.solve(ru, rs)

    return step(data)


def two_form_defect(system, scheme, q, h, params=None):
    """max |Φ*(dα) − dα|, relative to dα: dα from the antisymmetric part of Dα, here."""
    state, end, jacobian = map_and_derivative(system, scheme, {"q": q, "v": jnp.zeros_like(q)}, h, params)
    derivative = jax.jacfwd(lambda q: system.one_form(q, params))
    form = lambda q: derivative(q).T - derivative(q)
    return float(jnp.abs(jacobian.T @ form(end) @ jacobian - form(state)).max() / jnp.abs(form(state)).max())


METHOD_2 = dx.DiscreteDirac(constraints="resolve")


@pytest.mark.parametrize("gauge", GAUGES)
def test_method_2_keeps_the_form_where_it_is_constant(gauge):
    """Prop 6.3. It says: iff α is linear. Method 2 knows α through dα only, so it is: iff dα is constant — a nonlinear
    gauge of a linear α changes nothing."""
    assert two_form_defect(in_gauge(PAIR, GAUGES[gauge]), METHOD_2, AT, 0.5) < 2e-14


@pytest.mark.parametrize("theta", [0.0, 0.3, 1.0])
def test_method_2_does_not_keep_the_form_for_other_theta(theta):
    """Remark 6.4."""
    scheme = dx.DiscreteDirac(map=dx.Theta(theta), constraints="resolve")
    assert two_form_defect(PAIR, scheme, AT, 0.5) > 1e-3


@pytest.mark.parametrize("example", [lotka_volterra.EXAMPLE, guiding_centre.EXAMPLE], ids=lambda e: e.name)
def test_method_2_does_not_keep_a_form_that_varies(example):
    """Prop 6.3, the other way."""
    q = jnp.asarray(example.initial["q"])
    defects = [two_form_defect(example.system, METHOD_2, q, h, example.params) for h in (0.2, 0.1)]
    assert defects[0] > 1e-5
    assert np.log2(defects[0] / defects[1]) == pytest.approx(3.0, abs=0.4)  # the error of the midpoint rule, not roundoff


@pytest.mark.parametrize("gauge", GAUGES)
def test_method_1_is_symplectic_on_the_cotangent_bundle_in_every_gauge(gauge):
    system = in_gauge(PAIR, GAUGES[gauge])
    *_, jacobian = map_and_derivative(system, dx.DiscreteDirac(), {"q": AT, "v": jnp.zeros(4)}, 0.2)
    canonical = np.asarray(dx.canonical_two_form(4))
    assert np.abs(jacobian.T @ canonical @ jacobian - canonical).max() < 1e-11 * np.abs(jacobian).max() ** 2


def test_a_gauge_changes_method_1_but_not_method_2():
    """For nonlinear S. A quadratic one leaves Method 1 alone as well."""
    ends = {}
    for name, gauge in GAUGES.items():
        system = in_gauge(PAIR, gauge)
        for scheme in (dx.DiscreteDirac(), METHOD_2):
            sol = dx.simulate(system, scheme, q=AT, v=np.zeros(4), step=0.1, steps=40)
            ends[name, scheme.constraints] = np.asarray(sol.q[-1])
    difference = lambda name, method: np.abs(ends[name, method] - ends["as given", method]).max()
    assert difference("quadratic S", "resolve") < 1e-12 and difference("nonlinear S", "resolve") < 1e-12
    assert difference("quadratic S", "discretize") < 1e-10
    assert difference("nonlinear S", "discretize") > 1e-6


def test_two_vortices_circle_their_centre():
    """Closed form: circulations (1, 3) turn about their centre of vorticity at the rate (Γ_1 + Γ_2)/2πd²."""
    system = vortices.point_vortices([1.0, 3.0])
    q, rate, errors = np.array([0.0, 1.0, 0.0, 0.0]), 4 / (2 * np.pi), []
    centre = 0.75
    exact = centre - centre * np.exp(1j * rate * 2.0)
    for steps in (50, 100):
        sol = dx.simulate(system, METHOD_2, q=q, v=np.zeros(4), step=2 / steps, steps=steps)
        errors.append(abs(sol.q[-1, 0] + 1j * sol.q[-1, 2] - exact))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.02) and errors[1] < 1e-3
    with pytest.raises(ValueError, match="at least two circulations"):
        vortices.point_vortices([1.0])


def test_runge_kutta_is_the_paper_s_and_drifts():
    q = FOUR
    step = jax.jit(lambda q: vortices.runge_kutta_step(q, 1.0))
    rows = [q]
    for _ in range(500):
        rows.append(step(rows[-1]))
    assert [rows[300][0], rows[300][4]] == pytest.approx([24.49178678979861, 2.11413218620356], abs=1e-9)
    energies = np.asarray(jax.jit(jax.vmap(lambda q: vortices.EXAMPLE.system.hamiltonian(q, None)))(np.array(rows)))
    error = energies - energies[0]
    assert error.max() == pytest.approx(5.889e-4, abs=5e-8)
    assert error[400:].min() > error[:100].max()  # no return: a drift


@pytest.mark.parametrize("name", ["vortices", "lotka-volterra", "guiding-centre"])
def test_phase_space_systems_of_the_gallery_follow_their_vector_fields(name):
    """q̇ of the constraint algorithm against the equations in the file's docstring."""
    example = gallery.get(name)
    q = np.asarray(example.initial["q"])
    x, y = q[0], q[-1]
    fields = {
        "vortices": lambda: np.asarray(vortices.velocity(q)),
        "lotka-volterra": lambda: [x * (1 - y), y * (x - 1)],
        "guiding-centre": lambda: np.array([-2 * y, x]) / (1 + 0.3 * (q @ q)),
    }
    sol = example.simulate(steps=2, step=1e-3)
    assert (sol.q[2] - sol.q[0]) / 2e-3 == pytest.approx(np.asarray(fields[name]()), abs=5e-3)
    assert np.ptp(example.simulate(steps=200).energy()) < 2e-3


def test_the_table_of_the_reproduction():
    """Short runs: the printed complex equations against dirax, the band of Figure 3, the order rows of the disk."""
    from dirax.gallery import barbero_linan as blm

    runs = {number: blm.vortex_run(number, blm.ZOOM) for number in blm.METHODS}
    rows = blm.position_rows(runs) + blm.energy_rows(runs)
    assert [row.verdict for row in rows].count("DIFFERS") == 0
    assert [row.quantity for row in rows if row.verdict == "paper is wrong"] == ["H at the start"]
    band = next(row for row in rows if row.quantity.startswith("Method 1: H − H(0)")).numbers
    assert [band["smallest"], band["largest"]] == pytest.approx([-1.95e-6, 1.921e-4], abs=5e-8)


@pytest.mark.soak
def test_the_whole_reproduction():
    """10⁶ steps: Methods 1 and 2 without drift, RK2 drifting; Methods 1 and 2 on the disk; three figures."""
    from dirax.gallery import barbero_linan as blm

    result = blm.reproduction()
    assert result.ok and sorted(result.figures) == ["figure_01", "figure_02", "figure_03"]
    for row in result.rows:
        if "t = 10⁶" in row.quantity and not row.quantity.startswith("RK2"):
            assert abs(row.numbers["last tenth"]) < 2.0e-4
