"""The constraints of a machine: which there are, by name, and which of them the system needs."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax.numpy as jnp
import numpy as np

from dirax.bodies.contacts import Contact
from dirax.bodies.frames import unit
from dirax.bodies.joints import norm_defect, stacked
from dirax.bodies.machine_units import coordinate_units
from dirax.bodies.motion import Glide
from dirax.program.rounding import rounding
from dirax.program.tracing import jacobian
from dirax.program.user_functions import evaluated

VANISHES = 1e-11
"""Size of a constraint, relative to its terms, at points chosen at random below which it is met by the joints alone."""


@dataclass(frozen=True, eq=False)
class MachineConstraints:
    """Norms of quaternions and axes, joints that close loops, contacts that touch: holonomic; rolling and skating: one-forms."""

    model: Any

    @cached_property
    def all_holonomic(self) -> tuple[str, ...]:
        """The names of all holonomic constraints that the model states."""
        joints = [f"{joint.name}: {condition}" for joint in self.model.joints for condition in joint.conditions]
        return (
            *(f"{joint.name}: {motion.norm}" for joint, motion, _ in self.model.unit_vectors),
            *joints,
            *(f"{contact.name}: touches" for contact in self.model.contacts),
        )

    @cached_property
    def all_rows(self) -> tuple[str, ...]:
        """The names of all one-forms that the model states."""
        return tuple(f"{contact.name}: {row}" for contact in self.model.contacts for row in contact.rows)

    def defects(self, q: Any, params: Any, kept: Sequence[int] | None = None) -> Any:
        """The holonomic constraints of these numbers, or all of them."""
        model = self.model
        frames = model.frames(q, jnp.zeros_like(q), params)
        found = [norm_defect(q[place]) for *_, place in model.unit_vectors]
        for joint in model.joints:
            if joint.closes:
                found += joint.defect(frames[joint.parent], frames[joint.body], params)
        for contact in model.contacts:
            found.append(jnp.zeros(()) if self.surface(contact) else contact.gap(frames[contact.body], params))
        return _picked(found, kept)

    @cached_property
    def may_turn_over(self) -> tuple[str, ...]:
        """The names of the joints that `turned_over` is of."""
        return tuple(joint.name for joint in self.model.joints if joint.may_turn_over)

    def turned_over(self, q: Any, params: Any) -> Any:
        """Of these joints, how far their bodies are turned, as of `Joint.turned_over`."""
        frames = self.model.frames(q, jnp.zeros_like(q), params)
        closing = [joint for joint in self.model.joints if joint.may_turn_over]
        return stacked([joint.turned_over(frames[joint.parent], frames[joint.body]) for joint in closing])

    def one_forms(self, q: Any, params: Any, kept: Sequence[int] | None = None) -> Any:
        """The one-forms of these numbers, or all of them: derivatives of what is zero where a body rolls or skates."""

        def rates(v):
            frames, found = self.model.frames(q, v, params), []
            for contact in self.model.contacts:
                found += contact.rates(frames[contact.body], self.normal(contact, q), params)
            return _picked(found, kept)

        return jacobian(rates)(jnp.zeros_like(q))

    def surface(self, contact: Contact) -> tuple[Glide, slice] | None:
        """The surface over which the contact's body moves by its joint, and where its coordinates are."""
        joint = next(joint for joint in self.model.tree if joint.body == contact.body)
        start = self.model.places[joint.name].start
        first = joint.motions[0] if joint.motions else None
        return (first, slice(start, start + 2)) if isinstance(first, Glide) else None

    def normal(self, contact: Contact, q: Any) -> Any:
        """The normal of the ground where the contact is (3,)."""
        surface = self.surface(contact)
        return unit(contact.normal) if surface is None else surface[0].normal(q[surface[1]])

    @cached_property
    def kept(self) -> tuple[list[int], list[int]]:
        """Which holonomic constraints and one-forms are those of the system: not dropped, and not met by the tree alone."""
        model, rng = self.model, np.random.default_rng(0)
        units = coordinate_units(model, model.params)
        points = [rng.uniform(-0.9, 0.9, len(model.coordinates)) * units for _ in range(3)]
        row_sizes = lambda q, p: jnp.abs(self.one_forms(q, p)) @ units
        values = [lambda q, p, f=f: (f(q, p), rounding(lambda q: f(q, p), q)) for f in (self.defects, row_sizes)]
        sizes = np.zeros(len(self.all_holonomic)), np.zeros(len(self.all_rows))
        for q in points:
            for size, value in zip(sizes, values, strict=True):
                if size.size:
                    found, terms = (np.abs(np.asarray(a)) for a in evaluated(value, q, model.params))
                    found = np.divide(found, terms, out=np.zeros(len(terms)), where=terms > 0.0)
                    size[:] = np.maximum(size, np.where(np.isfinite(found), found, 1.0))
        holonomic, rows = (
            [k for k, name in enumerate(names) if size[k] > VANISHES and name not in model.dropped]
            for names, size in zip((self.all_holonomic, self.all_rows), sizes, strict=True)
        )
        return holonomic, rows

    @cached_property
    def off_manifold(self) -> list[int]:
        """Of the kept holonomic constraints those that the manifold of the rotations does not meet."""
        return [k for k in self.kept[0] if k >= len(self.model.unit_vectors)]

    @property
    def names(self) -> tuple[str, ...]:
        """The names of those that are kept: one-forms, then holonomic ones, in the order of multipliers."""
        holonomic, rows = self.kept
        return (*(self.all_rows[k] for k in rows), *(self.all_holonomic[k] for k in holonomic))


def _picked(values: list[Any], kept: Sequence[int] | None) -> Any:
    chosen = values if kept is None else [values[k] for k in kept]
    return stacked(chosen) if chosen else jnp.zeros((0,))
