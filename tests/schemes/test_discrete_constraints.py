"""The discrete constraint algorithm on difference equations whose chains are known by hand ([BLM] Remark 6.1)."""

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.gallery.vortices import point_vortices

TWO = point_vortices((1.0, 2.0))
START = {"q": np.array([0.0, 1.0, 0.2, -0.3]), "v": np.zeros(4)}
H = 0.1
PENDULUM = dx.ImplicitSystem(  # |q| = 1 with the tension as multiplier, index 3
    E=lambda x: jnp.eye(5)[:, :4],
    f=lambda x: jnp.array([x[2], x[3], 0.0, -1.0, (x[0] ** 2 + x[1] ** 2 - 1.0) / 2]),
    B=lambda x: jnp.concatenate([jnp.zeros(2), x[:2], jnp.zeros(1)])[:, None],
)


def dimensions(chain):
    return [level.dimension for level in chain.levels]


def test_method_1_of_two_vortices_is_regular_although_the_system_lives_on_a_graph():
    """The midpoint L_d is regular: every (q, p) has a next one, and M_f = graph α is not the manifold of the method."""
    chain = dx.discrete_constraint_algorithm(TWO, dx.DiscreteDirac(), near=START, step=H)
    assert (dimensions(chain), chain.verdict, chain.agrees) == ([8], "determined", False)
    assert chain.continuous.dimension == 4 and chain.distance > 1e-4
    assert "method of its own" in str(chain) and "every state has a next one" in str(chain)


def test_method_2_of_two_vortices_stays_on_the_graph():
    chain = dx.discrete_constraint_algorithm(TWO, dx.DiscreteDirac(constraints="resolve"), near=START, step=H)
    assert (dimensions(chain), chain.agrees) == ([4], True) and chain.distance < 1e-14
    assert "the nodes stay on it" in chain.comparison


@pytest.mark.soak
def test_a_secondary_constraint_of_the_difference_equations():
    """L = (q̇_0 − q_1)²/2, midpoint: with w = Δq_0/h − q̄_1, p = (w, hw/2) and p' = (w, −hw/2). So p_1 = h p_0/2 on M_d,0,
    p'_1 = h p'_0/2 gives w = 0 on M_d,1, and q̄_1 stays free: M_d,f is M_f = {p = 0} although M_d,0 is not M_0 = {p_1 = 0}."""
    system = dx.LagrangeDirac(lambda q, v: (v[0] - q[1]) ** 2 / 2)
    near = {"q": [0.1, 0.2], "v": [0.3, 0.4]}
    chain = dx.discrete_constraint_algorithm(system, dx.DiscreteDirac(), near=near, step=H)
    assert (dimensions(chain), chain.verdict, chain.freedom, chain.agrees) == ([3, 2, 2], "gauge freedom", 1, True)
    primary, secondary = chain.levels[0].constraints, chain.levels[1].constraints
    assert float(primary(jnp.array([0.5, -0.2, 0.8, 0.8 * H / 2]), None)[0]) == pytest.approx(0.0, abs=1e-15)
    assert abs(float(primary(jnp.array([0.5, -0.2, 0.8, 0.0]), None)[0])) > 0.01
    assert float(secondary(jnp.array([0.5, -0.2, 0.0, 0.0]), None)[0]) == pytest.approx(0.0, abs=1e-15)
    assert abs(float(secondary(jnp.array([0.5, -0.2, 0.8, 0.8 * H / 2]), None)[0])) > 0.01
    assert chain.to_dict()["levels"][0]["count"] == 1


def test_inconsistent_difference_equations_end_empty():
    """L = q̇_0²/2 + q_1: p_1 = −h/2 is needed to leave a node, and p_1 = h/2 is what arrives."""
    system = dx.LagrangeDirac(lambda q, v: v[0] ** 2 / 2 + q[1])
    chain = dx.discrete_constraint_algorithm(system, dx.DiscreteDirac(), near={"q": [0.1, 0.2], "v": [0.3, 0.4]}, step=H)
    assert chain.empty and chain.dimension == -1 and dimensions(chain) == [3] and chain.agrees
    assert "inconsistent" in chain.explanation and chain.state[3] == pytest.approx(-H / 2, abs=1e-14)


