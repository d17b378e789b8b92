"""A discretization map written outside the package: for a Dirac system, and for Lagrangian systems with Methods 1 and 2."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx


class Cayley(dx.AbstractDiscretizationMap):
    """On the unit sphere of R³, x0 and x1 the Cayley transforms of ∓ω/2 applied to x, ω = x × v: turned about the axis ω by
    ±2 arctan(|ω|/4), as in the midpoint rule of rotations. Inverse: x = (x0 + x1)/|x0 + x1|, v along x1 − x0."""

    def manifold(self, ambient_dimension):
        return dx.Sphere(ambient_dimension)

    def forward(self, x, v):
        s = v @ v / 16
        turned = lambda sign: ((1 - s) * x + sign * v / 2) / (1 + s)
        return turned(-1.0), turned(1.0)

    def backward(self, x0, x1):
        length = jnp.sqrt((x0 + x1) @ (x0 + x1))  # 2 (1 − s)/(1 + s), and |x1 − x0| = |v|/(1 + s)
        return (x0 + x1) / length, (x1 - x0) * 2 / (1 + length / 2)

    def reach(self, x, v):
        return jnp.sqrt(v @ v) / 4


def test_it_is_a_discretization_map():
    report = dx.check_discretization_map(Cayley(), np.array([0.6, 0.0, 0.8]), np.array([0.4, 0.7, -0.3]))
    assert max(report.point_defect, report.derivative_defect, report.inverse_defect) < 1e-14


class Stretched(dx.AbstractDiscretizationMap):
    """R_d(x, v) = (x − v/2, x + end v): a discretization map where end = ½."""

    end: float

    def manifold(self, ambient_dimension):
        return dx.Euclidean(ambient_dimension)

    def forward(self, x, v):
        return x - v / 2, x + self.end * v

    def backward(self, x0, x1):
        v = (x1 - x0) / (0.5 + self.end)
        return x0 + v / 2, v

    def reach(self, x, v):
        return jnp.zeros(())


OSCILLATORS = [
    (dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2), {"q": [1.0], "v": [0.5]}),
    (dx.DiracSystem(dx.induced_dirac(None, 1), lambda x: x @ x / 2), {"x": [1.0, 0.5]}),
]


@pytest.mark.parametrize(("system", "start"), OSCILLATORS)
def test_a_map_that_is_none_is_refused(system, start):
    run = lambda end: dx.simulate(system, dx.DiscreteDirac(Stretched(end)), **start, step=0.1, steps=9)
    midpoint = dx.simulate(system, dx.DiscreteDirac(), **start, step=0.1, steps=9)
    for name, values in run(0.5).fields.items():
        np.testing.assert_allclose(values, midpoint.fields[name], atol=1e-15)
    with pytest.raises(ValueError, match=r"Stretched is not a discretization map .*\(D2\).* fails by 0\.5"):
        run(1.0)
    assert "derivative_defect=0.5" in repr(dx.check_discretization_map(Stretched(1.0), np.ones(2), np.ones(2)))


class OneVector(Stretched):
    def backward(self, x0, x1):
        return x1 - x0


class Short(Stretched):
    def forward(self, x, v):
        return (x - v / 2)[:-1], x + v / 2


@pytest.mark.parametrize(("system", "start"), OSCILLATORS)
def test_a_map_of_other_shapes_is_refused(system, start):
    for scheme in (dx.DiscreteDirac(OneVector(0.5)), dx.DiscreteDirac(OneVector(0.5), constraints="resolve")):
        with pytest.raises(ValueError, match=r"OneVector\.backward\(x0, x1\) must return x and v, .*returned one of shape"):
            dx.simulate(system, scheme, **start, step=0.1, steps=9)
    with pytest.raises(
        ValueError, match=r"Short\.forward\(x, v\) must return two points, .*\(2,\), but it returned \[\(1,\), \(2,\)"
    ):
        dx.check_discretization_map(Short(0.5), np.ones(2), np.ones(2))


def rate_of(steps_and_errors):
    steps, errors = map(np.asarray, zip(*steps_and_errors, strict=True))
    return -np.diff(np.log(errors), axis=0).T / np.diff(np.log(steps))


def test_a_dirac_system_on_the_sphere():
    """Kirchhoff's vortex-like flow ẋ = x × ∇H on S²."""
    inertia = np.array([1.0, 2.0, 4.0])
    structure = dx.DiracStructure.from_bivector(lambda x: jnp.cross(x, jnp.eye(3), axisb=0, axisc=0))
    system = dx.DiracSystem(structure, lambda x: x @ (x / inertia) / 2)
    x = np.array([0.6, 0.0, 0.8])
    known = solve_ivp(lambda t, x: np.cross(x, x / inertia), (0, 2), x, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    errors = []
    for steps in (20, 40, 80):
        sol = dx.simulate(system, dx.DiscreteDirac(Cayley()), x=x, step=2 / steps, steps=steps)
        errors.append((steps, np.abs(sol.x[-1] - known).max()))
    assert rate_of(errors) == pytest.approx(2.0, abs=0.1)


AXIS = np.array([0.2, -0.4, 1.0])


def knife(q):
    """A one-form on the sphere that is not closed."""
    return jnp.cross(jnp.asarray(AXIS), q) + 0.5 * jnp.stack([q[1], q[2], q[0]])


def heavy(q, v):
    return v @ v / 2 - q[2]


def field(t, x, tied):
    """q̈ on the sphere in NumPy; λ from d/dt (w·v) = 0."""
    q, v = x[:3], x[3:]
    force = -np.array([0.0, 0.0, 1.0])
    force = force - q * (q @ force) - q * (v @ v)
    if tied:
        w = np.cross(AXIS, q) + 0.5 * np.array([q[1], q[2], q[0]])
        turning = np.cross(AXIS, v) + 0.5 * np.array([v[1], v[2], v[0]])
        across = w - q * (q @ w)
        force = force - across * (turning @ v + w @ force) / (across @ across)
    return np.concatenate([v, force])


@pytest.mark.parametrize("method", ["discretize", "resolve"])
@pytest.mark.parametrize("tied", [False, True])
def test_lagrangian_systems_on_the_sphere(tied, method):
    system = dx.ManifoldLagrangian(heavy, dx.Sphere(3), (lambda q: knife(q)[None]) if tied else None)
    q = np.array([0.6, 0.0, 0.8])
    v = -0.6 * np.cross(q, np.asarray(knife(jnp.asarray(q))))  # tangent, and in the kernel of the one-form
    known = solve_ivp(field, (0, 1), [*q, *v], args=(tied,), method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    errors = []
    for steps in (20, 40, 80):
        sol = dx.simulate(system, dx.DiscreteDirac(Cayley(), method), q=q, v=v, step=1 / steps, steps=steps)
        assert sol.ok and np.abs(np.linalg.norm(sol.q, axis=1) - 1).max() < 1e-14
        if method == "resolve":
            assert np.abs(sol.constraint_residual()).max() < 1e-13
        errors.append((steps, [np.abs(sol.q[-1] - known[:3]).max(), np.abs(sol.p[-1] - known[3:]).max()]))
    assert rate_of(errors) == pytest.approx(2.0, abs=0.15)


def test_the_step_on_the_sphere_is_symplectic():
    """dq ∧ dp on T*S² in a basis of its tangent space, by the derivative of one step."""
    system = dx.ManifoldLagrangian(heavy, dx.Sphere(3))
    q, p = np.array([0.6, 0.0, 0.8]), np.array([0.4, 0.7, -0.3])
    bundle = dx.CotangentBundle(dx.Sphere(3))

    def step(r, x):
        x = bundle.local_parametrization(x)(r)
        sol = dx.simulate(system, dx.DiscreteDirac(Cayley()), q=x[:3], p=x[3:], step=0.3, steps=1, check_initial=False)
        return jnp.concatenate([sol.q[-1], sol.p[-1]])

    x = jnp.asarray(np.concatenate([q, p]))
    before = np.asarray(bundle.frame(x))
    after = np.asarray(jax.jacfwd(step)(jnp.zeros(4), x))
    form = lambda a: a[:3].T @ a[3:] - a[3:].T @ a[:3]
    assert np.abs(form(after) - form(before)).max() < 1e-12
