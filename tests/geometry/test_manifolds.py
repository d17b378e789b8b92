"""Manifolds and Lie groups: laws on random points, closed forms, small angles, and derivatives where formulas divide by zero."""

import functools

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

from dirax.geometry.lie_groups import SE2, SE3, SO2, SO3
from dirax.geometry.products import Product
from dirax.geometry.spaces import Circle, Euclidean, Sphere, Torus
from dirax.geometry.squared_angles import arc_over_sine, norm, radial
from dirax.program.roots import regular_root
from dirax.program.rounding import rounding

BATCH = 6
GROUPS = {"SO2": SO2(), "SE2": SE2(), "SO3": SO3(), "SE3": SE3()}
MANIFOLDS = {
    "Euclidean": Euclidean(3),
    "Circle": Circle(),
    "Torus": Torus(3),
    "circle in the plane": Sphere(2),
    "Sphere(3)": Sphere(3),
    "Sphere(5)": Sphere(5),
    **GROUPS,
    "Product": Product(Sphere(3), Torus(1), Product(SO3(), Euclidean(2))),
}
examples = settings(max_examples=12, deadline=None)
seeds = st.integers(0, 2**32 - 1)


def inside(manifold, x, v, reach):
    """v, shortened to at most `reach` of the injectivity radius."""
    return v * jnp.minimum(1.0, reach / jnp.maximum(manifold.exp_reach(x, v), 1e-3))


def random_arrays(seed, *shape):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape))


@functools.cache
def manifold_laws(name):
    manifold = MANIFOLDS[name]

    def laws(a, b, c, r, scale):
        x = manifold.nearest(a)
        v = inside(manifold, x, scale * manifold.projection(x, b), 0.95)
        w = manifold.projection(x, c)
        near = inside(manifold, x, v, 0.45)
        zero, time = jnp.zeros_like(v), jnp.asarray(0.3)
        # one trace of each function serves all that is asked of it: it is compiled once
        pushed = lambda f, v, w: jax.jvp(lambda v: f(x, v), (v,), (w,))
        moved = lambda f, *pairs: jax.vmap(lambda v, w: pushed(f, v, w))(*map(jnp.stack, zip(*pairs, strict=True)))
        (y, later, _), (_, speed, by_exp) = moved(manifold.exp, (v, w), (time * v, v), (zero, w))
        (there, close, _), (_, _, by_retraction) = moved(manifold.retraction, (v, w), (near, w), (zero, w))
        ends = jnp.stack([x, y]), jnp.stack([y, x])
        log, back = jax.vmap(manifold.log)(*ends)
        there_and_back = jax.vmap(manifold.distance)(*ends)
        along, carried = jax.vmap(lambda w: manifold.transport(x, w, y))(jnp.stack([log, w]))
        place, velocity = manifold.geodesic(x, v, time)
        point = manifold.local_parametrization(x)
        origin = jnp.zeros(manifold.dimension)
        frame = manifold.frame(x)
        return {
            "nearest point": manifold.defect(x),
            "projection idempotent": manifold.projection(x, w) - w,
            "projection symmetric": jnp.dot(w, b) - jnp.dot(w, manifold.projection(x, b)),
            "exp on the manifold": manifold.defect(y),
            "point of a geodesic": place - later,
            "velocity of a geodesic": velocity - speed,
            "log tangent": manifold.tangent_defect(x, log),
            "log of exp": log - v,
            "exp of log": manifold.representative(manifold.exp(x, log), y) - y,
            "inverse of retraction": manifold.inverse_retraction(x, close) - near,
            "retraction on the manifold": manifold.defect(there),
            "derivative of exp": by_exp - w,
            "derivative of retraction": by_retraction - w,
            "distance symmetric": there_and_back[0] - there_and_back[1],
            "transport along": along + back,
            "transport isometric": norm(carried) - norm(w),
            "parametrization at 0": point(origin) - x,
            "parametrization on the manifold": manifold.defect(point(3.0 * r)),
            "frame": jax.jacfwd(point)(origin) - frame,
            "frame tangent": jax.vmap(lambda e: manifold.tangent_defect(x, e), 1)(frame),
            "components": manifold.coordinates(x, frame @ r) - r,
            "vector from components": frame @ manifold.coordinates(x, w) - w,
        }

    return jax.jit(jax.vmap(laws, (0, 0, 0, 0, None)))


