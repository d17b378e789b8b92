"""Model: bodies, joints, contacts and forces as one mechanical system."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np

from dirax.bodies.assembly import Assembly, assembled, dependent
from dirax.bodies.checks import GROUND, check_axes, check_coordinates, check_masses, check_names, check_turns, sorted_tree
from dirax.bodies.contacts import Contact
from dirax.bodies.drawing import scene_of
from dirax.bodies.forces import Damper, Motor, Spring
from dirax.bodies.frames import GROUND as GROUND_FRAME
from dirax.bodies.frames import AnyFrame, Vector, scalar, vector
from dirax.bodies.joints import Joint
from dirax.bodies.model_constraints import MachineConstraints
from dirax.bodies.motion import Direct, Quaternion
from dirax.bodies.number_checks import check_kinds, check_numbers, check_untraced
from dirax.bodies.parts import Body
from dirax.bodies.statement import discretization_map, in_coordinates, on_manifold
from dirax.diagnostics.equations_of_motion import accelerations
from dirax.geometry.maps import ProductMap
from dirax.program.user_functions import evaluated
from dirax.show.scene import Scene
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.manifold_lagrangian import ManifoldLagrangian

Force: TypeAlias = Spring | Damper | Motor


@dataclass(frozen=True, eq=False)
class Model:
    """A machine.

    - `bodies`, `joints`: a tree that hangs on "ground", and joints that close loops (`closes=True`);
    - `contacts` with the ground; `forces`: `Spring`, `Damper` and `Motor`; `gravity` (3,);
    - `parameters`: numbers by name, which may stand for numbers in bodies, contacts and forces: the params of the model's own
      functions by default, and `model.params`, which a run is given as params=;
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
        check_kinds(self)
        check_untraced(self)
        check_names(self)
        check_numbers(self)
        check_masses(self)
        _ = self.tree
        check_coordinates(self)
        check_axes(self)
        check_turns(self)
        unknown = [name for name in self.dropped if name not in (*self.demands.all_holonomic, *self.demands.all_rows)]
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

    @property
    def quantities(self) -> tuple[str, ...]:
        """What each coordinate is: "length", "angle", or "" for a part of a quaternion."""
        moved = [motion for joint in self.joints if not joint.closes for motion in joint.motions]
        return tuple(motion.measures for motion in moved for _ in motion.names)

    @cached_property
    def places(self) -> dict[str, slice]:
        """Where the coordinates of each joint are."""
        ends = np.cumsum([0, *(len(joint.coordinates) for joint in self.joints)])
        return {joint.name: slice(int(a), int(b)) for joint, a, b in zip(self.joints, ends[:-1], ends[1:], strict=True)}

    @property
    def params(self) -> dict[str, float] | None:
        """The parameters as params of a run; None without any."""
        return dict(self.parameters) or None

    # ------------------------------------------------------------------ motion

    def frames(self, q: Any, v: Any, params: Any = None) -> dict[str, AnyFrame]:
        """The frame of every body, and of "ground", at coordinates q (n,) and velocities v (n,); of a body by its axis a ray."""
        params = self.params if params is None else params
        found: dict[str, AnyFrame] = {GROUND: GROUND_FRAME}
        for joint in self.tree:
            place = self.places[joint.name]
            found[joint.body] = joint.move(found[joint.parent], q[place], v[place], params)
        return found

    def named(self, values: Any) -> dict[str, Any]:
        """Values (n,) by the names of the coordinates."""
        return {name: values[k] for k, name in enumerate(self.coordinates)}

    @cached_property
    def unit_vectors(self) -> list[tuple[Joint, Quaternion | Direct, slice]]:
        """The joints with a quaternion or an axis, this motion, and where it is, in the order of the coordinates."""
        found = []
        for joint in self.tree:
            start = self.places[joint.name].start
            for motion in joint.motions:
                if isinstance(motion, Quaternion | Direct):
                    found.append((joint, motion, slice(start, start + len(motion.names))))
                start += len(motion.names)
        return sorted(found, key=lambda place: place[2].start)

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
        for joint, motion, place in self.unit_vectors:
            if isinstance(motion, Quaternion):
                total += 2 * self._gyration(joint) * ((q[place] @ v[place]) / (q[place] @ q[place])) ** 2
        return total

    def potential_energy(self, q: Any, params: Any = None) -> Any:
        """That of gravity and of springs."""
        params = self.params if params is None else params
        frames, gravity = self.frames(q, jnp.zeros_like(q), params), vector(self.gravity, params)
        total = jnp.zeros(())
        for body in self.bodies:
            if body.mass != 0:
                total -= scalar(body.mass, params) * (gravity @ frames[body.name].point(vector(body.centre, params)))
        for force in self.forces:
            if isinstance(force, Spring):
                total += force.energy(frames, self.named(q), params)
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

        if solution.batch is not None:
            raise ValueError("observables are those of one trajectory: give solution[i], one of the batch.")

        def at(q, p, params):
            v = self.system.inverse_legendre(q, p, params)
            known = self.energy(q, v, params), self.momentum(q, v, params), self.angular_momentum(q, v, params)
            return (*known, *(function(q, v) for function in more.values()))

        rows = [evaluated(at, q, p, solution.params) for q, p in zip(solution.q, solution.p, strict=True)]
        names = ("energy", "momentum", "angular_momentum", *more)
        return {name: np.array(values) for name, values in zip(names, zip(*rows, strict=True), strict=True)}

    # ------------------------------------------------------------------ the system

    @cached_property
    def demands(self) -> MachineConstraints:
        """Its constraints as functions, by name."""
        return MachineConstraints(self)

    @property
    def constraints(self) -> tuple[str, ...]:
        """The names of the constraints of `system`: one-forms, then holonomic ones, in the order of multipliers."""
        return self.demands.names

    @cached_property
    def system(self) -> LagrangeDirac:
        """The machine as a Lagrangian with constraints and forces, for every scheme that takes one."""
        return in_coordinates(self)

    @cached_property
    def manifold_system(self) -> ManifoldLagrangian:
        """The same machine in the same coordinates, with its quaternions as points of SO(3) and its axes as points of S², which a
        discretization map leaves there: no constraint |Q| = 1 or |u| = 1, and no multiplier for it.

            scheme = dx.DiscreteDirac(model.discretization_map, constraints="resolve")
            dx.simulate(model.manifold_system, scheme, **model.state(…), step=0.01, steps=1000)

        Raises `ValueError` for Coulomb friction, which needs the normal force.
        """
        return on_manifold(self)

    @cached_property
    def discretization_map(self) -> ProductMap:
        """The map for `manifold_system`: midpoints of lengths and angles, of rotations the middle of the one-parameter subgroup
        between them, of axes the middle of the arc."""
        return discretization_map(self)

    # ------------------------------------------------------------------ initial data

    @cached_property
    def assembly(self) -> Assembly:
        """What the search for initial data evaluates."""
        return Assembly(self.system.constraints, self.demands)

    def state(self, q: Any = None, v: Any = None, params: Any = None) -> dict[str, np.ndarray]:
        """Initial data {"q", "v"} of a run: the machine assembled.

        `q` and `v` are numbers by coordinate, which stay as they are while the others are found (from 0, quaternions from
        1 and axes from z, as near as can be); or arrays (n,), which are moved onto the constraints. Raises `ValueError` where the
        machine cannot be assembled, with the residual of every joint and contact that is not met.
        """
        return assembled(self, q, v, self.params if params is None else params)

    def accelerations(self, q: Any, v: Any, params: Any = None) -> dict[str, float]:
        """The acceleration of every coordinate at data on the constraints. Raises `ValueError` where the equations do not
        determine accelerations, as where a body has no mass."""
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