@pytest.mark.soak
def test_the_midpoint_rule_of_an_index_3_pendulum_has_no_constraint():
    """|q̄| = 1 at midpoints determines the tension of the step, whatever the node."""
    chain = dx.discrete_constraint_algorithm(PENDULUM, dx.DiscreteDirac(), near=np.array([0.6, -0.81, 0.3, 0.2]), step=0.01)
    assert (dimensions(chain), chain.levels[0].rank, chain.agrees) == ([4], 5, False)


@pytest.mark.soak
def test_the_explicit_rule_of_an_index_3_pendulum_has_a_hidden_constraint_of_its_own():
    """θ = 0: |q| = 1 at this node and at the next, |q + hp| = 1, which is q·p = −h|p|²/2 and not q·p = 0."""
    scheme = dx.DiscreteDirac(dx.Theta(0.0))
    chain = dx.discrete_constraint_algorithm(PENDULUM, scheme, near=np.array([0.6, -0.81, 0.3, 0.2]), step=H)
    assert (dimensions(chain), chain.verdict, chain.agrees) == ([3, 2, 2], "determined", False)
    q, p = chain.state[:2], chain.state[2:]
    assert [q @ q, (q + H * p) @ (q + H * p)] == pytest.approx([1.0, 1.0], abs=1e-13)
    angle, speed = 0.7, 0.3
    radial = (np.sqrt(1 - (H * speed) ** 2) - 1) / H  # q·p of a tangential speed
    out, along = np.array([np.sin(angle), -np.cos(angle)]), np.array([np.cos(angle), np.sin(angle)])
    on = jnp.asarray(np.concatenate([out, speed * along + radial * out]))
    assert np.abs(chain.constraints(on)).max() < 1e-12
    assert np.abs(chain.constraints(on.at[2:].set(speed * along))).max() > 1e-4
    assert chain.levels[1].constraints(on.at[2:].add(0.1 * out), None)[0] != pytest.approx(0.0, abs=1e-4)
    assert "another manifold" in chain.comparison


def test_what_it_does_not_take():
    with pytest.raises(TypeError, match="composition of several"):
        dx.discrete_constraint_algorithm(TWO, dx.Composition(dx.DiscreteDirac(), "yoshida4"), near=START, step=H)
    with pytest.raises(ValueError, match="step must be positive"):
        dx.discrete_constraint_algorithm(TWO, dx.DiscreteDirac(), near=START, step=-H)
    with pytest.raises(ValueError, match="near must be finite"):
        dx.discrete_constraint_algorithm(PENDULUM, dx.DiscreteDirac(), near=np.full(4, np.nan), step=H)


@pytest.mark.soak
def test_chains_in_other_units():
    """Of a pendulum with one coordinate that L does not know, in metres and in nanometres: dimensions were others."""
    found, scheme = [], dx.DiscreteDirac()
    for length, mass, time in ((1.0, 1.0, 1.0), (2.0**-30, 2.0**-86, 2.0**-20), (2.0**35, 2.0**20, 2.0**25)):
        system = dx.LagrangeDirac(
            lambda q, v, p: p["m"] * (v[:2] @ v[:2]) / 2 - p["m"] * p["g"] * q[1],
            holonomic=lambda q, p: jnp.stack([q[:2] @ q[:2] - p["l"] ** 2]),
        )
        params = {"m": 1.5 * mass, "g": 9.8 * length / time**2, "l": length}
        near = {"q": np.array([0.6, -0.8, 0.3]) * length, "v": np.array([0.8, 0.6, 0.0]) * length / time}
        chain = dx.discrete_constraint_algorithm(system, scheme, near=near, step=0.05 * time, params=params)
        found.append((str(chain), chain.state[:3] / length))
    for said, q in found[1:]:
        assert said == found[0][0]
        np.testing.assert_allclose(q, found[0][1], rtol=0, atol=1e-13)
