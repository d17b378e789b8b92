"""The lines of verify() in other units: the same verdicts, and the same numbers relative to their terms."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.diagnostics.replay_lines import replayed
from dirax.diagnostics.structure_lines import symplecticity
from dirax.schemes.step import explicit_step

POLAR = dx.LagrangeDirac(lambda q, v, l: (v[0] ** 2 + q[0] ** 2 * v[1] ** 2) / 2 - (q[0] - l) ** 2)
QUOTIENT = dx.reduce(POLAR, dx.LinearConnection(fibre=[1]))
KEPLER = dx.LagrangeDirac(lambda q, v, m: m * (v @ v) / 2 + m / jnp.sqrt(q @ q))
TOP = dx.LiePoisson(
    dx.SO3(), lambda mu, a, m: mu @ (mu / jnp.array([1.0, 2.0, 3.0])) / 2 / m + m * a[0] + 0.3 * m * a[1] ** 2, advected=3
)


def about_a_length(system, scheme):
    """A distance and an angle."""
    return lambda l: dx.simulate(system, scheme, q=[l, 0.0], v=[0.1 * l, 0.8], params=l, step=0.05, steps=10)


def of_a_mass(m):
    x = np.array([0.3 * m, 0.9 * m, -0.4 * m, 0.6, 0.0, 0.8])
    return dx.simulate(TOP, dx.DiscreteEulerPoincare(), x=x, params=m, step=0.05, steps=10)


SYMPLECTIC = {
    "lagrange": about_a_length(POLAR, dx.LagrangeDAlembert()),
    "routh": about_a_length(QUOTIENT, dx.DiscreteRouth()),
    "quotient": about_a_length(QUOTIENT, dx.PlusLagrangeDirac()),
    "lie-poisson": of_a_mass,
}


@pytest.mark.parametrize("kind", SYMPLECTIC)
@pytest.mark.soak_of(but=["lagrange"])
def test_a_step_preserves_its_form_in_any_units(kind):
    whole = dx.reconstruct if kind in ("routh", "quotient") else lambda sol: sol  # what verify asks the form of
    found = [symplecticity(whole(SYMPLECTIC[kind](unit)), None) for unit in (1.0, 2.0**20, 2.0**-9, 1e7)]
    assert {line.quantity for line in found} == {"symplecticity of one step"}
    assert all(line.verdict == "ok" and line.value < 1e-14 for line in found), found
    np.testing.assert_allclose([line.value for line in found[:3]], found[0].value, rtol=1e-12)


class Damped(dx.AbstractScheme):
    """Symplectic Euler for a distance and an angle, of which the momentum of the angle loses its billionth part in a step."""

    loss: float = eqx.field(static=True, default=1e-9)

    def step_equation(self, system, shape):
        def advance(u, state, t, h, l):
            q, p = state[:2], state[2:]
            p = p * jnp.array([1.0, 1.0 - self.loss]) - h * jnp.stack([q[0], l**2 * jnp.sin(q[1])])
            return jnp.concatenate([q + h * p / jnp.stack([1.0, l**2]), p])

        return dx.StepEquation(
            start=lambda data, h, params: (jnp.concatenate([data["q"], data["p"]]), jnp.zeros(0)),
            residual=explicit_step,
            advance=advance,
            unpack=lambda state, u, t, h, params: {"q": state[:2], "p": state[2:]},
            state_size=4,
            unknowns=0,
            fields={"q": dx.Field((2,)), "p": dx.Field((2,))},
            canonical=True,
        )


def test_a_billionth_that_a_step_loses_is_found_in_any_units():
    system = dx.LagrangeDirac(lambda q, v, l: (v[0] ** 2 + l**2 * v[1] ** 2 - q[0] ** 2) / 2 + l**2 * jnp.cos(q[1]))
    for l in (1.0, 2.0**-33, 2.0**20):
        run = dx.simulate(system, Damped(), q=[l, 0.3], v=[0.0, 0.1], params=l, step=0.1, steps=10)
        line = dx.verify(run)["symplecticity of one step"]
        assert line.verdict == "VIOLATED" and 0.5e-9 < line.value < 1e-9, line  # of {θ', p_θ'} = 1 − loss


@pytest.mark.parametrize("engine", ["native", "xla"])
@pytest.mark.soak_of("xla")
def test_steps_by_collocation_are_solved_whatever_the_mass(engine):
    run = lambda m: dx.simulate(KEPLER, dx.Collocation(2), q=[1.0, 0.0], v=[0.0, 1.2], params=m, step=0.1, steps=9, engine=engine)
    lines = [dx.verify(run(m))["steps solved"] for m in (1.0, 2.0**-30, 2.0**60)]
    assert lines[0].verdict == "ok" and 0.0 < lines[0].value < 1e-15 and len({line.value for line in lines}) == 1


@pytest.mark.parametrize("scheme", [dx.Collocation(2), dx.LagrangeDAlembert()])
@pytest.mark.soak_of("scheme0")
def test_steps_at_an_equilibrium_are_solved(scheme):
    """The force 0.981 − 0.981 leaves speeds of a rounding, to which nothing is relative."""
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - 2.943 * q[0] ** 2 + 0.981 * q[0])
    line = dx.verify(dx.simulate(system, scheme, q=[1 / 6], v=[0.0], step=0.1, steps=40))["steps solved"]
    assert line.verdict == "ok" and line.value < 1e-15


@pytest.mark.parametrize("scheme", [dx.DiscreteDirac(), dx.DiscreteGradient()])
@pytest.mark.soak
def test_steps_are_replayed_in_any_units(scheme):
    """The momentum of a top of 1e-25 beside its direction of size 1: steps were taken again with a billionth of their digits."""
    found = []
    for m in (1.0, 2.0**-80, 2.0**40):
        x = np.array([0.3 * m, 0.9 * m, -0.4 * m, 0.6, 0.0, 0.8])
        sol = dx.simulate(TOP, scheme, x=x, params=m, step=0.05, steps=10)
        line = replayed(sol, None)
        assert line.verdict == "ok" and line.value < 1e-15, line
        found.append(symplecticity(sol, None).verdict)
    assert len(set(found)) == 1


def test_what_is_left_of_a_zero_is_not_a_form_that_changed():
    """Six oscillators through the orthogonal matrix of the cosine transform: of AᵀA beside the diagonal roundoff is left, which
    is all that these entries of the step's derivative have."""
    k = np.arange(6)
    A = np.sqrt(np.where(k == 0, 1, 2) / 6)[:, None] * np.cos(np.pi * k[:, None] * (k + 0.5) / 6)
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - jnp.sum((A @ q) ** 2) / 2)
    q = np.linspace(-1, 1, 6) ** 3 + 0.3
    line = symplecticity(dx.simulate(system, dx.LagrangeDAlembert(), q=q, v=np.zeros(6), step=0.1, steps=5), None)
    assert line.verdict == "ok" and line.value is not None and line.value < 1e-15


