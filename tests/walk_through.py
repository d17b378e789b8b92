"""A walk through the package with the shapes in its signatures checked at every call: run as a program by `test_shapes.py`.

python tests/walk_through.py dirax.geometry dirax.systems
"""

import sys
from functools import partial
from types import FunctionType
from typing import Any, get_args

import jaxtyping

with_shapes = jaxtyping.jaxtyped


def names_a_shape(annotation: Any) -> bool:
    """Also in parts of the type, and in what is not known yet."""
    if isinstance(annotation, type) and issubclass(annotation, jaxtyping.AbstractArray):
        return True
    return isinstance(annotation, str) or any(map(names_a_shape, get_args(annotation)))


def checked(*, typechecker):
    """The decorator of jaxtyping, but where a signature has no shapes that of beartype alone, which is quicker."""
    with_their_shapes = with_shapes(typechecker=typechecker)
    plain = lambda f: isinstance(f, FunctionType) and not any(map(names_a_shape, f.__annotations__.values()))
    return lambda function: typechecker(function) if plain(function) else with_their_shapes(function)


if __name__ == "__main__":  # an int is a float, as type checkers have it
    jaxtyping.jaxtyped = checked
    tower = "beartype.beartype(conf=__import__('beartype').BeartypeConf(is_pep484_tower=True))"
    jaxtyping.install_import_hook(sys.argv[1:], tower)

import jax
import jax.numpy as jnp
import numpy as np

import dirax as dx
from dirax.geometry.group_retractions import coadjoint
from dirax.geometry.subspaces import PontryaginSubspace

TURN = np.array([[0.0, 1.0], [-1.0, 0.0]])


def linear_structures() -> None:
    """By every constructor, alone and in a batch, by numbers and under tracing."""
    basis = np.array([[1.0], [0.0]])
    made = [
        dx.LinearDirac.from_two_form(TURN),
        dx.LinearDirac.from_bivector(TURN),
        dx.LinearDirac.from_subspace(basis),
        dx.LinearDirac.from_subspace_and_form(basis, TURN),
        dx.LinearDirac.from_codistribution_and_bivector(basis, TURN),
        dx.LinearDirac.from_kernel(np.eye(2), TURN),
        dx.LinearDirac.from_image(np.eye(2), TURN),
    ]
    v, batch = np.array([1.0, 2.0]), np.stack([TURN, 2.0 * TURN])
    for structure in (*made, dx.LinearDirac.from_two_form(batch)):
        assert np.all(structure.is_dirac()) and np.all(structure.is_isotropic()) and np.all(structure.is_coisotropic())
        structure.contains(v, v)
        structure.equals(structure)
        structure.distribution(), structure.codistribution()
        structure.pull_back(np.eye(2)), structure.push_forward(np.eye(2))
        str(structure), repr(structure)
    assert made[0].contains(v, -TURN @ v) and np.allclose(made[0].two_form(), TURN) and np.allclose(made[1].bivector(), TURN)
    jax.jit(lambda form: dx.LinearDirac.from_two_form(form).contains(v, v))(jnp.asarray(TURN))
    jax.vmap(lambda form: dx.LinearDirac.from_two_form(form).is_dirac())(jnp.asarray(batch))
    subspace = PontryaginSubspace.from_image(np.eye(2), TURN)
    assert subspace.is_dirac() and subspace.contains(v, TURN @ v) in (True, False)


def methods(space, x, v, y):
    return (
        (space.nearest(x), space.projection(x, v), space.representative(x, y), space.frame(x), space.coordinates(x, v)),
        space.local_parametrization(x)(jnp.zeros(space.dimension)),
        (space.geodesic(x, v, jnp.asarray(0.5)), space.distance(x, y), space.transport(x, v, y), space.tangent_defect(x, v)),
        (space.inverse_retraction(x, space.retraction(x, v)), space.exp_reach(x, v), space.retraction_reach(x, v)),
    )


