"""dx.reduce by a Lie group: Lagrangians written on matrices, the unreduced motion on the group, and systems without symmetry."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.gallery import chaplygin_sleigh_se2, free_top, suslov
from lie_groups import basis_of, matrices, orders

SO2, SE2, SO3, SE3 = dx.SO2(), dx.SE2(), dx.SO3(), dx.SE3()
XI = np.array([0.5, -0.3, 0.4, 0.3, 1.0, 0.4])


def spread_of_mass(size):
    """A positive definite M (size, size), so that ½ tr(Ġ M Ġᵀ) is the kinetic energy of a body with these moments."""
    root = np.eye(size) + 0.3 * np.random.default_rng(size).uniform(-1, 1, (size, size))
    return root @ root.T


def on_matrices(group):
    """½ tr(Ġ M Ġᵀ) of the matrices of the elements: left-invariant, since the last row of a homogeneous Ġ is 0."""
    mass = jnp.asarray(spread_of_mass(group.matrix(group.identity()).shape[0]))

    def lagrangian(g, v):
        rate = jax.jvp(group.matrix, (g,), (v,))[1]
        return jnp.sum(rate * (rate @ mass)) / 2

    return lagrangian


@pytest.mark.parametrize("group", [SO2, SE2, SO3, SE3])
@pytest.mark.soak_of(but=["group0"])
def test_inertia_is_that_of_the_matrices(group):
    body = dx.reduce(dx.ManifoldLagrangian(on_matrices(group), group), group)
    assert isinstance(body, dx.EulerPoincare)
    basis, d = basis_of(group), group.dimension
    inertia = np.einsum("aij,jk,bik->ab", basis, spread_of_mass(basis.shape[1]), basis)
    assert np.asarray(body.state(XI[:d])) == pytest.approx(inertia @ XI[:d], abs=1e-13)


@pytest.mark.parametrize("group", [SO3, pytest.param(SE2, marks=pytest.mark.soak), pytest.param(SE3, marks=pytest.mark.soak)])
def test_reduced_and_reconstructed_is_unreduced(group):
    """L_d of the exponential is left-invariant: the same q=, v= give the same motion, and come back without g0."""
    system = dx.ManifoldLagrangian(on_matrices(group), group)
    q = group.group_exp(jnp.asarray(XI[::-1][: group.dimension]))
    v = group.left_translate(q, jnp.asarray(XI[: group.dimension]))
    settings: dict[str, Any] = {"q": np.asarray(q), "step": 0.02, "steps": 500}
    whole = dx.simulate(system, dx.InCharts(dx.LieGroupExp(group, 0.5)), v=np.asarray(v), **settings)
    body = dx.reduce(system, group)
    lifted = dx.reconstruct(dx.simulate(body, dx.DiscreteEulerPoincare(), v=np.asarray(v), **settings))
    assert whole.ok and lifted.ok
    assert np.abs(matrices(group, lifted.q) - matrices(group, whole.q)).max() < 1e-10
    p = np.asarray(system.legendre(q, v))
    from_p = dx.simulate(body, dx.DiscreteEulerPoincare(), p=p, **settings)
    assert np.abs(from_p.x[0] - lifted.x[0]).max() < 1e-14 and np.abs(from_p.g[-1] - lifted.q[-1]).max() < 1e-11


def test_parameters_are_those_of_the_run():
    lagrangian = lambda g, v, params: free_top.lagrangian(SO3.to_algebra(g, v), params)
    body = dx.reduce(dx.ManifoldLagrangian(lagrangian, SO3), SO3, params=free_top.PARAMS)
    params = {"I1": 1.5, "I2": 0.7, "I3": 1.1}
    sols = [
        dx.simulate(system, dx.DiscreteEulerPoincare(), x=np.array([0.3, 0.5, -0.2]), params=params, step=0.1, steps=50)
        for system in (body, free_top.EXAMPLE.system)
    ]
    assert np.abs(sols[0].x - sols[1].x).max() < 1e-15 and np.abs(sols[0].g - sols[1].g).max() < 1e-15


def in_quaternions(inertia, forms):
    """A rigid body with A ω = 0 in the four coordinates of its attitude, |q|² = 1 a holonomic constraint."""
    omega = lambda q, v: SO3.to_algebra(q, v)
    return dx.LagrangeDirac(
        lambda q, v: omega(q, v) @ jnp.asarray(inertia) @ omega(q, v) / 2,
        one_forms=lambda q: jnp.asarray(forms) @ jax.jacfwd(lambda v: omega(q, v))(jnp.zeros(4)),
        holonomic=lambda q: jnp.array([q @ q - 1.0]),
    )


@pytest.mark.soak
def test_suslov_problem_from_its_attitude():
    """The gallery's equations come out, and the unreduced discrete equations, which are others, tend to the same motion."""
    inertia = np.asarray(suslov.inertia(suslov.PARAMS))
    system = in_quaternions(inertia, [[0.0, 0.0, 1.0]])
    reduced = dx.reduce(system, SO3)
    q = np.array([np.cos(0.4), 0.0, np.sin(0.4), 0.0])
    omega = np.linalg.solve(inertia, suslov.EXAMPLE.initial["x"])
    v = np.asarray(SO3.left_translate(jnp.asarray(q), jnp.asarray(omega)))
    scheme, differences = dx.DiscreteEulerPoincare(), []
    for steps in (25, 50, 100):
        settings: dict[str, Any] = {"q": q, "v": v, "step": 1 / steps, "steps": steps, "engine": "native"}
        sol = dx.reconstruct(dx.simulate(reduced, scheme, **settings))
        whole = dx.simulate(system, dx.LagrangeDAlembert(), **settings)
        differences.append(np.abs(sol.q[-1] - whole.q[-1]).max())
    gallery = dx.simulate(
        suslov.EXAMPLE.system, scheme, x=suslov.EXAMPLE.initial["x"], params=suslov.PARAMS, step=0.01, steps=100
    )
    assert np.abs(sol.x - gallery.x).max() < 1e-13 and np.abs(sol.multipliers - gallery.multipliers).max() < 1e-14
    assert orders(differences) == pytest.approx([2, 2], abs=0.1)


