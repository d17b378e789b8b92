"""Discretization maps and their cotangent lifts: (D1), (D2), inverses and symplecticity on random points, closed forms."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

from dirax import Collocation, DiscreteGradient, ManifoldLagrangian, PortHamiltonian, simulate
from dirax.geometry.cotangent_lift import CotangentBundle, CotangentLift, cotangent_lift, symplecticity_defect
from dirax.geometry.lie_groups import SE2, SE3, SO2, SO3
from dirax.geometry.map_report import check_discretization_map
from dirax.geometry.maps import (
    AbstractDiscretizationMap,
    LieGroupExp,
    Midpoint,
    ProductMap,
    RiemannianExp,
    SphereProjection,
    Theta,
)
from dirax.geometry.products import Product
from dirax.geometry.projected_map import ProjectedMap, Submanifold
from dirax.geometry.spaces import Euclidean, Sphere, Torus


def normalize(x):
    return x / jnp.linalg.norm(x)


def to_parabola(x):
    """An oblique projector to the curved surface z = x² + y/2 of R³."""
    miss = x[2] - x[0] ** 2 - 0.5 * x[1]
    y = x[1] + 0.4 * miss
    return jnp.stack([x[0], y, x[0] ** 2 + 0.5 * y])


BATCH = 4
MAPS = {
    "explicit Euler": (Theta(0.0), 3),
    "theta": (Theta(0.3), 2),
    "implicit Euler": (Theta(1.0), 2),
    "midpoint": (Midpoint(), 3),
    "torus": (RiemannianExp(Torus(2), 0.3), 2),
    "sphere": (RiemannianExp(Sphere(3), 0.5), 3),
    "SO2": (LieGroupExp(SO2(), 0.2), 2),
    "SE2": (LieGroupExp(SE2(), 0.3), 4),
    "SO3": (LieGroupExp(SO3(), 0.5), 4),
    "SE3": (LieGroupExp(SE3(), 0.5), 7),
    "sphere projection": (SphereProjection(), 3),
    "product": (ProductMap((SphereProjection(), 3), (Theta(1.0), 2)), 5),
    "projected midpoint": (ProjectedMap(Midpoint(), normalize), 3),
    "projected theta": (ProjectedMap(Theta(0.3), to_parabola, dimension=2), 3),
}
examples = settings(max_examples=10, deadline=None)
seeds = st.integers(0, 2**32 - 1)


def random_arrays(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape)


def random_tangent(map, a, b, scale):
    """A point and a tangent vector of the map's manifold, at most 0.9 of the injectivity radius long."""
    manifold = map.manifold(a.shape[0])
    x = manifold.nearest(a)
    v = scale * manifold.projection(x, b)
    return x, v * jnp.minimum(1.0, 0.9 / jnp.maximum(map.reach(x, v), 1e-3))


def of_each(report):
    """What is reported of each of several pairs, in arrays."""
    stacked = lambda *each: jax.tree.map(lambda *leaves: np.stack(leaves), *each)
    return lambda first, second, scale: stacked(*(report(a, b, scale) for a, b in zip(first, second, strict=True)))


@functools.cache
def report_of(name):
    map, _ = MAPS[name]

    def report(a, b, scale):
        x, v = random_tangent(map, a, b, scale)
        x0, x1 = map(x, v)
        manifold = map.manifold(x.shape[0])
        return check_discretization_map(map, x, v), jnp.maximum(manifold.defect(x0), manifold.defect(x1))

    return of_each(jax.jit(report))


@pytest.mark.parametrize("name", MAPS)
@examples
@given(seed=seeds, scale=st.floats(1e-8, 0.8))
@pytest.mark.soak_of(but=["explicit Euler", "theta", "implicit Euler", "midpoint"])
def test_defining_properties(name, seed, scale):
    report, off = report_of(name)(*random_arrays(seed, 2, BATCH, MAPS[name][1]), scale)
    assert np.max(report.point_defect) < 1e-14  # (D1)
    assert np.max(report.derivative_defect) < 1e-13  # (D2)
    assert np.max(report.inverse_defect) < 1e-12
    assert np.all(report.condition_number < 1e3)
    assert np.max(off) < 1e-13