@pytest.mark.parametrize("scheme", [dx.LagrangeDAlembert(), dx.MinusLagrangeDirac()], ids=lambda scheme: type(scheme).__name__)
def test_each_one_form_may_have_a_unit_of_its_own(scheme):
    def last(unit):
        system = dx.LagrangeDirac(
            lambda q, v: v @ v / 2 - q[2], lambda q: jnp.array([[q[1], -q[0], 1.0, 0.3], [0.0, 0.0, unit, unit * q[0]]])
        )
        sol = dx.simulate(system, scheme, q=[0.6, 0.8, 0.2, 0.0], v=[0.4, -0.3, 0.5, 0.1], step=0.01, steps=30, project=True)
        assert dx.verify(sol).ok
        return sol.q[-1]

    np.testing.assert_allclose([last(1e12), last(1e-13)], [last(1.0)] * 2, atol=1e-12)


@pytest.mark.parametrize("unit", [1e-9, 1e-12])
def test_method_2_takes_a_regular_lagrangian_in_any_units(unit):
    def motion(e):
        kinetic = lambda v: v[0] ** 2 / 2 + e**2 * v[1] ** 2 / 2 + 0.2 * e * v[0] * v[1]
        system = dx.LagrangeDirac(lambda q, v: kinetic(v) - q[0] ** 2 / 2 - e**2 * q[1] ** 2 / 2)
        run = {"q": [0.3, 0.2 / e], "v": [0.1, 0.4 / e], "step": 0.05, "steps": 50}
        return dx.simulate(system, dx.DiscreteDirac(constraints="resolve"), **run).q * [1.0, e]

    np.testing.assert_allclose(motion(unit), motion(1.0), atol=1e-12)


@pytest.mark.parametrize("theta", [0.3, 0.5])
def test_twins_of_a_hamiltonian_have_one_verdict(theta):
    hamiltonian, matrix = lambda x: x @ x / 2 + x[0] ** 4 / 4, np.array([[0.0, 1.0], [-1.0, 0.0]])
    of_q = lambda q, p: hamiltonian(jnp.concatenate([q, p]))
    twins = {
        dx.DiracSystem(dx.induced_dirac(None, 1), hamiltonian): {"x": [0.3, 0.2]},
        dx.PortHamiltonian(hamiltonian, matrix): {"x": [0.3, 0.2]},
        dx.HamiltonDirac(of_q): {"q": [0.3], "p": [0.2]},
    }
    for system, data in twins.items():
        sol = dx.simulate(system, dx.DiscreteDirac(dx.Theta(theta)), **data, step=0.1, steps=20)
        line = dx.verify(sol)["symplecticity of one step"]
        assert line.verdict == ("ok" if theta == 0.5 else "not checked")
        assert ("is not symplectic" in line.explanation) == (theta != 0.5)