def test_chaplygin_sleigh_from_its_place():
    """On SE(2) in the coordinates (cos φ, sin φ, x, y); the closed form of the gallery."""
    params = chaplygin_sleigh_se2.PARAMS
    system = dx.LagrangeDirac(
        lambda q, v, params: chaplygin_sleigh_se2.lagrangian(SE2.to_algebra(q, v), params),
        one_forms=lambda q: jnp.stack([jnp.zeros(()), jnp.zeros(()), -q[1], q[0]])[None],
    )
    with pytest.raises(
        TypeError, match=r"takes params, with which its invariance is checked: dx\.reduce\(system, group, params=…"
    ):
        dx.reduce(system, SE2)
    sleigh = dx.reduce(system, SE2, params)
    x = chaplygin_sleigh_se2.EXAMPLE.initial["x"]
    errors = []
    for steps in (50, 100, 200):
        sol = dx.simulate(sleigh, dx.DiscreteEulerPoincare(), x=x, params=params, step=2 / steps, steps=steps, engine="native")
        errors.append(np.abs(sol.x - chaplygin_sleigh_se2.exact(sol.t, x)).max())
    assert orders(errors) == pytest.approx([2, 2], abs=0.1)


def heavy(g, v):
    return on_matrices(SO3)(g, v) - 0.7 * SO3.matrix(g)[2, 0]


FREE = on_matrices(SO3)
LEFT: Any = dx.LeftTranslation(SO3)
KNIFE_IN_SPACE = lambda q: jax.jacfwd(lambda v: jax.jvp(SO3.matrix, (q,), (v,))[1][2, 0])(jnp.zeros(4))[None]


