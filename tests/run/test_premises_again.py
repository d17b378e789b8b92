"""What a system presupposes of numbers is asked at every run, and of every trajectory of a batch."""

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx

PORT = dx.PortHamiltonian(
    lambda x: x @ x / 2,
    J=lambda x, params: jnp.array([[0.0, 1.0 + x[0]], [params["a"] - x[0], 0.0]]),
    R=lambda x: jnp.array([[x[1], 0.0], [0.0, 0.1]]),
)
METRIC = dx.NonholonomicMechanics(
    lambda t, q: jnp.array([[1.0 + q[0] - t, 0.0], [0.0, 1.0]]),
    lambda q: q @ q / 2,
    one_forms=lambda q: jnp.array([[jnp.sin(q[0]), 1.0]]),
)
DIRAC = dx.DiracSystem(
    dx.DiracStructure.from_bivector(lambda x: jnp.array([[0.0, 1.0], [-1.0, x[0] * (x[0] - 1.0)]])), lambda x: x @ x / 2
)
REDUCED = dx.reduce(
    dx.LagrangeDirac(
        lambda q, v, params: (v[0] ** 2 + q[0] ** 2 * v[1] ** 2) / 2 - params["k"] * q[0] ** 2 * (1 + params["e"] * q[1])
    ),
    dx.LinearConnection(fibre=[1]),
)
LATER = jnp.vectorize(lambda t: jnp.where(t > 3.0, 1.0, 0.0))  # a field that is switched on
SWITCHED = dx.reduce(dx.LagrangeDirac(lambda t, q, v: v @ v / 2 - LATER(t) * jnp.cos(q[1])), dx.LinearConnection([1]))
ROUND = dx.ManifoldLagrangian(
    lambda q, v: v @ v / 2, dx.Product(dx.Sphere(3), dx.Torus(1)), forces=lambda t, q, v: LATER(t) * jnp.eye(4)[3] * jnp.sin(q[3])
)
FADING = dx.LagrangeDirac(lambda t, q, v: (v[0] ** 2 + LATER(3.5 - t) * v[1] ** 2 - q @ q) / 2)
BODY = dx.EulerPoincare(dx.SO3(), lambda xi, params: xi @ (params["inertia"] * xi) / 2)

CASES = {
    "skewness": (PORT, dx.DiscreteGradient(), {"x": [0.3, 0.2], "params": {"a": -1.0}}, {"params": {"a": -1.1}}, "J is not skew"),
    "dissipation": (
        PORT,
        dx.DiscreteGradient(),
        {"x": [0.3, 0.2], "params": {"a": -1.0}},
        {"x": [0.3, -0.2]},
        "not positive semi",
    ),
    "metric": (
        METRIC,
        dx.LagrangeDAlembert(),
        {"q": [0.0, 0.2], "v": [1.0, 0.0]},
        {"t0": 1.5},
        "metric is not positive definite",
    ),
    "structure": (DIRAC, dx.DiscreteDirac(), {"x": [1.0, 0.2]}, {"x": [2.0, 0.2]}, "skew"),
    "fixed point": (
        *(REDUCED, dx.PlusLagrangeDirac("midpoint"), {"q": [1.0, 0.2], "v": [0.1, 0.9], "params": {"k": 1.0, "e": 0.0}}),
        *({"q": [0.0, 0.2]}, "orbits of the group are not free"),
    ),
    "symmetry": (
        *(REDUCED, dx.PlusLagrangeDirac("midpoint"), {"q": [1.0, 0.2], "v": [0.1, 0.9], "params": {"k": 1.0, "e": 0.0}}),
        *({"params": {"k": 1.0, "e": 0.1}}, "not invariant"),
    ),
    "symmetry at that time": (
        *(SWITCHED, dx.PlusLagrangeDirac("midpoint"), {"q": [1.0, 0.2], "v": [0.1, 0.9]}, {"t0": 5.0}, "not invariant"),
    ),
    "symmetry of a bundle at that time": (
        *(dx.reduce(ROUND, dx.LinearConnection([3])), dx.LagrangeDAlembert()),
        *({"q": [0.0, 0.0, 1.0, 0.5], "v": [0.3, 0.2, 0.0, 0.8]}, {"t0": 5.0}, "not invariant"),
    ),
    "momentum along the group at that time": (
        dx.reduce(dx.LagrangeDirac(lambda q, v: v @ v / 2, forces=lambda t, q, v: LATER(t) * v), dx.LinearConnection([1])),
        *(dx.DiscreteRouth("midpoint"), {"q": [1.0, 0.2], "v": [0.1, 0.9]}, {"t0": 5.0}, "the forces f.* move"),
    ),
    "Hessian at that time": (
        *(
            FADING,
            dx.DiscreteDirac(constraints="resolve"),
            {"q": [1.0, 0.2], "v": [0.1, 0.9]},
            {"t0": 5.0},
            "∂²L/∂v² has rank 1 of 2",
        ),
    ),
    "inertia": (
        *(BODY, dx.DiscreteEulerPoincare(), {"x": [0.3, 0.1, 0.2], "params": {"inertia": np.array([1.0, 2.0, 3.0])}}),
        *({"params": {"inertia": np.array([1.0, 0.0, 3.0])}}, "singular"),
    ),
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.soak_of(but=["skewness", "dissipation", "metric", "structure", "symmetry", "inertia"])
def test_a_prepared_run_refuses_what_a_first_one_refuses(name):
    system, scheme, good, bad, message = CASES[name]
    run = dx.prepare(system, scheme, **good, step=0.01, steps=2)
    assert run().ok and run(t0=0.001).ok
    with pytest.raises(ValueError, match=message):
        run(**bad)
    assert run().ok
    again = lambda **other: dx.simulate(system, scheme, **({**good, "step": 0.01, "steps": 2} | other))
    assert all(again().ok for _ in range(3))
    with pytest.raises(ValueError, match=message):
        again(**bad)


@pytest.mark.parametrize("name", ["dissipation", "structure", "fixed point"])
def test_a_batch_refuses_what_one_of_its_trajectories_may_not_have(name):
    system, scheme, good, bad, message = CASES[name]
    (key, value), fixed = next(iter(bad.items())), {k: v for k, v in good.items() if k not in bad}
    batch = lambda last: dx.simulate(system, scheme, **fixed, **{key: np.array([good[key], good[key], last])}, step=0.01, steps=2)
    assert all(batch(good[key]).ok.all() for _ in range(3))
    with pytest.raises(ValueError, match=message):
        batch(value)