@functools.cache
def lift_report_of(name):
    lift = cotangent_lift(MAPS[name][0])

    def report(a, b, scale):
        x, v = random_tangent(lift, a, b, scale)
        manifold = lift.manifold(x.shape[0])
        w, h = manifold.projection(x, b), 1e-3
        # one trace of the map serves (D1), (D2) by differences of fourth order, and the end points
        velocities = jnp.stack([0.0 * w, -h * w, h * w, -2 * h * w, 2 * h * w, v])
        x0, x1 = jax.vmap(lambda v: lift.forward(x, v))(velocities)
        apart = x1 - x0
        slope = (8.0 * (apart[2] - apart[1]) - (apart[4] - apart[3])) / (12.0 * h)
        found, velocity = lift.backward(x0[-1], x1[-1])
        defects = {
            "point (D1)": jnp.stack([x0[0] - x, x1[0] - x]),
            "inverse": jnp.stack([found - x, velocity - v]),
            "ends in T*Q": jnp.stack([manifold.defect(x0[-1]), manifold.defect(x1[-1])]),
            "velocity in T(T*Q)": manifold.tangent_defect(found, velocity),
            "symplectic": symplecticity_defect(lift, x, v),
        }
        return defects, slope - w

    return of_each(jax.jit(report))


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(n, marks=pytest.mark.soak) if n in ("SE3", "projected theta") else n
        for n in sorted(set(MAPS) - {"projected midpoint", "SE2"})
    ],
)
@examples
@given(seed=seeds, scale=st.floats(1e-8, 0.8))
@pytest.mark.soak_of(but=["implicit Euler", "theta"])
def test_lifts_are_symplectic_discretization_maps(name, seed, scale):
    defects, slope_defect = lift_report_of(name)(*random_arrays(seed, 2, BATCH, 2 * MAPS[name][1]), scale)
    for law, defect in defects.items():
        assert np.max(np.abs(defect)) < 1e-12, law
    assert np.max(np.abs(slope_defect)) < 1e-8, "derivative (D2)"


@pytest.mark.parametrize("name", ["theta", "sphere projection"])
@pytest.mark.soak_of(but=["theta"])
def test_the_check_of_maps_takes_lifts(name):
    map, n = MAPS[name]
    lift = cotangent_lift(map)
    report = jax.jit(lambda x, v: check_discretization_map(lift, x, v))(*random_tangent(lift, *random_arrays(0, 2, 2 * n), 0.5))
    assert max(report.point_defect, report.derivative_defect, report.inverse_defect) < 1e-14
    assert report.condition_number < 1e2


def test_the_check_of_maps_finds_what_is_wrong():
    class Wrong(AbstractDiscretizationMap):
        """x0 off by 1e-3 at v = 0, and the difference of the velocities 1.1 v instead of v."""

        def manifold(self, ambient_dimension):
            return Euclidean(ambient_dimension)

        def forward(self, x, v):
            return x - 0.5 * v + 1e-3, x + 0.6 * v

        def backward(self, x0, x1):
            return (x0 + x1) / 2.0, x1 - x0

        def reach(self, x, v):
            return jnp.zeros(())

    report = jax.jit(lambda x, v: check_discretization_map(Wrong(), x, v))(*random_arrays(1, 2, 2))
    assert float(report.point_defect) == pytest.approx(1e-3)
    assert float(report.derivative_defect) == pytest.approx(0.1)
    assert float(report.inverse_defect) > 1e-3
    # `backward` is not the inverse, so the lift made of the two is not symplectic
    defect = jax.jit(lambda x, v: symplecticity_defect(CotangentLift(Wrong()), x, v))(*random_arrays(2, 2, 4))
    assert float(defect) > 1e-2


# ---------------------------------------------------------------------- closed forms


