"""A base point off the middle of the step: what is off a constraint grows, decays or alternates, and what grows is refused."""

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

PENDULUM = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[1], holonomic=lambda q: jnp.array([q @ q - 1.0]))
SKATE = dx.LagrangeDirac(lambda q, v: v @ v / 2, lambda q: jnp.array([[jnp.sin(q[2]), -jnp.cos(q[2]), 0.0]]))
CLOSED = dx.PortHamiltonian(lambda x: x @ x / 2, J=[[0, 1.0, 0], [-1, 0, 0], [0, 0, 0]], B=[[1.0], [0.0], [1.0]], closed=True)
CASES = [
    (PENDULUM, {"q": [1.0, 0.0], "v": [0.0, 0.3]}, 0.7, 0.3),
    (SKATE, {"q": [0.0, 0.0, 0.0], "v": [1.0, 0.0, 0.5]}, 0.7, 0.3),
    (CLOSED, {"x": [1.0, 0.2, -1.0]}, 0.3, 0.7),
]


@pytest.mark.parametrize(("system", "start", "grows", "decays"), CASES, ids=["holonomic", "one-forms", "closed port"])
@pytest.mark.soak_of(but=["one-forms"])
def test_what_grows_is_refused_and_what_decays_runs(system, start, grows, decays):
    run = start | {"step": 1 / 160, "steps": 160}
    with pytest.raises(ValueError, match=r"by −2\.33, whatever its size.*dx\.Midpoint"):
        dx.simulate(system, dx.DiscreteDirac(dx.Theta(grows)), **run)
    sol = dx.simulate(system, dx.DiscreteDirac(dx.Theta(decays)), **run)
    assert sol.ok and max(np.abs(a).max() for name, a in sol.fields.items() if name != "multipliers") < 5
    assert dx.simulate(system, dx.DiscreteDirac(), **run).ok
    for scheme in (dx.Adjoint(dx.DiscreteDirac(dx.Theta(decays))), dx.SymmetricComposition(dx.DiscreteDirac(dx.Theta(decays)))):
        with pytest.raises(ValueError, match=r"by −2\.33"):
            dx.simulate(system, scheme, **run)


@pytest.mark.parametrize(("system", "start"), [CASES[0][:2], CASES[1][:2]], ids=["holonomic", "one-forms"])
@pytest.mark.soak_of("one-forms")
def test_a_base_point_at_an_end(system, start):
    """θ = 1: W(q_1) ∂H/∂p(q_1, p_0) = 0 has no force in it. What is off it at θ = 0 is gone after a step."""
    run = start | {"step": 1 / 160, "steps": 3}
    first, last = dx.DiscreteDirac(dx.Theta(0.0)), dx.DiscreteDirac(dx.Theta(1.0))
    for scheme in (last, dx.SymmetricComposition(last), dx.Composition(last, (0.5, 0.5))):
        with pytest.raises(
            ValueError, match=r"forces of the constraints of this LagrangeDirac.*leave the forces free.*dx\.Midpoint"
        ):
            dx.simulate(system, scheme, **run)
    for scheme in (dx.Adjoint(first), dx.SymmetricComposition(first)):
        with pytest.raises(ValueError, match="without bound, whatever its size"):
            dx.simulate(system, scheme, **run)
    assert dx.simulate(system, first, **run).ok and dx.simulate(system, dx.Adjoint(last), **run).ok


def test_the_adjoint_of_what_grows_decays():
    start = CASES[0][1] | {"step": 1 / 160, "steps": 160}
    solution = dx.simulate(PENDULUM, dx.Adjoint(dx.DiscreteDirac(dx.Theta(0.7))), **start)
    expected = dx.simulate(PENDULUM, dx.DiscreteDirac(dx.Theta(0.3)), **start)
    np.testing.assert_allclose(solution.q, expected.q, rtol=0, atol=1e-12)


@pytest.mark.soak
def test_regular_systems_have_nothing_that_grows():
    stiff = dx.LagrangeDirac(lambda q, v: v @ v / 2 - 1e6 * q @ q)
    for theta in (0.0, 0.3, 0.7, 1.0):
        assert dx.simulate(stiff, dx.DiscreteDirac(dx.Theta(theta)), q=[1e-3], v=[0.0], step=1e-5, steps=3).ok
    assert dx.simulate(stiff, dx.SymmetricComposition(dx.DiscreteDirac(dx.Theta(0.3))), q=[1.0], v=[0.0], step=1e-5, steps=3).ok
