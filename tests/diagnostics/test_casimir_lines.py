"""Casimirs against the Lie–Poisson bivector, and the lines of verify on them and on the spatial momentum."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax import gallery
from dirax.diagnostics.casimir_lines import casimir_lines
from dirax.geometry.semidirect import SemidirectProduct
from dirax.reduction.casimirs import casimirs

SPACES = [
    (dx.SO2(), 0, ["|μ|²"]),
    (dx.SO2(), 2, ["|a|²"]),
    (dx.SE2(), 0, ["|P|²"]),
    (dx.SE2(), 2, ["|P|²", "P·a", "|a|²"]),
    (dx.SO3(), 0, ["|μ|²"]),
    (dx.SO3(), 3, ["|a|²", "μ·a"]),
    (dx.SO3(), 6, ["|a1|²", "a1·a2", "|a2|²"]),
    (dx.SE3(), 0, ["|P|²", "Π·P"]),
    (dx.SE3(), 3, ["|P|²", "P·a", "|a|²"]),
]


@pytest.mark.parametrize(("group", "advected", "names"), SPACES)
@pytest.mark.soak_of(but=["group0-0-names0"])
def test_casimirs_are_all_null_directions_of_the_bivector(group, advected, names):
    space = SemidirectProduct(group, advected)
    found = casimirs(space)
    assert [c.name for c in found] == names
    x = jnp.asarray(np.random.default_rng(3).normal(size=space.size))
    values = lambda x: jnp.stack([x[c.first] @ x[c.second] for c in found])
    slopes, bivector = (np.asarray(a) for a in jax.jit(lambda x: (jax.jacfwd(values)(x), space.bivector(x)))(x))
    assert np.abs(bivector @ slopes.T).max() < 1e-13
    assert np.linalg.matrix_rank(slopes) == len(found) == space.size - np.linalg.matrix_rank(bivector, tol=1e-10)


def conserved(sol):
    return {line.quantity: line for line in casimir_lines(sol, None)}


@pytest.mark.parametrize(("name", "count"), [("free-top", 3), ("heavy-top-so3", 1), ("underwater-vehicle", 4)])
@pytest.mark.soak_of(but=["underwater-vehicle-4"])
def test_gallery_conserves_them(name, count):
    sol = gallery.get(name).simulate(steps=300)
    lines = conserved(sol)
    titles = [f"Casimir {c.name}" for c in casimirs(sol.system.space)]
    assert list(lines) == [*titles, "spatial momentum"]
    assert all(line.verdict == "ok" and line.value is not None and line.value < 1e-13 for line in lines.values())
    if count < sol.system.space.dimension:
        assert f"along the {count} directions that leave g·a alone" in lines["spatial momentum"].explanation
    lifted = conserved(dx.reconstruct(sol))
    assert list(lifted) == list(lines) and all(line.verdict == "ok" for line in lifted.values())


@pytest.mark.soak
def test_damage_is_seen_in_the_worst_trajectory_of_a_batch():
    body = dx.EulerPoincare(dx.SO3(), lambda xi: xi @ (jnp.array([1.0, 2.0, 3.0]) * xi) / 2)
    start = body.state([[0.3, 1.0, 0.4], [1.0, 0.2, 0.1]])
    sol = dx.simulate(body, dx.DiscreteEulerPoincare(), x=start, step=0.1, steps=40, engine="native")
    assert conserved(sol)["Casimir |μ|²"].verdict == "ok"
    sol.fields["x"][1, 30:] *= 1 + 1e-9
    report = dx.verify(sol)
    casimir, spatial = report["Casimir |μ|²"], report["spatial momentum"]
    assert casimir.verdict == spatial.verdict == "VIOLATED" and not report.ok
    assert casimir.value == pytest.approx(2e-9, rel=1e-3) and "(trajectory 1)" in casimir.explanation
    assert casimir.details["per_trajectory"][0] < 1e-14


def test_constraints_leave_the_carried_ones():
    suslov = conserved(gallery.get("suslov").simulate(steps=50))
    assert list(suslov) == ["spatial momentum"] and suslov["spatial momentum"].verdict == "not checked"
    veselova = dx.EulerPoincare(dx.SO3(), lambda xi, a: xi @ (jnp.array([1.0, 1.5, 2.0]) * xi) / 2, lambda a: a[None], 3)
    x = veselova.state([0.5, 0.3, 0.0], [0.0, 0.0, 1.0])  # the angular velocity stays horizontal
    sol = dx.simulate(veselova, dx.DiscreteEulerPoincare(), x=x, step=0.05, steps=50, engine="native")
    lines = conserved(sol)
    assert list(lines) == ["Casimir |a|²", "spatial momentum"] and lines["Casimir |a|²"].verdict == "ok"


def test_a_representation_of_ones_own():
    """A body in a field with a quadrupole, a symmetric matrix that turns with it: no Casimirs are known, and spatial momentum
    is conserved along the directions that leave the matrix alone."""
    moved = lambda matrix, a: (matrix @ a.reshape(3, 3) @ matrix.T).reshape(-1)
    body = dx.LiePoisson(dx.SO3(), lambda mu, a: mu @ mu / 2 + a[0] ** 2 / 4 + a[4], 9, moved)
    axial = np.diag([1.0, 1.0, 3.0]).ravel()
    x = np.concatenate([[0.3, 0.2, 0.9], axial])
    lines = conserved(dx.simulate(body, dx.DiscreteEulerPoincare(), x=x, step=0.05, steps=40, engine="native"))
    assert list(lines) == ["spatial momentum"] and lines["spatial momentum"].verdict == "ok"
    assert "along the 1 directions" in lines["spatial momentum"].explanation
    none = np.concatenate([[0.3, 0.2, 0.9], np.diag([1.0, 2.0, 3.0]).ravel()])
    sol = dx.simulate(body, dx.DiscreteEulerPoincare(), x=none, step=0.05, steps=5, engine="native")
    assert conserved(sol)["spatial momentum"].verdict == "not checked"