@pytest.mark.parametrize("theta", [0.0, 0.25, 0.5, 1.0])
def test_lift_of_theta_maps_is_the_partitioned_formula(theta):
    # (q − θq̇, p − (1−θ)ṗ; q + (1−θ)q̇, p + θṗ): the position and momentum weights are swapped.
    q, p, q_dot, p_dot = random_arrays(1, 4, 3)
    (q0p0, q1p1) = cotangent_lift(Theta(theta))(jnp.append(q, p), jnp.append(q_dot, p_dot))
    np.testing.assert_allclose(q0p0, jnp.append(q - theta * q_dot, p - (1 - theta) * p_dot), atol=1e-15)
    np.testing.assert_allclose(q1p1, jnp.append(q + (1 - theta) * q_dot, p + theta * p_dot), atol=1e-15)


def test_exponential_maps_of_flat_spaces_are_theta_maps():
    x, v = random_arrays(2, 2, 2)
    for flat in (RiemannianExp(Euclidean(2), 0.3), RiemannianExp(Torus(2), 0.3)):
        np.testing.assert_allclose(flat(x, v), Theta(0.3)(x, v), atol=1e-15)
        np.testing.assert_allclose(flat.inverse(*flat(x, v)), (x, v), atol=1e-15)


def test_sphere_projection_formulas():
    map = SphereProjection()
    x, v = random_tangent(map, *random_arrays(3, 2, 4), 1.0)
    x0, x1 = map(x, v)
    np.testing.assert_allclose(x0, (x - v / 2) / np.sqrt(1 + v @ v / 4), atol=1e-15)
    np.testing.assert_allclose(x1, (x + v / 2) / np.sqrt(1 + v @ v / 4), atol=1e-15)


def test_sphere_exponential_inverse_is_the_arccos_formula():
    # [BLM] Example 5.3: log_x(y) = arccos⟨x, y⟩ P_x(y − x)/‖P_x(y − x)‖, for θ = 0.
    map = RiemannianExp(Sphere(3), 0.0)
    x, y = (np.asarray(normalize(a)) for a in random_arrays(4, 2, 3))
    tangential = (y - x) - x * (x @ (y - x))
    start, v = map.inverse(x, y)
    np.testing.assert_allclose(start, x, atol=1e-15)
    np.testing.assert_allclose(v, np.arccos(x @ y) * tangential / np.linalg.norm(tangential), atol=1e-14)


@pytest.mark.parametrize("theta", [0.0, 0.5, 1.0])
@pytest.mark.soak_of("0.0")
def test_lie_group_map_against_matrix_exponentials(theta):
    group, omega = SO3(), np.array([0.4, -1.1, 0.8])
    g = group.group_exp(jnp.array([0.3, 0.2, -0.9]))
    g0, g1 = LieGroupExp(group, theta)(g, group.left_translate(g, omega))
    turn = lambda factor: np.asarray(group.matrix(g)) @ scipy.linalg.expm(factor * np.cross(np.eye(3), omega))
    np.testing.assert_allclose(group.matrix(g0), turn(-theta), atol=1e-14)
    np.testing.assert_allclose(group.matrix(g1), turn(1 - theta), atol=1e-14)


def test_projected_midpoint_on_the_sphere_is_the_sphere_projection():
    # Proposition 7.3 with P(x) = x/‖x‖ gives (2), and Newton's method finds its closed inverse.
    projected, closed = ProjectedMap(Midpoint(), normalize), SphereProjection()
    x, v = random_tangent(closed, *random_arrays(5, 2, 3), 1.0)
    np.testing.assert_allclose(projected(x, v), closed(x, v), atol=1e-15)
    np.testing.assert_allclose(jax.jit(projected.inverse)(*closed(x, v)), (x, v), atol=1e-14)
    assert projected.manifold(3).dimension == 2


def test_product_map_acts_on_each_block():
    product = ProductMap((SphereProjection(), 3), (Midpoint(), 2))
    x, v = random_tangent(product, *random_arrays(7, 2, 5), 1.0)
    x0, x1 = product(x, v)
    np.testing.assert_array_equal(jnp.split(x0, [3])[0], SphereProjection()(x[:3], v[:3])[0])
    np.testing.assert_array_equal(jnp.split(x1, [3])[1], Midpoint()(x[3:], v[3:])[1])


