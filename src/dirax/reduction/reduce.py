"""dx.reduce: from a system and its symmetry to the system on the quotient."""

from typing import Any, overload

from dirax.geometry.lie_group import AbstractLieGroup
from dirax.geometry.products import Product
from dirax.reduction.actions import Translations
from dirax.reduction.bundle import GroupConnection, TrivialBundle, translations_on
from dirax.reduction.connection import AbstractConnection
from dirax.reduction.euler_poincare import EulerPoincare
from dirax.reduction.left_invariant import reduced_by_left_translations
from dirax.reduction.reduced import AbstractReducedSystem, ReducedLagrangeDirac
from dirax.reduction.reduced_on_manifold import ReducedManifoldLagrangian
from dirax.reduction.stages import reduced_again
from dirax.systems.manifold_lagrangian import ManifoldLagrangian
from dirax.systems.system import AbstractSystem


@overload
def reduce(system: AbstractSystem, connection: AbstractConnection, params: Any = None) -> AbstractReducedSystem: ...
@overload
def reduce(system: AbstractSystem, connection: GroupConnection, params: Any = None) -> ReducedManifoldLagrangian: ...
@overload
def reduce(
    system: AbstractSystem, connection: AbstractLieGroup, params: Any = None
) -> EulerPoincare | ReducedManifoldLagrangian: ...
def reduce(system: Any, connection: Any, params: Any = None) -> AbstractReducedSystem | EulerPoincare:
    """The system on the quotient by a symmetry; run it with the same q=, v= as `system`, and undo it by `dx.reconstruct`.

    With a connection, the quotient of a `dx.LagrangeDirac` or `dx.NonholonomicMechanics` system, or of a
    `dx.ManifoldLagrangian`, by the translations of `connection.fibre` ([RL] §4, §6); that these leave it alone is checked at the
    start of a run. On a manifold the fibre names coordinates of its flat factors, R^n or a torus; connections are functions of
    points of R^N; where a translation is one of other coordinates, `dx.in_coordinates` makes it one.

        reduced = dx.reduce(system, dx.LinearConnection(fibre=[0]))
        sol = dx.reconstruct(dx.simulate(reduced, dx.PlusLagrangeDirac("midpoint"), q=q, v=v, step=0.01, steps=100))

    With a Lie group that is a factor of the manifold of a `dx.ManifoldLagrangian` on Σ × G, or a `dx.GroupConnection` for it, the
    quotient Σ × 𝔤 by translations from the left, in charts of Σ: the discrete Lagrange–Poincaré equations.

        body = dx.ManifoldLagrangian(L, dx.Product(dx.Sphere(3), dx.SO3()))
        sol = dx.simulate(dx.reduce(body, dx.SO3()), dx.LagrangeDAlembert(), q=q, v=v, step=0.01, steps=100)

    With a Lie group, the quotient TG/G ≅ 𝔤 of a left-invariant Lagrangian L(g, ġ) on that group: the `dx.EulerPoincare`
    system of l(ξ) = L(e, ξ), with left-invariant one-forms that of Euler, Poincaré and Suslov, A = W(e). `system` is a
    `dx.ManifoldLagrangian` on the group, or a `dx.LagrangeDirac` whose q are the coordinates of its elements. Invariance
    L(g, gξ) = L(e, ξ) is checked here, at random g and ξ; functions that take `params` are called with those given here.

        body = dx.reduce(dx.ManifoldLagrangian(lambda g, v: l(dx.SO3().to_algebra(g, v)), dx.SO3()), dx.SO3())
        sol = dx.reconstruct(dx.simulate(body, dx.DiscreteEulerPoincare(), q=g, v=v, step=0.01, steps=100))

    A system that `dx.reduce` made is reduced again, by stages: with a connection whose fibre counts the shape coordinates x of
    the first stage, it is the quotient by the product of both groups, in either order; with dx.SO2() or dx.SO3() after the
    translations of the coordinates of dx.SE2() or dx.SE3(), that by the semidirect product, where the system is left-invariant.

        twice = dx.reduce(dx.reduce(system, dx.LinearConnection(fibre=[3])), dx.LinearConnection(fibre=[0]))

    Raises `TypeError` for other systems and symmetries, and for missing params; `ValueError`, with the defect and where, for a
    Lagrangian or one-forms that the group does not leave alone, and for what has no reduced counterpart.
    """
    if isinstance(system, ReducedLagrangeDirac) and isinstance(connection, AbstractConnection | AbstractLieGroup):
        return reduced_again(system, connection, params)
    if isinstance(system, ReducedManifoldLagrangian):
        raise TypeError("this system on a manifold is reduced already: name the whole symmetry at once, in one dx.reduce.")
    on_manifold = system.manifold_form() if isinstance(system, AbstractSystem) else None
    curved = on_manifold is not None and on_manifold.flat_form() is None
    if isinstance(connection, AbstractLieGroup):
        if not (on_manifold is not None and curved and isinstance(on_manifold.manifold, Product)):
            return reduced_by_left_translations(system, connection, params)
        connection = GroupConnection(connection)
    if on_manifold is not None and (curved or isinstance(connection, GroupConnection)):
        return ReducedManifoldLagrangian(on_manifold, _bundle_of(on_manifold, connection))
    _refuse_other_symmetries(connection)
    lagrangian = system.lagrangian_form() if isinstance(system, AbstractSystem) else None
    lagrangian = on_manifold.flat_form() if on_manifold is not None else lagrangian
    if lagrangian is None:
        raise TypeError(f"dx.reduce takes a dx.LagrangeDirac system, but one of type {type(system).__name__} was given.")
    return ReducedLagrangeDirac(lagrangian, connection)


def _bundle_of(system: ManifoldLagrangian, connection: Any) -> TrivialBundle:
    """The manifold as a product of shapes and group, with a connection that is checked."""
    if isinstance(connection, GroupConnection):
        bundle = connection.on(system.manifold)
    else:
        _refuse_other_symmetries(connection)
        bundle = translations_on(system.manifold, connection)
    bundle.check()
    return bundle


def _refuse_other_symmetries(connection: Any) -> None:
    """Raise `TypeError` for what is no connection by translations."""
    if not isinstance(connection, AbstractConnection):
        way = f": dx.LinearConnection(fibre={list(connection.fibre)})." if isinstance(connection, Translations) else "."
        way = ": add parentheses." if isinstance(connection, type) else way
        if isinstance(connection, GroupConnection):
            raise TypeError("dx.GroupConnection is for a dx.ManifoldLagrangian on a product with that group.")
        raise TypeError(
            "the symmetry must be a connection such as dx.LinearConnection(fibre=[…]), or a Lie group such as dx.SO3(), but "
            f"{connection!r} was given{way}"
        )
