"""Model: bodies, joints, contacts and forces as one mechanical system."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np

from dirax.bodies.assembly import Assembly, assembled, dependent
from dirax.bodies.checks import GROUND, check_coordinates, check_masses, check_names, sorted_tree
from dirax.bodies.contacts import Contact
from dirax.bodies.drawing import scene_of
from dirax.bodies.forces import Damper, Motor, Spring
from dirax.bodies.frames import GROUND as GROUND_FRAME
from dirax.bodies.frames import Frame, Vector, unit, vector
from dirax.bodies.joints import Joint, norm_defect, stacked
from dirax.bodies.motion import Glide, Quaternion
from dirax.bodies.parts import Body
from dirax.diagnostics.linearized_field import accelerations
from dirax.program.tracing import gradient, jacobian
from dirax.program.user_functions import evaluated
from dirax.show.scene import Scene
from dirax.systems.lagrange_dirac import LagrangeDirac

Force: TypeAlias = Spring | Damper | Motor

VANISHES = 1e-11
"""Size of a constraint at points chosen at random below which it is met by the joints alone."""


@dataclass(frozen=True, eq=False)
class Model:
    """A machine.

    - `bodies`, `joints`: a tree that hangs on "ground", and joints that close loops (`closes=True`);
    - `contacts` with the ground; `forces`: `Spring`, `Damper` and `Motor`; `gravity` (3,);
    - `parameters`: numbers by name, which may stand for numbers in bodies, contacts and forces; they are the default params;
    - `dropped`: names of constraints to be left out, which follow from the others (`redundant` finds them).

    `system` is the `dx.LagrangeDirac`, `coordinates` its coordinates' names, `constraints` those of its constraints.
    Raises `ValueError` for mistakes: names twice, a body with two parents or none, inertia without mass.
    """

    bodies: Sequence[Body]
    joints: Sequence[Joint]
    contacts: Sequence[Contact] = ()
    forces: Sequence[Force] = ()
    gravity: Vector = (0.0, 0.0, -9.81)
    parameters: Mapping[str, float] = field(default_factory=dict)
    dropped: Sequence[str] = ()

    def __post_init__(self):
        check_names(self)
        check_masses(self)
        _ = self.tree
        check_coordinates(self)
        unknown = [name for name in self.dropped if name not in (*self._all_holonomic, *self._all_rows)]
        if unknown:
            raise ValueError(f"no constraint is called {unknown[0]!r}: there are {', '.join(self.constraints)}.")

    # ------------------------------------------------------------------ names

    @cached_property
    def tree(self) -> tuple[Joint, ...]:
        """The joints with coordinates, parents first."""
        return sorted_tree(self.bodies, self.joints)

    @cached_property
    def coordinates(self) -> tuple[str, ...]:
        """The names of the coordinates, in the order of the joints."""
        return tuple(name for joint in self.joints for name in joint.coordinates)

    @cached_property
    def _places(self) -> dict[str, slice]:
        """Where the coordinates of each joint are."""
        ends = np.cumsum([0, *(len(joint.coordinates) for joint in self.joints)])
        return {joint.name: slice(int(a), int(b)) for joint, a, b in zip(self.joints, ends[:-1], ends[1:], strict=True)}

    @property
    def params(self) -> dict[str, float] | None:
        """The parameters as params of a run; None without any."""
        return dict(self.parameters) or None

    # ------------------------------------------------------------------ motion

    def frames(self, q: Any, v: Any, params: Any = None) -> dict[str, Frame]:
        """The frame of every body, and of "ground", at coordinates q (n,) and velocities v (n,)."""
        params = self.params if params is None else params
        found = {GROUND: GROUND_FRAME}
        for joint in self.tree:
            place = self._places[joint.name]
            found[joint.body] = joint.move(found[joint.parent], q[place], v[place], params)
        return found

    def _named(self, values: Any) -> dict[str, Any]:
        return {name: values[k] for k, name in enumerate(self.coordinates)}

    @property
    def _quaternions(self) -> list[tuple[Joint, slice]]:
        found = []
        for joint in self.tree:
            start = self._places[joint.name].start
            for motion in joint.motions:
                if isinstance(motion, Quaternion):
                    found.append((joint, slice(start, start + 4)))
                start += len(motion.names)
        return found

    def _gyration(self, joint: Joint) -> float:
        """A moment of inertia for the rate of |Q|, which is zero: any positive number makes the Lagrangian regular."""
        body = next(body for body in self.bodies if body.name == joint.body)
        numbers = np.ravel(np.asarray(body.inertia, dtype=object))
        if any(isinstance(x, str) for x in numbers):
            return 1.0
        return float(np.trace(np.asarray(body.inertia_matrix(None)))) / 3 or 1.0

    def kinetic_energy(self, q: Any, v: Any, params: Any = None) -> Any:
        """T, with a term in the rate of the lengths of quaternions, which is zero on the constraints."""
        params = self.params if params is None else params
        frames = self.frames(q, v, params)
        total = sum(body.kinetic_energy(frames[body.name], params) for body in self.bodies)
        for joint, place in self._quaternions:
            total += 2 * self._gyration(joint) * ((q[place] @ v[place]) / (q[place] @ q[place])) ** 2
        return total

    def potential_energy(self, q: Any, params: Any = None) -> Any:
        """That of gravity and of springs."""
        params = self.params if params is None else params
        frames, gravity = self.frames(q, jnp.zeros_like(q), params), vector(self.gravity, params)
        total = jnp.zeros(())
        for body in self.bodies:
            if body.mass != 0:
                mass = params[body.mass] if isinstance(body.mass, str) else body.mass
                total -= mass * (gravity @ frames[body.name].point(vector(body.centre, params)))
        for force in self.forces:
            if isinstance(force, Spring):
                total += force.energy(frames, self._named(q), params)
        return total

    def energy(self, q: Any, v: Any, params: Any = None) -> Any:
        """T + V."""
        return self.kinetic_energy(q, v, params) + self.potential_energy(q, params)

    def momentum(self, q: Any, v: Any, params: Any = None) -> Any:
        """The momentum of all bodies (3,)."""
        params = self.params if params is None else params
        frames = self.frames(q, v, params)
        return sum(body.momentum(frames[body.name], params) for body in self.bodies)

    def angular_momentum(self, q: Any, v: Any, params: Any = None, about: Any = (0.0, 0.0, 0.0)) -> Any:
        """The angular momentum of all bodies about a point of the ground (3,)."""
        params = self.params if params is None else params
        frames, about = self.frames(q, v, params), jnp.asarray(about, float)
        return sum(body.angular_momentum(frames[body.name], about, params) for body in self.bodies)

    def observables(self, solution: Any, **more: Callable) -> dict[str, np.ndarray]:
        """Of one trajectory, from its q and p: "energy" (rows,), "momentum" and "angular_momentum" (rows, 3), and `more`
        functions (q, v) by name."""

        def at(q, p, params):
            v = self.system.inverse_legendre(q, p, params)
            known = self.energy(q, v, params), self.momentum(q, v, params), self.angular_momentum(q, v, params)
            return (*known, *(function(q, v) for function in more.values()))

        rows = [evaluated(at, q, p, solution.params) for q, p in zip(solution.q, solution.p, strict=True)]
        names = ("energy", "momentum", "angular_momentum", *more)
        return {name: np.array(values) for name, values in zip(names, zip(*rows, strict=True), strict=True)}

    # ------------------------------------------------------------------ constraints

    @cached_property
    def _all_holonomic(self) -> tuple[str, ...]:
        joints = [f"{joint.name}: {condition}" for joint in self.joints for condition in joint.conditions]
        return (
            *(f"{joint.name}: |Q| = 1" for joint, _ in self._quaternions),
            *joints,
            *(f"{contact.name}: touches" for contact in self.contacts),
        )

    @cached_property
    def _all_rows(self) -> tuple[str, ...]:
        return tuple(f"{contact.name}: {row}" for contact in self.contacts for row in contact.rows)

    def _all_defects(self, q: Any, params: Any) -> Any:
        frames = self.frames(q, jnp.zeros_like(q), params)
        found = [norm_defect(q[place]) for _, place in self._quaternions]
        for joint in self.joints:
            if joint.closes:
                found += joint.defect(frames[joint.parent], frames[joint.body], params)
        for contact in self.contacts:
            found.append(jnp.zeros(()) if self._glide(contact) else contact.gap(frames[contact.body], params))
        return stacked(found) if found else jnp.zeros((0,))

    def _all_rates(self, q: Any, v: Any, params: Any) -> Any:
        frames = self.frames(q, v, params)
        found = []
        for contact in self.contacts:
            found += contact.rates(frames[contact.body], self._normal(contact, q), params)
        return stacked(found) if found else jnp.zeros((0,))

    def _all_one_forms(self, q: Any, params: Any) -> Any:
        return jacobian(lambda v: self._all_rates(q, v, params))(jnp.zeros_like(q))

    def _glide(self, contact: Contact) -> tuple[Glide, slice] | None:
        """The surface over which the contact's body glides, and where its coordinates are."""
        joint = next(joint for joint in self.tree if joint.body == contact.body)
        start = self._places[joint.name].start
        first = joint.motions[0] if joint.motions else None
        return (first, slice(start, start + 2)) if isinstance(first, Glide) else None

    def _normal(self, contact: Contact, q: Any) -> Any:
        glide = self._glide(contact)
        return unit(contact.normal) if glide is None else glide[0].normal(q[glide[1]])

    @cached_property
    def _kept(self) -> tuple[list[int], list[int]]:
        """Which holonomic constraints and one-forms are those of the system: not dropped, and not met by the tree alone."""
        params, rng = self.params, np.random.default_rng(0)
        points = [rng.uniform(-0.9, 0.9, len(self.coordinates)) for _ in range(3)]
        sizes = np.zeros(len(self._all_holonomic)), np.zeros(len(self._all_rows))
        for q in points:
            values = [self._all_defects, lambda q, p: jnp.sum(jnp.abs(self._all_one_forms(q, p)), axis=1)]
            for size, value in zip(sizes, values, strict=True):
                if size.size:
                    found = np.abs(np.asarray(evaluated(value, q, params)))
                    size[:] = np.maximum(size, np.where(np.isfinite(found), found, 1.0))
        names = self._all_holonomic, self._all_rows
        holonomic, rows = (
            [k for k, name in enumerate(of) if size[k] > VANISHES and name not in self.dropped]
            for of, size in zip(names, sizes, strict=True)
        )
        return holonomic, rows

    @property
    def constraints(self) -> tuple[str, ...]:
        """The names of the constraints: one-forms, then holonomic ones, in the order of multipliers."""
        holonomic, rows = self._kept
        return (*(self._all_rows[k] for k in rows), *(self._all_holonomic[k] for k in holonomic))

    # ------------------------------------------------------------------ the system

    @cached_property
    def system(self) -> LagrangeDirac:
        """The machine as a Lagrangian with constraints and forces, for every scheme that takes one."""
        holonomic, rows = (np.array(kept, dtype=int) for kept in self._kept)
        lagrangian = lambda q, v, params: self.kinetic_energy(q, v, params) - self.potential_energy(q, params)
        one_forms = lambda q, params: self._all_one_forms(q, params)[rows]
        positions = lambda q, params: self._all_defects(q, params)[holonomic]
        return LagrangeDirac(
            self._stated(lagrangian, "q, v"),
            self._stated(one_forms, "q") if rows.size else None,
            holonomic=self._stated(positions, "q") if holonomic.size else None,
            forces=self._force_function(rows.size),
        )

    def _stated(self, function: Callable, arguments: str) -> Callable:
        """A function that takes params if the model has parameters, as `LagrangeDirac` asks for."""
        if self.parameters:
            return function
        if arguments == "q":
            return lambda q: function(q, {})
        return lambda q, v: function(q, v, {})

    def _force_function(self, rows: int) -> Callable | None:
        pushing = [force for force in self.forces if not isinstance(force, Spring)]
        resisting = [contact for contact in self.contacts if contact.resists]
        if not pushing and not resisting:
            return None
        places = {name: k for k, name in enumerate(self.constraints)}

        def forces(t, q, v, multipliers, params):
            frames, named = self.frames(q, v, params), (self._named(q), self._named(v))
            pressures = [-multipliers[places[f"{contact.name}: touches"]] if contact.rubs else 0.0 for contact in resisting]
            felt = [
                contact.force(frames[contact.body], self._normal(contact, q), jnp.maximum(pressure, 0.0), params)
                for contact, pressure in zip(resisting, pressures, strict=True)
            ]

            def power(w):
                moved, along = self.frames(q, w, params), self._named(w)
                total = sum((force.power(frames, moved, t, *named, along, params) for force in pushing), jnp.zeros(()))
                for contact, force in zip(resisting, felt, strict=True):
                    total += force @ contact.slip(moved[contact.body], self._normal(contact, q), params)
                return total

            return gradient(power)(v)

        if any(contact.rubs for contact in resisting):
            if self.parameters:
                return forces
            return lambda t, q, v, multipliers: forces(t, q, v, multipliers, {})
        if self.parameters:
            return lambda t, q, v, params: forces(t, q, v, None, params)
        return lambda t, q, v: forces(t, q, v, None, {})

    # ------------------------------------------------------------------ initial data

    @cached_property
    def assembly(self) -> Assembly:
        """What the search for initial data evaluates."""
        return Assembly(self.system.constraints)

    def state(self, q: Any = None, v: Any = None, params: Any = None) -> dict[str, np.ndarray]:
        """Initial data {"q", "v"} of a run: the machine assembled.

        `q` and `v` are numbers by coordinate, which stay as they are while the others are found (from 0, and quaternions from
        1, as near as can be); or arrays (n,), which are moved onto the constraints. Raises `ValueError` where the machine cannot
        be assembled, with the residual of every joint and contact that is not met.
        """
        return assembled(self, q, v, self.params if params is None else params)

    def accelerations(self, q: Any, v: Any, params: Any = None) -> dict[str, float]:
        """The acceleration of every coordinate at data on the constraints."""
        found, _ = accelerations(self.system, q, v, self.params if params is None else params)
        return dict(zip(self.coordinates, found.tolist(), strict=True))

    def redundant(self, q: Any, params: Any = None) -> tuple[str, ...]:
        """The names of constraints that follow from those before them at q (n,): a run leaves their forces out."""
        return dependent(self, np.asarray(q, float), self.params if params is None else params)

    def without(self, *names: str) -> "Model":
        """The same machine without these constraints."""
        return replace(self, dropped=(*self.dropped, *names))

    def scene(self, **drawn: Any) -> Scene:
        """What a report draws: bodies as rods between their joints, wheels, balls, springs, and the ground."""
        return scene_of(self, **drawn)