@pytest.mark.parametrize("name", MANIFOLDS)
@examples
@given(seed=seeds, exponent=st.floats(-9.0, 1.0))
@pytest.mark.soak_of(but=["Product"])
def test_laws(name, seed, exponent):
    manifold = MANIFOLDS[name]
    a, b, c = random_arrays(seed, 3, BATCH, manifold.ambient_dimension)
    r = random_arrays(seed + 1, BATCH, manifold.dimension)
    for law, defect in manifold_laws(name)(a, b, c, r, 10.0**exponent).items():
        # the derivative of log is about π/(π − ‖v‖) ≈ 20 at 0.95 of the radius
        assert np.max(np.abs(defect)) < 3e-13, law


@functools.cache
def group_laws(name):
    group = GROUPS[name]

    def laws(xi, eta, zeta):
        g, h, k = group.group_exp(xi), group.group_exp(eta), group.group_exp(zeta)
        multiply, inverse = group.multiply, group.inverse
        conjugated = multiply(multiply(g, group.group_exp(eta)), inverse(g))
        p = group.covector(g, zeta)
        laws = {
            "associativity": multiply(multiply(g, h), k) - multiply(g, multiply(h, k)),
            "inverse": multiply(g, inverse(g)) - group.identity(),
            "adjoint": conjugated - group.group_exp(group.adjoint(g) @ eta),
            "matrices multiply": group.matrix(multiply(g, h)) - group.matrix(g) @ group.matrix(h),
            "from matrix": group.representative(group.from_matrix(group.matrix(g)), g) - g,
            "left translation": group.left_translate(g, eta)
            - jax.jvp(lambda t: multiply(g, group.group_exp(t * eta)), (0.0,), (1.0,))[1],
            "body velocity": group.to_algebra(g, group.left_translate(g, eta)) - eta,
            "momentum": group.body_momentum(g, p) - zeta,
            "pairing": jnp.dot(p, group.left_translate(g, eta)) - jnp.dot(zeta, eta),
            "covector is tangent": group.tangent_defect(g, p),
        }
        return laws, group.matrix(g)

    return jax.jit(jax.vmap(laws))


def hat(group, xi):
    """The matrix of an algebra vector (translation, rotation)."""
    if isinstance(group, SO2 | SE2):
        spin, shift = np.array([[0.0, -xi[-1]], [xi[-1], 0.0]]), xi[:-1]
    else:
        spin, shift = np.cross(np.eye(3), np.asarray(xi[-3:])), xi[:-3]
    if isinstance(group, SO2 | SO3):
        return spin
    n = len(spin)
    return np.block([[spin, np.reshape(shift, (n, 1))], [np.zeros((1, n + 1))]])


@pytest.mark.parametrize("name", GROUPS)
@examples
@given(seed=seeds, exponent=st.floats(-9.0, 0.3))
@pytest.mark.soak_of(but=["SO2"])
def test_group_laws_and_matrix_exponential(name, seed, exponent):
    group = GROUPS[name]
    xi, eta, zeta = 10.0**exponent * random_arrays(seed, 3, BATCH, group.dimension)
    laws, matrices = group_laws(name)(xi, eta, zeta)
    for law, defect in laws.items():
        assert np.max(np.abs(defect)) < 2e-13, law
    for algebra_vector, matrix in zip(np.asarray(xi), matrices, strict=True):
        assert np.max(np.abs(matrix - scipy.linalg.expm(hat(group, algebra_vector)))) < 1e-13