def test_lift_on_the_sphere_pairs_variations():
    # ⟨p1, δq1⟩ − ⟨p0, δq0⟩ = ⟨ṗ, δq⟩ + ⟨p, δq̇⟩ along a curve (q, q̇)(t) in TQ, by finite differences.
    map = SphereProjection()
    x, v = random_tangent(cotangent_lift(map), *random_arrays(8, 2, 6), 0.8)
    (q, p), (q_dot, p_dot) = jnp.split(x, 2), jnp.split(v, 2)
    p0, p1 = (np.split(np.asarray(end), 2)[1] for end in cotangent_lift(map)(x, v))
    a, b = random_arrays(9, 2, 3)

    def curve(t):
        point = normalize(q + t * a)
        return point, map.manifold(3).projection(point, q_dot + t * b)

    t = 1e-5
    difference = lambda f: [(np.asarray(f(t)[i]) - np.asarray(f(-t)[i])) / (2 * t) for i in range(2)]
    (dq, dq_dot), (dq0, dq1) = difference(curve), difference(lambda t: map.forward(*curve(t)))
    assert p1 @ dq1 - p0 @ dq0 == pytest.approx(float(p_dot @ dq + p @ dq_dot), abs=1e-8)


@pytest.mark.soak
def test_lifted_group_map_has_a_discrete_momentum_map():
    # R_d commutes with left translations, so where the spatial momentum R Π of (q, p) is at rest, it is equal at both ends.
    group = SO3()
    omega, momentum = np.array([0.5, -0.2, 0.9]), np.array([1.0, 2.0, -0.5])
    g = group.group_exp(jnp.array([0.2, 0.7, -0.4]))
    path = lambda t: group.multiply(g, group.group_exp(t * omega))
    body = lambda t: group.matrix(group.group_exp(-t * omega)) @ momentum
    p, p_dot = jax.jvp(lambda t: group.covector(path(t), body(t)), (0.0,), (1.0,))
    x, v = jnp.append(g, p), jnp.append(group.left_translate(g, omega), p_dot)

    def spatial_momentum(x):
        g, p = jnp.split(x, 2)
        return group.matrix(g) @ group.body_momentum(g, p)

    for theta in (0.0, 0.5):
        x0, x1 = jax.jit(cotangent_lift(LieGroupExp(group, theta)))(x, v)
        np.testing.assert_allclose(spatial_momentum(x0), spatial_momentum(x1), atol=1e-14)


@pytest.mark.soak
def test_lift_takes_either_quaternion_of_a_rotation():
    lift = cotangent_lift(LieGroupExp(SO3(), 0.5))
    x, v = random_tangent(lift, *random_arrays(10, 2, 8), 0.6)
    x0, x1 = jax.jit(lift.forward)(x, v)
    np.testing.assert_allclose(jax.jit(lift.backward)(x0, -x1), (x, v), atol=1e-13)  # (q, p) and (−q, −p) are one covector


def test_explicit_lift_can_be_lifted_again_on_a_vector_space():
    twice = cotangent_lift(cotangent_lift(Theta(0.25)))
    x, v = random_arrays(11, 2, 4)
    (q, p), (q_dot, p_dot) = jnp.split(x, 2), jnp.split(v, 2)
    weights = np.array([0.25, 0.75])
    np.testing.assert_allclose(twice(x, v)[0], jnp.append(q - weights * q_dot, p - (1 - weights) * p_dot), atol=1e-15)


# ---------------------------------------------------------------------- derivatives and bundles


@pytest.mark.parametrize("name", ["sphere", "SO3", "sphere projection", "projected midpoint"])
@pytest.mark.soak_of(but=["sphere projection"])
def test_second_derivatives_of_inverses_are_finite_at_coinciding_points(name):
    map, n = MAPS[name]
    x = map.manifold(n).nearest(random_arrays(12, n))
    direction = random_arrays(13, n)
    first = lambda y: jax.jvp(lambda y: map.inverse(x, y), (y,), (direction,))
    values = jax.jit(lambda y: (jax.jvp(first, (y,), (direction,)), jax.vjp(map.inverse, x, y)[1]((y, y))))(x)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(values))


def test_inverse_near_antipodes_is_finite():
    x = jnp.array([0.0, 0.6, 0.8])
    for gap in (0.0, 1e-12, 1e-6):
        y = -(np.cos(gap) * x + np.sin(gap) * jnp.array([1.0, 0.0, 0.0]))
        value = jax.jit(lambda y: jax.jvp(RiemannianExp(Sphere(3)).backward, (x, y), (y, x)))(y)
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(value))


