"""Energy-preserving collocation: steps of high order that keep the energy of any system with a bracket."""

from collections.abc import Callable
from typing import Any

from dirax.numerics.arrays import is_whole
from dirax.program.user_functions import UserFunction
from dirax.schemes.collocation_tables import MOST_STAGES, gauss, quadrature
from dirax.schemes.framed_energy_collocation_step import FramedEnergyCollocation
from dirax.schemes.hamiltonian_energy_collocation_step import HamiltonianEnergyCollocation
from dirax.schemes.hidden_constraint_premise import nothing_hidden_in_relation
from dirax.schemes.lagrangian_energy_collocation_step import LagrangianEnergyCollocation
from dirax.schemes.step import AbstractScheme, Shape, StepEquation
from dirax.systems.forms import EnergyForm, RelationForm
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.system import AbstractSystem

POINTS = (8, 16)
"""Points of the quadrature, of up to four stages and of more: as many as are computed side by side."""


class EnergyCollocation(AbstractScheme):
    """Collocation with s stages that keeps the energy: for ẏ = Π(y) ∇H(y) with Π antisymmetric, y(τ) of degree s with

        ẏ(c_i) = Π(y(c_i)) (1/b_i) ∫_0^1 ℓ_i(τ) ∇H(y(τ)) dτ

    at Gauss nodes (Hairer 2010; Cohen, Hairer 2011): order 2s, self-adjoint, H(y_{k+1}) = H(y_k) as far as the quadrature of
    the integral is exact; Jacobi's identity is not needed. With one-forms and without `frame` it is self-adjoint up to
    O(h^(2s+2)) in a step, so that a `dx.Composition` has the order 2s + 1, and not the one of its name.

    - a regular `dx.LagrangeDirac` or `dx.NonholonomicMechanics`, with one-forms or without: the almost-Poisson bracket on D*
      (Celledoni, Farré Puiggalí, Høiseth, Martín de Diego, arXiv 1605.02845), from L and the one-forms alone. The
      constraint holds at every row to roundoff. Forces, affine constraints and explicit time enter with their `work`: the
      energy less the work is kept;
    - `dx.DiracSystem` of a bivector or of a two-form, `dx.LiePoisson`, `dx.EulerPoincare`, and `dx.PhaseSpaceLagrangian` on M_f;
    - `dx.PortHamiltonian` without closed ports: H(x_{k+1}) − H(x_k) is the energy supplied less the energy dissipated,
      which are saved as `work`.

    `frame(q[, params])` (n, n − m) may give a basis of the distribution of a Lagrangian with one-forms, as columns: then the
    polynomial is one of q and of the momenta π = frameᵀp, and the bracket that of the frame. Another frame gives other
    trajectories, of the same order and with the same energy. Without it p itself is taken and projected.

    `points` is the number of points of the quadrature, by default 8 and from five stages on 16. Saved is `energy_defect`, the
    largest change of the energy in a step so far that is not work, relative to the terms of the energy.

    Steps of many coordinates are sparse where the system's functions are, without one-forms: from 128 entries of x, or of (q, p).

    It is neither symplectic nor a (±)-discrete Dirac structure, and keeps no other invariant.
    Raises `ValueError` for stages that are not 1 to 16, fewer points than stages, and where a run begins at which the columns of
    the frame are no basis of the distribution, and `TypeError` for other systems.

        sol = dx.simulate(system, dx.EnergyCollocation(stages=3), q=…, v=…, step=0.05, steps=1000)
    """

    stages: int
    points: int
    frame: UserFunction | None

    def __init__(self, stages: int = 2, points: int | None = None, *, frame: Callable | None = None):
        if not is_whole(stages) or not 1 <= stages <= MOST_STAGES:
            raise ValueError(f"stages must be a whole number from 1 to {MOST_STAGES}, but {stages!r} was given.")
        points = POINTS[stages > 4] if points is None else points
        if not is_whole(points) or not stages <= points <= MOST_STAGES:
            raise ValueError(
                f"points must be a whole number from the number of stages, {stages}, to {MOST_STAGES}, but {points!r} was given."
            )
        if frame is not None and not callable(frame):
            raise TypeError(
                f"frame must be a function (q) -> (n, n − m) of a basis of the distribution, but {frame!r} was given."
            )
        self.stages, self.points = int(stages), int(points)
        self.frame = None if frame is None else UserFunction(frame, "frame", ("q",))

    @property
    def order(self) -> int:
        """The order of convergence on smooth systems: 2s."""
        return 2 * self.stages

    def adjoint(self, system: AbstractSystem) -> "EnergyCollocation":
        """The scheme itself, for nodes that lie symmetrically. Raises `TypeError` for one-forms without a frame, where a step
        begins at p = ∂L/∂v and ends at another p of a point of D*."""
        lagrangian = system.lagrangian_form() if self.frame is None else None
        if lagrangian is not None and lagrangian.one_forms is not None:
            raise TypeError(
                "with one-forms dx.EnergyCollocation is self-adjoint in a frame alone, and has no other adjoint: give it frame=."
            )
        return self

    def discrete_structure(self, system: Any, shape: Shape, step: Any) -> str:
        return "energy-preserving collocation is no discrete Dirac structure; its energy is measured instead"

    @property
    def keeps_no_form(self) -> str:
        return "energy-preserving collocation keeps the energy, and no two-form or bivector"

    def step_equation(self, system: AbstractSystem, shape: Shape) -> StepEquation:
        if shape.c:
            raise TypeError(
                f"dx.EnergyCollocation does not keep holonomic constraints, of which the system has {shape.c}: state them as "
                'one-forms, remove them by coordinates, or take dx.DiscreteDirac(constraints="resolve").'
            )
        tables = gauss(self.stages), quadrature(self.stages, self.points)
        if self.frame is not None:
            return FramedEnergyCollocation(*tables, self._in_a_frame(system), shape, self.frame).equation()
        energy = system.energy_form(shape)
        relation = system.relation_form(shape) or system.final_relation(shape)
        relation = _with_its_differential(energy) if relation is None and energy is not None else relation
        if relation is not None and energy is not None and not relation.multipliers:
            step = HamiltonianEnergyCollocation(*tables, relation, energy, shape.n)
            if step.sparse:  # of so many coordinates there is no matrix
                return step.equation()
            return nothing_hidden_in_relation(system, relation, step.equation(), "dx.EnergyCollocation")
        lagrangian = system.lagrangian_form()
        if lagrangian is not None:
            return LagrangianEnergyCollocation(*tables, lagrangian, shape).equation()
        raise TypeError(
            "dx.EnergyCollocation steps Lagrangians in coordinates, and Hamiltonians whose bracket determines ẋ, but a "
            f"{type(system).__name__} was given."
        )

    @staticmethod
    def _in_a_frame(system: AbstractSystem) -> LagrangeDirac:
        """The Lagrangian whose distribution a frame may span."""
        lagrangian = system.lagrangian_form()
        if lagrangian is None:
            what = f"a {type(system).__name__} was given"
        elif lagrangian.affine is not None:
            what = "the constraints are affine"
        elif lagrangian.depends_on_time:
            what = "the system takes the time"
        else:
            return lagrangian
        raise TypeError(
            f"dx.EnergyCollocation takes frame= for Lagrangians with linear one-forms that do not take the time, but {what}: "
            "leave it out."
        )


def _with_its_differential(energy: EnergyForm) -> RelationForm:
    """The relation of a system that has no other than that of its energy form."""
    at = lambda x, velocity, u, t, params: energy.residual(x, velocity, u, t, params, energy.differential(x, params))
    return RelationForm(at)