@pytest.mark.parametrize("name", GROUPS)
@pytest.mark.soak_of(but=["SO2"])
def test_exponential_is_exact_to_second_order_at_the_identity(name):
    # matrix(exp ξ) = 1 + hat ξ + (hat ξ)²/2 + …: values and two derivatives at 0, where the formulas are 0/0.
    group = GROUPS[name]
    f = lambda xi: group.matrix(group.group_exp(xi))
    zero, xi = jnp.zeros(group.dimension), random_arrays(3, group.dimension)
    push = lambda x: jax.jvp(f, (x,), (xi,))[1]
    first, second = jax.jit(lambda x: jax.jvp(push, (x,), (xi,)))(zero)
    np.testing.assert_allclose(first, hat(group, xi), atol=1e-15)
    np.testing.assert_allclose(second, hat(group, xi) @ hat(group, xi), atol=1e-14)


@examples
@given(seed=seeds, speed=st.floats(1e-9, 3.0))
def test_great_circles_are_orbits_of_rotations(seed, speed):
    sphere = Sphere(4)
    a, b = random_arrays(seed, 2, 4)
    x = np.asarray(sphere.nearest(a))
    v = np.asarray(sphere.projection(x, b))
    v = v * (speed / np.linalg.norm(v))
    exact = scipy.linalg.expm(np.outer(v, x) - np.outer(x, v)) @ x
    np.testing.assert_allclose(sphere.exp(x, v), exact, atol=2e-15)
    assert float(sphere.distance(x, exact)) == pytest.approx(speed, rel=1e-6, abs=1e-15)


def test_distance_of_close_and_of_opposite_points_is_accurate():
    sphere, x = Sphere(3), jnp.array([0.0, 0.0, 1.0])
    for angle in [1e-12, 1e-7, 1.0, np.pi - 1e-7, np.pi - 1e-12]:
        y = jnp.array([np.sin(angle), 0.0, np.cos(angle)])
        assert float(sphere.distance(x, y)) == pytest.approx(angle, abs=1e-15)
        assert float(norm(sphere.log(x, y))) == pytest.approx(angle, abs=1e-15)


def test_torus_takes_the_short_way_round():
    torus = Torus(2)
    x, y = jnp.array([3.0, -20.0]), jnp.array([-3.0, 0.1])
    np.testing.assert_allclose(torus.log(x, y), [2 * np.pi - 6.0, 20.1 - 6 * np.pi], atol=1e-14)
    np.testing.assert_allclose(torus.representative(y, x), [2 * np.pi - 3.0, 0.1 - 6 * np.pi], atol=1e-14)
    assert float(torus.distance(x, x + 2 * np.pi)) < 1e-14


def test_quaternions_of_one_rotation_are_one_point():
    group = SO3()
    g, h = group.group_exp(jnp.array([0.3, -0.2, 0.5])), group.group_exp(jnp.array([0.1, 0.4, -0.2]))
    np.testing.assert_allclose(group.log(g, -h), group.log(g, h), atol=1e-15)
    np.testing.assert_allclose(group.representative(-h, g), h)
    assert float(group.distance(g, -g)) < 1e-15


# ---------------------------------------------------------------------- where the formulas divide by zero


ARGUMENTS = [0.0, 1e-300, 1e-16, 1e-9, 9.99e-4, 1e-3, 0.7, 3.999, 4.0, 4.001, 9.0]


@pytest.mark.parametrize("order", range(5))
def test_radial_functions_against_mpmath(order):
    # f_n(s) is a hypergeometric function 0F1(; n + ½; −s/4) over (2n − 1)!!
    value = jax.jit(lambda s: radial(order, s))
    for s in ARGUMENTS:
        with mpmath.workdps(40):
            exact = mpmath.hyp0f1(order + mpmath.mpf(1) / 2, -mpmath.mpf(s) / 4) / mpmath.fac2(2 * order - 1)
        assert abs(float(value(s)) - float(exact)) < 4e-16, s


def test_derivatives_of_radial_functions_against_mpmath():
    sinc = lambda s: mpmath.sin(mpmath.sqrt(s)) / mpmath.sqrt(s) if s else mpmath.mpf(1)
    third = jax.jit(jax.grad(jax.grad(jax.grad(lambda s: radial(1, s)))))
    reverse = jax.jit(jax.jacrev(jax.jacrev(lambda s: radial(0, s))))
    for s in [1e-12, 0.7, 4.0, 9.0]:
        with mpmath.workdps(60):
            exact = mpmath.diff(sinc, mpmath.mpf(s), 3), -mpmath.diff(sinc, mpmath.mpf(s)) / 2
        np.testing.assert_allclose([third(s), reverse(s)], np.array(exact, dtype=float), rtol=1e-13)
    np.testing.assert_allclose([third(0.0), reverse(0.0)], [-1 / 840, 1 / 12], rtol=1e-14)


