"""dx.verify on the quotient: the structure of the motion that comes back, and μ."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.gallery import charged_particle, rolling_disk

PARTICLE: Any = charged_particle.EXAMPLE
DISK: Any = rolling_disk.EXAMPLE
SKATE = dx.LagrangeDirac(
    lambda q, v: v[:3] @ v[:3] / 2 + (1 + q[0] ** 2) * (v[3] + 0.4 * v[2]) ** 2 / 2 - jnp.cos(q[1]),
    lambda q: jnp.stack([jnp.sin(q[2]), -jnp.cos(q[2]), jnp.zeros(()), jnp.zeros(())])[None],
    forces=lambda t, q, v: jnp.append(-0.1 * v[:3], 0.0),
)
"""On a knife edge, with a rotor of angle q[3] that nothing pushes."""

TWIST = [[0.3, -0.2, 0.1]]
STRUCTURE = ("(+)-discrete Dirac structure", "(−)-discrete Dirac structure", "discrete Dirac structure")


def particle(scheme, steps=60):
    reduced = dx.reduce(PARTICLE.system, dx.LinearConnection([3], TWIST))
    return dx.simulate(reduced, scheme, params=PARTICLE.params, step=0.1, steps=steps, engine="native", **PARTICLE.initial)


def verdicts(sol):
    return {line.quantity: line.verdict for line in dx.verify(sol).lines}


@pytest.mark.parametrize(("scheme", "name"), [(dx.PlusLagrangeDirac(), STRUCTURE[0]), (dx.DiscreteRouth("left"), STRUCTURE[2])])
@pytest.mark.soak_of("scheme1-discrete Dirac structure")
def test_free_systems(scheme, name):
    sol = particle(scheme)
    found = verdicts(sol)
    for line in (name, "saved p", "momentum map μ", "symplecticity of one step"):
        assert found[line] == "ok", line
    lifted = dx.reconstruct(sol)
    assert verdicts(lifted) == {k: v for k, v in found.items() if k != "momentum map μ"}
    assert lifted.scheme.discrete_lagrangian == "left" and not isinstance(lifted.scheme, dx.DiscreteRouth)


def test_a_part_begins_on_the_configuration_space():
    sol = particle(dx.PlusLagrangeDirac(), steps=12)
    part, whole = sol[4:12], dx.reconstruct(sol)
    assert set(part.initial) == {"q", "p"} and "VIOLATED" not in verdicts(part).values()
    np.testing.assert_array_equal(dx.reconstruct(part).q, whole.q[4:12])
    np.testing.assert_array_equal(part.initial["p"], whole.p[4])
    lost = sol.replace(scheme=None, equation=None)
    assert "without its scheme" in dx.verify(lost)["steps replayed"].explanation


def test_damage_is_seen():
    sol = particle(dx.PlusLagrangeDirac(), steps=20)
    sol.fields["mu"][12:] += 1e-9
    report = dx.verify(sol)
    largest = max(np.abs(sol.mu).max(), np.abs(sol.w).max())
    assert report["momentum map μ"].verdict == "VIOLATED"
    assert report["momentum map μ"].value == pytest.approx(1e-9 / largest, rel=1e-3)
    assert report["saved p"].verdict == "VIOLATED"
    sol = particle(dx.PlusLagrangeDirac(), steps=20)
    sol.fields["x"][12:, 0] += 1e-9
    assert dx.verify(sol)[STRUCTURE[0]].verdict == "VIOLATED"


@pytest.mark.soak
def test_constraints_and_forces():
    """Where they move μ, that is no fault; where they do not, it is judged."""
    settings: dict[str, Any] = {"params": DISK.params, "step": 1e-3, "steps": 40, "engine": "native", **DISK.initial}
    disk = dx.simulate(dx.reduce(DISK.system, dx.LinearConnection([0, 1])), dx.MinusLagrangeDirac(), **settings)
    report = dx.verify(disk)
    assert report[STRUCTURE[1]].verdict == report["saved p and multipliers"].verdict == "ok"
    moved = report["momentum map μ"]
    assert moved.verdict == "not checked" and moved.value == pytest.approx(np.abs(disk.mu - disk.mu[0]).max())
    reduced = dx.reduce(SKATE, dx.LinearConnection([3], [[0.3, -0.2, 0.4]]))
    for scheme in (dx.DiscreteRouth(), dx.LagrangeDAlembert()):
        skate = dx.simulate(reduced, scheme, step=0.01, steps=40, engine="native",
                            q=[0.1, 0.2, 0.0, 0.0], v=[0.6, 0.0, 0.4, 0.9])  # fmt: skip
        found = verdicts(skate)
        for line in (STRUCTURE[2], "saved p and multipliers", "momentum map μ", "constraint"):
            assert found[line] == "ok", line


def test_a_composition_comes_back_as_one_on_q():
    lifted = dx.reconstruct(particle(dx.Composition(dx.DiscreteRouth(), "suzuki4"), steps=5))
    assert isinstance(lifted.scheme, dx.Composition) and isinstance(lifted.scheme.scheme, dx.LagrangeDAlembert)
    whole = dx.simulate(PARTICLE.system, lifted.scheme, params=PARTICLE.params, step=0.1, steps=5, engine="native",
                        **PARTICLE.initial)  # fmt: skip
    assert np.abs(lifted.q - whole.q).max() < 1e-13