def manifolds_and_maps() -> None:
    """Every method of every manifold and map at one point under jit, and some in numbers."""
    turned = jnp.array([1.0, 2.0, 2.0, 4.0]) / 5.0
    places = {
        dx.Euclidean(2): (jnp.array([1.0, 2.0]), jnp.array([0.1, 0.2])),
        dx.Torus(2): (jnp.array([1.0, 2.0]), jnp.array([0.1, 0.2])),
        dx.Sphere(3): (jnp.array([0.0, 0.6, 0.8]), jnp.array([0.3, 0.0, 0.0])),
        dx.SO3(): (turned, None),
        dx.SE2(): (jnp.array([0.6, 0.8, 1.0, 2.0]), None),
        dx.SE3(): (jnp.concatenate([turned, jnp.arange(3.0)]), None),
        dx.Product(dx.Sphere(3), dx.Torus(1)): (jnp.array([0.0, 0.6, 0.8, 1.0]), jnp.array([0.3, 0.0, 0.0, 0.1])),
    }
    for space, (x, v) in places.items():
        if v is None:
            moved = lambda x, xi, space=space: (space.left_translate(x, 0.1 * xi), coadjoint(space, x, xi))
            v, _ = jax.jit(moved)(x, np.ones(space.dimension))
        y, back = jax.jit(lambda x, v, space=space: (y := space.exp(x, v), space.log(x, y)))(x, v)
        assert np.allclose(back, v) and float(space.defect(y)) < 1e-12 and space.contains(y)
        space.check_point(y), space.check_tangent(x, v)
        jax.eval_shape(partial(methods, space), x, v, y)  # shapes alone are looked at: nothing is compiled
    sphere = places[dx.Sphere(3)]
    along = {
        dx.Theta(0.25): places[dx.Euclidean(2)],
        dx.SphereProjection(): sphere,
        dx.RiemannianExp(dx.Sphere(3)): sphere,
        dx.LieGroupExp(dx.SO2()): (jnp.array([0.6, 0.8]), jnp.array([-0.08, 0.06])),
        dx.ProductMap((dx.Theta(0.5), 2), (dx.Theta(0.5), 1)): (jnp.arange(3.0), jnp.ones(3)),
    }
    for step, (x, v) in along.items():
        there = jax.jit(lambda x, v, step=step: (step.inverse(*step(x, v)), step.forward(x, v), step.reach(x, v)))(x, v)
        assert np.allclose(np.stack(there[0]), np.stack([x, v]))
        step.manifold(x.size), step.base_fraction
    lift = dx.cotangent_lift(dx.SphereProjection())
    x, v = jnp.concatenate(sphere), jnp.concatenate([jnp.array([0.0, 0.08, -0.06]), jnp.zeros(3)])
    jax.jit(lambda x, v: (lift.forward(x, v), lift.manifold(6).frame(x), lift.manifold(6).nearest(x)))(x, v)


def structures_and_systems() -> None:
    """Systems of every kind through a few steps and the constraint algorithm."""
    rng = jnp.array([0.6, -0.8])
    circle = lambda q: jnp.stack([q @ q - 1.0])
    pendulum = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[1], holonomic=circle)
    start = {"q": rng, "v": jnp.array([0.4, 0.3])}
    assert dx.simulate(pendulum, dx.PlusLagrangeDirac(), **start, step=0.01, steps=3).ok
    assert dx.constraint_algorithm(pendulum, near=start).index == 2
    body = dx.DiracSystem(
        dx.DiracStructure.from_bivector(lambda x: jnp.cross(x, jnp.eye(3), axisb=0, axisc=0)),
        lambda x: x @ (x / jnp.array([1.0, 2.0, 3.0])) / 2,
    )
    x = jnp.array([1.0, 0.2, 0.3])
    assert dx.simulate(body, dx.DiscreteDirac(), x=x, step=0.01, steps=3).ok
    body.structure.at(x), body.structure.integrability_defect(x)
    sleigh = dx.NonholonomicMechanics(
        lambda q: jnp.eye(3), lambda q: 0.0, lambda q: jnp.stack([jnp.sin(q[2]), -jnp.cos(q[2]), 0.0])[None]
    )
    assert dx.simulate(sleigh, dx.LagrangeDAlembert(), q=jnp.zeros(3), v=jnp.array([1.0, 0.0, 1.0]), step=0.01, steps=3).ok
    damped = dx.PortHamiltonian(lambda x: x @ x / 2, TURN, R=np.diag([0.0, 0.1]))
    assert dx.simulate(damped, dx.DiscreteGradient(), x=rng, step=0.01, steps=3).ok
    vortex = dx.PhaseSpaceLagrangian(lambda q: jnp.array([-q[1], q[0]]) / 2, lambda q: q @ q / 2)
    assert dx.simulate(vortex, dx.DiscreteDirac(), q=rng, step=0.01, steps=3).ok


def runs_and_what_reads_them() -> None:
    """Every kind of scheme, verified, reduced, batched, stored and loaded."""
    ball = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2, lambda q: jnp.array([[-q[1], 0.0, 1.0]]))
    start = {"q": jnp.array([0.3, 0.2, 0.1]), "v": jnp.array([0.5, 0.1, 0.1])}
    for scheme in (dx.PlusLagrangeDirac(), dx.MinusLagrangeDirac(), dx.DiscreteDirac(constraints="discretize")):
        sol = dx.simulate(ball, scheme, **start, step=0.01, steps=4)
        assert sol.ok and dx.verify(sol).ok and np.all(np.isfinite(sol.energy())), scheme
    free = dx.LagrangeDirac(lambda q, v: v @ v / 2 - jnp.cos(q[0]))
    several = {"q": np.array([[0.1, 0.0], [0.2, 0.3]]), "v": np.ones((2, 2))}
    for scheme in (dx.Collocation(2), dx.Composition(dx.PlusLagrangeDirac(), "suzuki4"), dx.EnergyCollocation(1)):
        sol = dx.simulate(free, scheme, **several, step=0.1, steps=3)
        assert np.all(sol.ok) and sol[0].q.shape == (4, 2) and sol[:2].batch == 2, scheme
    fibre = dx.reduce(free, dx.LinearConnection(fibre=[1]))
    reduced = dx.simulate(fibre, dx.PlusLagrangeDirac(), q=several["q"][0], v=several["v"][0], step=0.1, steps=3)
    assert reduced.ok and dx.reconstruct(reduced).q.shape == (4, 2)


if __name__ == "__main__":
    for walk in (linear_structures, manifolds_and_maps, structures_and_systems, runs_and_what_reads_them):
        walk()