@pytest.mark.parametrize("order", range(4))
def test_arc_over_sine_against_mpmath(order):
    value = jax.jit(lambda near, far: arc_over_sine(order, near, far))
    for near in [0.0, 1e-300, 1e-17, 1e-8, 9.9e-5, 1e-4, 0.049, 0.05, 0.051, 0.3, 0.5, 0.9, 0.999]:
        with mpmath.workdps(40):
            rising = mpmath.rf(1, order) ** 2 / mpmath.rf(mpmath.mpf(3) / 2, order)
            exact = rising * mpmath.hyp2f1(1 + order, 1 + order, mpmath.mpf(3) / 2 + order, near)
        # each step of the recurrence loses at most a factor 1/0.05
        assert float(value(near, 1.0 - near)) == pytest.approx(float(exact), rel=(2e-15, 3e-15, 1e-13, 3e-12)[order])


@pytest.mark.parametrize("function", [*(functools.partial(radial, n) for n in range(2)), lambda s: arc_over_sine(0, s, 1.0 - s)])
def test_squared_angles_of_roundoff_are_no_terms(function):
    """One that is known to no digit moves none of them: steps with such terms looked solved before they were."""
    assert float(rounding(function, jnp.asarray(1e-40), errors=(jnp.asarray(1e-33),))) < 8.0


@functools.cache
def derivatives(f):
    """Forward, reverse and second derivatives of f along random directions."""

    weighted = lambda *point: sum(jnp.sum(leaf) for leaf in jax.tree.leaves(f(*point)))

    def evaluate(*point):
        direction = tuple(random_arrays(5, *jnp.shape(x)) for x in point)
        push = lambda *point: jax.jvp(f, point, direction)
        pull = jax.grad(weighted, argnums=tuple(range(len(point))))
        return jax.jvp(push, point, direction), jax.jvp(pull, point, direction)

    return jax.jit(evaluate)


def all_finite(tree):
    return all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(tree))


@pytest.mark.parametrize("name", ["Torus", "Sphere(3)", "SE2", "SE3"])
@pytest.mark.soak_of(but=["Torus"])
def test_derivatives_are_finite_where_points_coincide(name):
    manifold = MANIFOLDS[name]
    x = manifold.nearest(random_arrays(1, manifold.ambient_dimension))
    assert all_finite(derivatives(manifold.log)(x, x))
    assert all_finite(derivatives(manifold.exp)(x, jnp.zeros_like(x)))
    assert all_finite(derivatives(manifold.inverse_retraction)(x, x))


@pytest.mark.parametrize("name", ["Torus", "Sphere(3)", "SE2", "SO3"])
@pytest.mark.soak_of("SE2", "SO3")
def test_derivatives_of_distances_are_finite_where_points_coincide(name):
    manifold = MANIFOLDS[name]
    x = manifold.nearest(random_arrays(1, manifold.ambient_dimension))
    assert all_finite(derivatives(manifold.distance)(x, x))


def log_and_distance(x, y):
    return Sphere(3).log(x, y), Sphere(3).distance(x, y)


@pytest.mark.parametrize("gap", [0.0, 1e-16, 1e-14, 1e-9, 1e-4])
@pytest.mark.soak_of("0.0")
def test_sphere_near_the_cut_locus(gap):
    sphere, x = Sphere(3), jnp.array([0.6, 0.0, 0.8])
    y = -(np.cos(gap) * x + np.sin(gap) * jnp.array([0.0, 1.0, 0.0]))
    v = sphere.log(x, y)
    np.testing.assert_allclose(sphere.exp(x, v), y, atol=5e-16)
    assert float(norm(v)) == pytest.approx(np.pi - gap, abs=1e-15)
    assert all_finite(derivatives(log_and_distance)(x, y))


