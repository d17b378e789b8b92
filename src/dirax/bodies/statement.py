"""A machine stated as a mechanical system: in coordinates, with quaternions and axes of length 1, or on their manifold."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from dirax.bodies.forces import Spring
from dirax.bodies.machine_units import creep, has_creep
from dirax.geometry.maps import Midpoint, ProductMap
from dirax.program.tracing import gradient
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.manifold_lagrangian import ManifoldLagrangian


def in_coordinates(model: Any) -> LagrangeDirac:
    """A Lagrangian of all coordinates; |Q| = 1 and |u| = 1 are among the holonomic constraints."""
    holonomic, rows = model.demands.kept
    return LagrangeDirac(
        _stated(model, lambda q, v, params: model.kinetic_energy(q, v, params) - model.potential_energy(q, params), 2),
        **_constraints(model, holonomic, rows),
        forces=_forces(model),
    )


def on_manifold(model: Any) -> ManifoldLagrangian:
    """A Lagrangian on R^k × SO(3) × S² × …, without the constraints |Q| = 1 and |u| = 1."""
    if any(contact.rubs for contact in model.contacts):
        raise ValueError("Coulomb friction needs the normal force, which systems on a manifold do not see: take model.system.")
    return ManifoldLagrangian(
        _stated(model, lambda q, v, params: model.kinetic_energy(q, v, params) - model.potential_energy(q, params), 2),
        discretization_map(model).manifold(len(model.coordinates)),
        **_constraints(model, model.demands.off_manifold, model.demands.kept[1]),
        forces=_forces(model),
    )


def discretization_map(model: Any) -> ProductMap:
    """Midpoints of lengths and angles, and of rotations and axes what their motions say."""
    blocks, start = [], 0
    for _, motion, place in model.unit_vectors:
        blocks += [(Midpoint(), place.start - start)] if place.start > start else []
        blocks.append((motion.discretization_map(), place.stop - place.start))
        start = place.stop
    rest = len(model.coordinates) - start
    return ProductMap(*blocks, *([(Midpoint(), rest)] if rest else []))


def _constraints(model: Any, holonomic: list[int], rows: list[int]) -> dict[str, Callable | None]:
    one_forms = _stated(model, lambda q, params: model.demands.one_forms(q, params, rows), 1)
    positions = _stated(model, lambda q, params: model.demands.defects(q, params, holonomic), 1)
    return {"one_forms": one_forms if rows else None, "holonomic": positions if holonomic else None}


def _stated(model: Any, function: Callable, arguments: int) -> Callable:
    """A function of q, or of q and v, that takes params if the model has parameters, as systems ask for."""
    if model.parameters:
        return function
    return (lambda q: function(q, {})) if arguments == 1 else (lambda q, v: function(q, v, {}))


def _forces(model: Any) -> Callable | None:
    pushing = [force for force in model.forces if not isinstance(force, Spring)]
    resisting = [contact for contact in model.contacts if contact.resists]
    if not pushing and not resisting:
        return None
    places = {name: k for k, name in enumerate(model.constraints)}
    for contact in resisting:
        if contact.rubs and f"{contact.name}: touches" not in places:
            raise ValueError(
                f"contact {contact.name!r} has friction, but its joint keeps it on the ground, or the constraint is left out: "
                "there is no normal force to see. Let the body hang on the ground by free(), or give the contact a drag."
            )
        if contact.rubs and not has_creep(model, contact):
            raise ValueError(
                f"contact {contact.name!r} has friction, but the machine has no gravity or no length that says which speeds are "
                "small: give the contact creep=, the speed of slipping below which friction is proportional to it."
            )

    small_speeds = lambda params: [creep(model, contact, params) if contact.rubs else 0.0 for contact in resisting]

    def forces(t, q, v, multipliers, params):
        frames, named = model.frames(q, v, params), (model.named(q), model.named(v))
        pressures = [-multipliers[places[f"{contact.name}: touches"]] if contact.rubs else 0.0 for contact in resisting]
        felt = [
            contact.force(frames[contact.body], model.demands.normal(contact, q), jnp.maximum(pressure, 0.0), small, params)
            for contact, pressure, small in zip(resisting, pressures, small_speeds(params), strict=True)
        ]

        def power(w):
            moved, along = model.frames(q, w, params), model.named(w)
            total = sum((force.power(frames, moved, t, *named, along, params) for force in pushing), jnp.zeros(()))
            for contact, force in zip(resisting, felt, strict=True):
                total += force @ contact.slip(moved[contact.body], model.demands.normal(contact, q), params)
            return total

        return gradient(power)(v)

    if any(contact.rubs for contact in resisting):
        if model.parameters:
            return forces
        return lambda t, q, v, multipliers: forces(t, q, v, multipliers, {})
    if model.parameters:
        return lambda t, q, v, params: forces(t, q, v, None, params)
    return lambda t, q, v: forces(t, q, v, None, {})
