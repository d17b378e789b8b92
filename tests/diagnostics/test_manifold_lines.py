"""What `dx.verify` says of points of manifolds and elements of groups, of runs and of reconstructed motions."""

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax.diagnostics.constraint_lines import constraint
from dirax.diagnostics.manifold_lines import points
from dirax.diagnostics.replay_lines import replayed
from dirax.diagnostics.structure_lines import structure_of

SO3 = dx.SO3()
INERTIA = jnp.array([1.0, 2.0, 3.0])
ELEMENT = np.array([0.5, 0.5, 0.5, 0.5])
TITLE = "points on their manifolds"


def damaged(sol, name, row, by=1.0 + 1e-6):
    """The solution with one row of a field multiplied."""
    changed = np.array(sol.fields[name])
    changed[..., row, :] *= by
    return sol.replace(fields={**sol.fields, name: changed})


def verdict(sol):
    """Of the line of the points, None where there is none."""
    line = points(sol, None)
    return line and line.verdict


@pytest.mark.parametrize("rows", [None, np.array([[1.0, 0.3, 0.0]])], ids=["free", "Suslov"])
@pytest.mark.soak_of("Suslov")
def test_every_element_of_the_group_is_asked_for_the_first_one_too(rows):
    top = dx.EulerPoincare(SO3, lambda xi: xi @ (INERTIA * xi) / 2, rows)
    sol = dx.simulate(top, dx.DiscreteEulerPoincare(), x=top.state(np.array([-0.3, 1.0, 0.5])), step=0.05, steps=12)
    again = dx.reconstruct(sol, g0=ELEMENT)
    for whole, name in ((sol, "g"), (again, "q")):
        assert verdict(whole) == "ok"
        for row in (0, 1, 12):
            assert verdict(damaged(whole, name, row)) == "VIOLATED"


def bead(q, v):
    return v[:3] @ v[:3] / 2 + (1 + q[0] ** 2) * v[3] ** 2 / 2 - q[2]


@pytest.mark.parametrize(
    "scheme", [dx.LagrangeDAlembert(), dx.DiscreteDirac(dx.ProductMap((dx.SphereProjection(), 3), (dx.Midpoint(), 1)))]
)
@pytest.mark.soak_of("scheme0")
def test_points_of_a_sphere_in_batches_and_from_files(scheme, tmp_path):
    system = dx.ManifoldLagrangian(bead, dx.Product(dx.Sphere(3), dx.Euclidean(1)))
    q = np.array([[0.6, 0.0, 0.8, 0.3], [0.0, 1.0, 0.0, 0.0]])
    sol = dx.simulate(system, scheme, q=q, v=[[0.4, 0.0, -0.3, 0.2]] * 2, step=0.05, steps=6)
    sol.save(tmp_path / "run.nc")
    for whole in (sol, dx.load(tmp_path / "run.nc", system=system, scheme=scheme)):
        assert verdict(whole) == "ok"
        assert verdict(damaged(whole, "q", 0)) == "VIOLATED"


def test_initial_data_off_by_what_they_are_allowed_are_no_violation():
    system = dx.ManifoldLagrangian(bead, dx.Product(dx.Sphere(3), dx.Euclidean(1)))
    q = np.array([0.6, 0.0, 0.8, 0.3]) * [1 + 2e-9, 1, 1 + 2e-9, 1]
    sol = dx.simulate(system, dx.LagrangeDAlembert(), q=q, v=[0.8, 0.1, -0.6, 0.2], step=0.05, steps=6)
    assert verdict(sol) == "ok"
    assert verdict(damaged(sol, "q", 3)) == "VIOLATED"


def test_flat_spaces_say_nothing():
    system = dx.ManifoldLagrangian(lambda q, v: v @ v / 2 - q @ q / 2, dx.Euclidean(2))
    sol = dx.simulate(system, dx.LagrangeDAlembert(), q=[1.0, 0], v=[0.0, 1], step=0.05, steps=3)
    assert verdict(sol) is None


def on_bundle(q, v):
    x, spin = q[:3], SO3.to_algebra(q[3:], v[3:])
    return v[:3] @ v[:3] / 2 + spin @ (INERTIA * spin) / 2 + 0.3 * spin @ jnp.cross(x, v[:3]) - x[2] / 2


def test_reconstructed_motions_on_a_bundle_in_charts_are_right(tmp_path):
    """The unreduced run keeps a centre for several rows, where every row of the reconstruction has one of its own."""
    scheme, system = dx.PlusLagrangeDirac(), dx.ManifoldLagrangian(on_bundle, dx.Product(dx.Sphere(3), SO3))
    curved = dx.GroupConnection(SO3, lambda a, b: SO3.group_exp(0.3 * jnp.cross(a, b)))
    q = np.concatenate([[0.6, 0.0, 0.8], ELEMENT])
    v = np.concatenate([[0.4, 0.5, -0.3], SO3.left_translate(jnp.asarray(ELEMENT), jnp.array([0.3, -0.4, 0.6]))])
    reduced = dx.simulate(dx.reduce(system, curved), scheme, q=q, v=v, step=0.05, steps=8)
    whole, again = dx.simulate(system, scheme, q=q, v=v, step=0.05, steps=8), dx.reconstruct(reduced)
    assert np.abs(whole.chart - again.chart).max() > 0.01
    again.save(tmp_path / "again.nc")
    for sol in (reduced, dx.load(tmp_path / "again.nc", system=system)):
        report = dx.verify(sol)
        assert report.ok and report[TITLE].verdict == "ok", str(report)
    assert np.abs(whole.q - again.q).max() < 1e-12 and np.abs(whole.p - again.p).max() < 1e-12
    for name in ("q", "p", "chart"):
        assert replayed(damaged(again, name, 4), None).verdict == "VIOLATED", name
    assert replayed(damaged(whole, "chart", 4), None).verdict == "VIOLATED"


@pytest.mark.parametrize("scheme", [dx.LagrangeDAlembert(), dx.Composition(dx.LagrangeDAlembert(), "suzuki4")])
@pytest.mark.soak_of("scheme1")
def test_a_constraint_is_off_by_the_roundings_of_the_points_that_are_subtracted(scheme):
    """ε|q|/h, which is more the shorter a step, and its parts."""
    system = dx.ManifoldLagrangian(lambda q, v: v @ v / 2 - q @ q / 2, dx.Euclidean(3), lambda q: jnp.array([[-0.3, q[0], 1.0]]))
    sol = dx.simulate(system, scheme, q=[0.3, -0.2, 0.1], v=[0.2, 0.1, 0.03], step=0.002, steps=100)
    line = lambda sol: constraint(sol, structure_of(sol), None)
    assert line(sol).verdict == "ok"
    changed = np.array(sol.fields["constraint"])
    changed[50] += 1e-9
    assert line(sol.replace(fields=sol.fields | {"constraint": changed})).verdict == "VIOLATED"