@pytest.mark.parametrize("base", [Sphere(3), Product(SO3(), Torus(1)), Submanifold(to_parabola, 3)], ids=repr)
@pytest.mark.soak_of(but=["Sphere(dimension=2, ambient_dimension=3)"])
def test_cotangent_bundle(base):
    bundle = CotangentBundle(base)

    def laws(a, b, r):
        x = bundle.nearest(a)
        v = bundle.projection(x, b)
        point, zero = bundle.local_parametrization(x), jnp.zeros_like(r)
        return {
            "parametrization at 0": point(zero) - x,
            "nearest": bundle.defect(x),
            "parametrization on the bundle": bundle.defect(point(r)),
            "frame": jax.jacfwd(point)(zero) - bundle.frame(x),
            "projection idempotent": bundle.projection(x, v) - v,
            "vector from components": bundle.frame(x) @ bundle.coordinates(x, v) - v,
            "components": bundle.coordinates(x, bundle.frame(x) @ r) - r,
            "velocity of a curve on the bundle": jax.jvp(bundle.nearest, (x,), (v,))[1] - v,
        }

    a, b = random_arrays(14, 2, bundle.ambient_dimension)
    for law, defect in jax.jit(laws)(a, b, random_arrays(15, bundle.dimension)).items():
        assert np.max(np.abs(defect)) < 1e-13, law


def test_orthogonal_projection_to_the_image_of_an_oblique_projector():
    surface = Submanifold(to_parabola, 3)
    x = surface.nearest(random_arrays(16, 3))
    normal = np.array([-2.0 * x[0], -0.5, 1.0])
    v = random_arrays(17, 3)
    exact = v - normal * (normal @ v) / (normal @ normal)
    np.testing.assert_allclose(surface.projection(x, v), exact, atol=1e-14)
    assert surface.dimension == 2


def test_the_dimension_of_an_image_is_asked_where_a_run_begins():
    """It is the trace of DP; a wrong one was believed, and ran."""
    wrong = ManifoldLagrangian(lambda q, v: v @ v / 2, Submanifold(to_parabola, 3, dimension=1))
    x = np.array([0.5, 0.2, 0.25 + 0.1])
    with pytest.raises(ValueError, match="has dimension 2 at q, the trace of DP, but dimension=1 was given"):
        simulate(wrong, Collocation(2), q=Submanifold(to_parabola, 3).nearest(x), v=[0.0, 0.0, 0.0], step=0.1, steps=2)
    near_one = lambda x: x / jnp.sqrt(x[0] - 1.0)  # not defined at the place where its dimension is found
    with pytest.raises(ValueError, match="trace nan"):
        Submanifold(near_one, 2)


@pytest.mark.parametrize("x", [np.zeros(4), np.ones(4), np.array([1.0, -1.0, 0.5, 0.5])], ids=str)
@pytest.mark.soak_of("[0. 0. 0. 0.]")
def test_a_frame_does_not_turn_with_a_rounding(x):
    """The projections to tangent spaces have one singular value, of which singular vectors are any: a run chose others in each
    update of Newton's method and never ended."""
    surface = Submanifold(lambda x: jnp.array([x[0], x[1], x[2], x[0] * x[1]]), 4)
    point = surface.nearest(x)
    frame = np.asarray(surface.frame(point))
    np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(surface.projection(point, frame.T[0]), frame.T[0], atol=1e-15)
    moved = point * (1.0 + 1e-15 * random_arrays(18, 4)) + 1e-16
    np.testing.assert_allclose(surface.frame(surface.nearest(moved)), frame, atol=1e-14)


# ---------------------------------------------------------------------- bad input