@pytest.mark.parametrize(
    ("make", "kind", "message"),
    [
        (lambda: dx.reduce(dx.ManifoldLagrangian(heavy, SO3), SO3), ValueError,
         r"left-invariant on SO3, whose elements .*: L\(g, gξ\) − L\(e, ξ\) = -?[0-9.]+ at g = \[.*advected quantity a: write"),
        (lambda: dx.reduce(dx.LagrangeDirac(FREE, KNIFE_IN_SPACE), SO3), ValueError, "one_forms are not left-invariant .* by"),
        (lambda: dx.reduce(dx.LagrangeDirac(FREE, holonomic=lambda q: q[:1] - 1.0), SO3), ValueError,
         "holonomic constraints are not those of SO3"),
        (lambda: dx.reduce(dx.LagrangeDirac(FREE, forces=lambda t, q, v: -v), SO3), ValueError, "the system has forces"),
        (lambda: dx.reduce(dx.LagrangeDirac(lambda t, q, v: FREE(q, v)), SO3), ValueError, "the system has explicit time"),
        (lambda: dx.reduce(dx.ManifoldLagrangian(FREE, SO3), SE3), ValueError, "takes one on SE3 itself"),
        (lambda: dx.reduce(dx.PhaseSpaceLagrangian(lambda q: q, lambda q: q @ q), SO3), TypeError, "takes a dx.Manifold"),
        (lambda: dx.reduce(dx.LagrangeDirac(FREE), LEFT), TypeError, "or a Lie group such as"),
    ],
)  # fmt: skip
@pytest.mark.soak_of("<lambda>-ValueError-message0")
def test_mistakes(make, kind, message):
    with pytest.raises(kind, match=message):
        make()


@pytest.mark.parametrize("unit", [1e-26, 1e20])
@pytest.mark.soak
def test_units_hide_no_asymmetry_and_make_none(unit):
    """A heavy body of 1e-26 kg was taken for a free one, and forms and constraints of small units for invariant ones."""
    scaled = lambda function: lambda *values: unit * function(*values)
    body, wide = dx.LagrangeDirac(scaled(FREE)), dx.LagrangeDirac(scaled(FREE), scaled(KNIFE_IN_SPACE))
    assert dx.reduce(body, SO3) is not None
    for system, message in (
        (dx.ManifoldLagrangian(scaled(heavy), SO3), "lagrangian is not left-invariant"),
        (wide, "one_forms are not left-invariant"),
        (dx.LagrangeDirac(scaled(FREE), holonomic=scaled(lambda q: q[:1] - 1.0)), "holonomic constraints are not those"),
    ):
        with pytest.raises(ValueError, match=message):
            dx.reduce(system, SO3)


def test_what_is_said_of_a_start_on_the_group_with_advected_quantities():
    top = dx.EulerPoincare(SO3, lambda xi, a: xi @ xi / 2 - a[2], advected=3)
    with pytest.raises(ValueError, match=r"starts from x= \(μ, a\) of shape \(3 \+ 3,\), but q, v were given"):
        dx.simulate(top, dx.DiscreteEulerPoincare(), q=[1.0, 0, 0, 0], v=[0.0, 1, 0, 0], step=0.1, steps=1)


@pytest.mark.parametrize(
    ("lagrangian", "one_forms", "said"),
    [
        (
            lambda q, v: v @ v / 2,
            lambda q: jnp.array([[jnp.sin(q[2]), -jnp.cos(q[2]), 0.0]]),
            r"but the one_forms have 3 columns",
        ),
        (lambda q, v: v @ jnp.diag(jnp.array([1.0, 2.0, 3.0])) @ v / 2, None, r"could not be traced"),
    ],
)
def test_coordinates_that_are_not_those_of_an_element(lagrangian, one_forms, said):
    with pytest.raises(ValueError, match=r"must be those of an element of SE2, \(cos, sin, x, y\).*" + said):
        dx.reduce(dx.LagrangeDirac(lagrangian, one_forms), dx.SE2())
