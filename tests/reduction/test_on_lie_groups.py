"""Derivatives, batches, left-invariance and errors of mechanics on Lie groups."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import dirax as dx
from dirax import gallery
from lie_groups import matrices, run

I = np.array([1.0, 2.0, 3.0])
SO3 = dx.SO3()
BODY = dx.EulerPoincare(SO3, lambda xi: xi @ (jnp.asarray(I) * xi) / 2)
OMEGA = np.array([0.3, 1.0, 0.4])
UNEVEN = np.array([[1.0, 0.1, 0.3], [0.1, 1.5, 0.2], [0.3, 0.2, 2.0]])
TOP = gallery.get("heavy-top")


@pytest.mark.soak
def test_batches_are_their_trajectories_and_derivatives_those_of_differences():
    top = dx.EulerPoincare(SO3, lambda xi, params: xi @ (params * xi) / 2)
    xi = np.array([[0.1, 1.0, 0.2], [0.5, -0.2, 0.7]])
    x = top.state(xi, params=jnp.asarray(I))
    both = run(top, "exp", x=x, params=I, steps=50, engine="native")
    for lane in (0, 1):
        one = run(top, "exp", x=x[lane], params=I, steps=50, engine="native")
        assert np.array_equal(both.x[lane], one.x) and np.array_equal(both.g[lane], one.g)
    assert np.abs(run(top, "exp", x=x, params=I, steps=50, engine="xla").g - both.g).max() < 1e-13
    lifted = dx.reconstruct(both, g0=np.array([[1.0, 0, 0, 0], [0.6, 0.8, 0, 0]]))
    assert lifted.q.shape == (2, 51, 4) and np.ptp(lifted.spatial_momentum, axis=1).max() < 1e-14

    def end(inertia):
        return dx.simulate(top, dx.DiscreteEulerPoincare(), x=x[0], params=inertia, step=0.1, steps=10)

    back = jax.jit(jax.grad(lambda inertia: jnp.sum(dx.reconstruct(end(inertia)).q[-1])))(jnp.asarray(I))
    differences = [(dx.reconstruct(end(I + d)).q[-1] - dx.reconstruct(end(I - d)).q[-1]).sum() / 2e-5 for d in 1e-5 * np.eye(3)]
    assert np.asarray(back) == pytest.approx(np.array(differences), abs=1e-8)


SUSLOV = dx.EulerPoincare(SO3, lambda xi: xi @ (jnp.asarray(UNEVEN) @ xi) / 2, [[0, 0, 1.0]])


def with_forms(matrix):
    return dx.EulerPoincare(SO3, BODY.lagrangian.function, matrix)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: dx.EulerPoincare("SO3", lambda xi: xi @ xi), "group must be a Lie group such as dx.SO3"),
        (lambda: dx.EulerPoincare(SO3, lambda xi, a, b: xi @ xi), r"lagrangian\(xi\[, params\]\)"),
        (lambda: dx.EulerPoincare(SO3, lambda xi, a: xi @ a, advected=2), "a multiple of 3"),
        (lambda: dx.DiscreteEulerPoincare("log"), "map must be exp or cayley, but 'log'"),
        (lambda: BODY.state([1.0, 2.0]), r"xi must have shape \(3,\)"),
        (lambda: run(BODY, x=[1.0, 2.0]), r"starts from x= μ of shape \(3,\), but x has shape \(2,\)"),
        (lambda: run(BODY, q=[1.0, 0, 0], v=[1.0, 0, 0]), r"q must have shape \(4,\)"),
        (lambda: run(BODY, q=[2.0, 0, 0, 0], v=[0.0, 1, 0, 0]), r"q is not on SO3"),
        (lambda: run(BODY, q=[1.0, 0, 0, 0], v=[1.0, 0, 0, 0]), r"v is not tangent to SO3"),
        (lambda: run(BODY, x=BODY.state([0.0, 40.0, 0.0])), "of a step that turns by less than π"),
        (lambda: run(BODY, "cayley", x=BODY.state([0.0, 40.0, 0.0])), "of a step that turns by less than π"),
        (lambda: run(dx.EulerPoincare(SO3, lambda xi: xi), x=OMEGA), r"must return a scalar, but it returned shape \(3,\)"),
        (lambda: run(dx.EulerPoincare(SO3, lambda xi: xi[0] ** 2 + xi[1] ** 2), x=OMEGA), "singular .* rank 2 of 3"),
        (lambda: run(SUSLOV, x=SUSLOV.state(OMEGA)), r"off the constraint, whose residual is \[0.4\]"),
        (
            lambda: run(dx.EulerPoincare(SO3, BODY.lagrangian.function, [1.0, 0, 0]), x=OMEGA),
            r"one_forms must have shape \(m, d\)",
        ),
        (lambda: run(with_forms(np.ones((2, 3))), x=OMEGA), "independent, .* has rank 1"),
        (lambda: SUSLOV.lie_poisson(), "no Lie–Poisson system"),
        (lambda: dx.simulate(BODY, dx.PlusLagrangeDirac(), x=OMEGA, step=0.1, steps=1), "EulerPoincare"),
        (lambda: TOP.simulate(dx.DiscreteEulerPoincare()), "DiracSystem"),
        (lambda: dx.reconstruct(run(BODY, x=OMEGA, steps=1), g0=[1.0, 0, 0]), r"shape \(4,\), or a matrix \(3, 3\)"),
        (lambda: dx.reconstruct(run(BODY, x=OMEGA, steps=1), g0=[1.0, 1.0, 0, 0]), "no element of SO3: it is off by 0.414"),
        (lambda: dx.reconstruct(run(BODY, x=OMEGA, steps=1), g0=-np.eye(3)), "no element of SO3"),
    ],
)
@pytest.mark.soak_of("<lambda>-of a step that turns by less than \\u03c0_0")
def test_errors_say_what_came_and_the_way_out(make, message):
    with pytest.raises((TypeError, ValueError), match=message):
        make()


def test_projection_changes_the_momentum_by_a_reaction():
    sol = run(SUSLOV, x=SUSLOV.state(OMEGA), project=True, steps=1)
    assert np.linalg.solve(UNEVEN, sol.x[0])[2] == pytest.approx(0.0, abs=1e-15)
    assert sol.x[0][:2] == pytest.approx((UNEVEN @ OMEGA)[:2], abs=1e-14)


def test_a_motion_can_start_from_a_matrix():
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    sol = run(BODY, x=BODY.state(OMEGA), steps=10)
    assert np.abs(matrices(SO3, dx.reconstruct(sol, g0=turn).q) - turn @ matrices(SO3, sol.g)).max() < 1e-15


# ------------------------------------------------------------------------------------------------------ left-invariance


def on_the_group(potential):
    """½ ω·Iω − potential · R_33, and the constraint that the body does not turn about its own third axis."""

    def lagrangian(q, v):
        omega = SO3.to_algebra(q, v)
        return omega @ (jnp.asarray(I) * omega) / 2 - potential * SO3.matrix(q)[2, 2]

    return dx.LagrangeDirac(lagrangian, lambda q: jax.jacfwd(lambda v: SO3.to_algebra(q, v))(q)[2:])


def test_left_invariance_is_found_and_its_momentum_is_the_spatial_one():
    left, q = dx.LeftTranslation(SO3), np.array([0.6, 0.0, 0.8, 0.0])
    v = np.asarray(SO3.left_translate(jnp.asarray(q), jnp.asarray(OMEGA)))
    assert dx.check_invariance(on_the_group(0.0), left, q=q, v=v)
    found = dx.check_invariance(on_the_group(1.0), left, q=q, v=v)
    assert not found and found.of == "lagrangian" and found.generator in (0, 1)
    sol = dx.reconstruct(run(BODY, x=BODY.state(OMEGA), steps=10), g0=q)
    spatial = jax.vmap(left.momentum_map)(jnp.asarray(sol.q), jnp.asarray(sol.p))
    assert np.abs(np.asarray(spatial) - sol.spatial_momentum).max() < 1e-14
    with pytest.raises(ValueError, match="no element of SO3: it is off by"):
        dx.check_invariance(on_the_group(0.0), left, q=2 * q, v=v)
    with pytest.raises(ValueError, match=r"an element of SO3 has shape \(4,\)"):
        dx.check_invariance(on_the_group(0.0), left, q=q[:3], v=v[:3])


@pytest.mark.soak
def test_verify_measures_the_poisson_structure_and_spatial_momenta():
    body = run(BODY, x=BODY.state(OMEGA), steps=20)
    poisson = next(line for line in dx.verify(body).lines if line.quantity == "symplecticity of one step")
    assert poisson.verdict == "ok" and poisson.value < 1e-14
    sol = dx.reconstruct(gallery.get("heavy-top-so3").simulate(steps=200))
    left, gravity = dx.LeftTranslation(SO3), jnp.asarray(sol.x[0, 3:])
    symmetries = {"gravity": lambda q: left.generator(gravity, q), "x": lambda q: left.generator(jnp.eye(3)[0], q)}
    verdicts = {line.quantity: line.verdict for line in dx.verify(sol, symmetries=symmetries).lines}
    assert verdicts["momentum map gravity"] == "ok" and verdicts["momentum map x"] == "VIOLATED"


@pytest.mark.soak
def test_a_step_that_turns_too_far_ends_the_run_with_a_message():
    top = dx.EulerPoincare(SO3, lambda xi, a: xi @ (jnp.asarray(I) * xi) / 2 - 500.0 * a[2], advected=3)
    sol = dx.simulate(top, dx.DiscreteEulerPoincare(), x=top.state([0, 0.1, 0], [0, 0.1, 0.99]), step=0.1, steps=200)
    assert not sol.ok and "turns by less than π" in sol.message and len(sol.t) < 20


@pytest.mark.parametrize("engine", ["native", "xla"])
@pytest.mark.parametrize("map", ["exp", "cayley"])
@pytest.mark.soak_of("exp-xla", "cayley-xla")
def test_a_body_at_rest_stays_at_rest(map, engine):
    sol = run(BODY, map, x=np.zeros(3), steps=3, engine=engine)
    assert np.all(sol.x == 0) and np.all(sol.g == [1, 0, 0, 0])


def test_a_rotation_that_dies_out_never_fails():
    """The sleigh's turning rate falls below the smallest number whose square is one."""
    sol = gallery.get("chaplygin-sleigh-se2").simulate(steps=200_000, save_every=10_000, step=0.02)
    assert sol.ok and abs(sol.x[-1, 2]) < 1e-160 and sol.x[-1, 0] == pytest.approx(np.sqrt(2 * 0.455), abs=1e-4)