def test_velocities_outside_the_injectivity_radius_are_refused():
    north, east = jnp.array([0.0, 0.0, 1.0]), jnp.array([1.0, 0.0, 0.0])
    with pytest.raises(ValueError, match=r"RiemannianExp .* norm 3\.3, which is 1\.05042 of the radius"):
        RiemannianExp(Sphere(3))(north, 3.3 * east)
    with pytest.raises(ValueError, match=r"norm 3\.14159.*too far apart"):
        RiemannianExp(Sphere(3), 0.0).inverse(north, -north)
    with pytest.raises(ValueError, match="too far apart"):
        SphereProjection().inverse(north, -north)
    with pytest.raises(ValueError, match=r"1\.27324 of the radius"):
        RiemannianExp(Torus(2))(jnp.zeros(2), jnp.array([0.0, 4.0]))
    group = SO3()
    with pytest.raises(ValueError, match=r"LieGroupExp .* 1\.01859 of the radius"):
        LieGroupExp(group)(group.identity(), group.left_translate(group.identity(), jnp.array([3.2, 0.0, 0.0])))
    with pytest.raises(ValueError, match=r"CotangentLift .* 1\.05042 of the radius"):
        lift = cotangent_lift(RiemannianExp(Sphere(3)))
        lift(jnp.append(north, jnp.zeros(3)), jnp.append(3.3 * east, jnp.zeros(3)))
    with pytest.raises(ValueError, match="norm nan"):
        ProjectedMap(Midpoint(), normalize).inverse(north, -north)


def test_points_and_vectors_off_the_manifold_are_refused():
    north, east = jnp.array([0.0, 0.0, 1.0]), jnp.array([1.0, 0.0, 0.0])
    with pytest.raises(ValueError, match=r"x is not on Sphere.*0\.5"):
        SphereProjection()(1.5 * north, east)
    with pytest.raises(ValueError, match=r"v is not tangent.*norm 0\.1"):
        SphereProjection()(north, east + 0.1 * north)
    with pytest.raises(ValueError, match=r"x1 is not on Sphere.*0\.25"):
        SphereProjection().inverse(north, 0.75 * east)
    with pytest.raises(ValueError, match="v is not tangent"):
        # on the sphere ⟨q, ṗ⟩ = −⟨q̇, p⟩
        cotangent_lift(SphereProjection())(jnp.append(north, east), jnp.append(0.1 * east, jnp.zeros(3)))
    with pytest.raises(ValueError, match="3 components, but points with 4"):
        RiemannianExp(Sphere(3))(jnp.zeros(4), jnp.zeros(4))
    with pytest.raises(ValueError, match="even length"):
        cotangent_lift(Midpoint())(jnp.zeros(3), jnp.zeros(3))


def test_maps_that_cannot_be():
    with pytest.raises(ValueError, match=r"theta must be in \[0, 1\], but 1\.5"):
        Theta(1.5)
    with pytest.raises(TypeError, match="LieGroupExp\\(SE3"):
        RiemannianExp(Product(Sphere(3), SE3()))
    with pytest.raises(TypeError, match="needs a group"):
        LieGroupExp(Sphere(3))
    with pytest.raises(TypeError, match="needs a discretization map"):
        cotangent_lift(Sphere(3))
    with pytest.raises(TypeError, match="on vector spaces can be lifted twice"):
        cotangent_lift(cotangent_lift(SphereProjection()))(jnp.zeros(12), jnp.zeros(12))
    with pytest.raises(ValueError, match=r"trace 1\.2 at .* whole number"):
        Submanifold(lambda x: 0.4 * x, 3)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ProductMap(SphereProjection(), Midpoint()), "pairs of a map and the number of coordinates"),
        (lambda: ProductMap((Midpoint(), -3)), "pairs of a map and the number"),
        (lambda: Theta("a"), "theta must be in"),
        (lambda: DiscreteGradient("mean-value", 2.5), "nodes must be a whole number"),
        (lambda: PortHamiltonian(lambda x: x @ x, J="a"), "J must be a matrix or a function"),
        (lambda: PortHamiltonian(lambda x: x @ x, np.zeros((2, 2)), B=np.eye(2), closed=(1.5,)), "numbers of the columns of B"),
        (lambda: PortHamiltonian(lambda x: x @ x, np.zeros((2, 2)), B=np.eye(2), closed="ab"), "numbers of the columns of B"),
    ],
)
def test_what_cannot_be_made_is_refused_in_words(make, words):
    with pytest.raises((TypeError, ValueError), match=words):
        make()