@pytest.mark.parametrize("name", GROUPS)
@pytest.mark.parametrize("gap", [0.0, 1e-12, 1e-6])
@pytest.mark.soak_of("0.0-SE2", "0.0-SO3", "0.0-SE3")
def test_groups_near_half_a_turn(name, gap):
    group = GROUPS[name]
    xi = jnp.ones(group.dimension)
    rotation = xi[group.translations :]
    xi = jnp.concatenate([xi[: group.translations], rotation * (np.pi - gap) / norm(rotation)])
    g = group.group_exp(xi)
    back = group.group_log(g)
    np.testing.assert_allclose(group.matrix(group.group_exp(back)), group.matrix(g), atol=2e-15)
    if gap:
        np.testing.assert_allclose(back, xi, atol=3e-15)
    assert all_finite(derivatives(group.group_log)(g))


def test_derivative_of_the_sphere_logarithm_against_mpmath():
    # log_x along y(t) on a great circle through x at distance 1, in the direction across it: arc over sine.
    sphere, x = Sphere(3), jnp.array([0.0, 0.0, 1.0])
    for angle in [0.0, 1e-8, 1e-3, 1.0, 3.0, np.pi - 1e-6]:
        y = jnp.array([np.sin(angle), 0.0, np.cos(angle)])
        across = jax.jvp(lambda y: sphere.log(x, y), (y,), (jnp.array([0.0, 1.0, 0.0]),))[1]
        with mpmath.workdps(40):
            exact = float(angle / mpmath.sin(mpmath.mpf(angle))) if angle else 1.0
        np.testing.assert_allclose(across, [0.0, exact, 0.0], rtol=1e-9 if angle > 3.1 else 1e-14, atol=1e-15)


# ---------------------------------------------------------------------- Newton's method


@pytest.mark.soak
def test_regular_root_and_its_derivatives():
    # z² = c componentwise
    root = lambda c: regular_root(lambda z: z * z - c, jnp.ones_like(c))
    everything = lambda c: (root(c), jax.jacrev(root)(c), jax.jacfwd(root)(c), jax.jacfwd(jax.jacrev(root))(c), root(-c))
    c = jnp.array([2.0, 9.0, 1e-3])
    value, reverse, forward, second, missing = jax.jit(everything)(c)
    np.testing.assert_allclose(value, np.sqrt(c), rtol=3e-16)
    np.testing.assert_allclose(reverse, np.diag(0.5 / np.sqrt(c)), rtol=1e-14)
    np.testing.assert_allclose(forward, np.diag(0.5 / np.sqrt(c)), rtol=1e-14)
    np.testing.assert_allclose(jnp.einsum("iii->i", second), -0.25 * np.asarray(c) ** -1.5, rtol=1e-12)
    assert np.all(np.isnan(missing))


# ---------------------------------------------------------------------- bad input


def test_errors_say_what_is_wrong_and_by_how_much():
    sphere = Sphere(3)
    x = jnp.array([0.0, 0.0, 1.0])
    with pytest.raises(ValueError, match=r"m is not on Sphere.*defect is 0\.2"):
        sphere.check_point(1.2 * x, "m")
    with pytest.raises(ValueError, match=r"v is not tangent to Sphere.*norm 0\.5"):
        sphere.check_tangent(x, jnp.array([1.0, 0.0, 0.5]))
    with pytest.raises(ValueError, match=r"x must have shape \(3,\).*jax\.vmap"):
        sphere.check_point(jnp.zeros((2, 3)))
    with pytest.raises(ValueError, match="defect is nan"):
        sphere.check_point(jnp.full(3, jnp.nan))
    for space, n in ((Sphere, 1), (Sphere, 2.5), (Torus, [1.0, 2.0]), (Euclidean, -1), (Torus, True)):
        with pytest.raises(ValueError, match="needs a whole number n ≥"):
            space(n)
    with pytest.raises(TypeError, match="factors of Product"):
        Product(Sphere(3), 3)
    jax.jit(lambda x: sphere.check_point(x))(2.0 * x)  # traced values are not looked at
    assert bool(sphere.contains(x))
    assert not bool(sphere.contains(1.001 * x))
