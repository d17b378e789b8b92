"""The discrete Dirac structures of discrete Lagrangians on Q × Q: (+), (−) ([PY] §5, §6) and Lagrange–d'Alembert."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.geometry.finite_difference import InducedFiniteDifferenceDirac, annihilator_projector, sizes_of_rows
from dirax.geometry.tulczyjew import FiniteDifferenceTriple, slot_derivatives
from dirax.numerics.arrays import Data
from dirax.numerics.tolerances import ONE_FORM_RANK
from dirax.program.linear_solves import pseudo_inverse
from dirax.program.tracing import jacobian, once
from dirax.program.user_functions import UserFunction
from dirax.schemes.discrete_lagrangian import discrete_constraint, discrete_forces, discrete_lagrangian
from dirax.schemes.discrete_structure import AbstractDiscreteStructure, Claim
from dirax.schemes.two_form_on_pairs import FormOnPairs
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.shape import Shape

Vector = Float[Array, " n"]
Scalar = Float[Array, ""]

MANY = 128
"""Coordinates above which sizes are those of terms alone where there are no constraints."""

SIGNS = {"+": "(+)-", "-": "(−)-", None: ""}


class AbstractPairs(AbstractDiscreteStructure):
    """A structure of a discrete Lagrangian on Q × Q."""

    @property
    @abstractmethod
    def default_sign(self) -> str:
        """The sign of the scheme, "+" for one that is neither."""

    @abstractmethod
    def in_coordinates(self, rows: Data, centre: int, params: Any) -> tuple["LagrangianPairs", Data, Any]:
        """The structure on R^d × R^d, with consecutive rows and params of its functions, in coordinates about one of the rows:
        their q, p and a tangent vector `along` at the centre."""


class LagrangianPairs(AbstractPairs):
    """The structure of three points in a row, for L_d, f_d^± and w_d on Q × Q, [W; ∂g/∂q] on Q, and g.

    (+) and (−): the element (X^{d±}, d_D^±L_d) at q1 of the induced structure ([PY] Definition 6.7, Proposition 5.17),
    with the Legendre momenta F⁺L_d or F⁻L_d; the constraint is W q̂ of the pair (q0, q1) or (q1, q2). Otherwise
    w_d(q1, q2) = 0 and D2 L_d(q0, q1) + D1 L_d(q1, q2) ∈ Δ°(q1). Δ° is taken from the singular vectors of [W; ∂g/∂q], so
    that Δ = ker W ∩ ker ∂g/∂q; the constraints of a pair (q0, q1) are those of W and g(q1) = 0. Forces add f_d^+ to
    D2 L_d and f_d^− to D1 L_d.

    `sign` is "+" or "-" for the schemes of [PY], None for a general discrete constraint; `share` is the part of the
    constraint force that is taken off the incoming momentum D2 L_d(q_{k−1}, q_k) before it is saved. Times are those of the
    first point of a pair.
    """

    system: LagrangeDirac
    rule: Any
    constraint_rule: Any
    step: Any
    shape: Shape = eqx.field(static=True)
    sign: str | None = eqx.field(static=True, default=None)
    share: float = eqx.field(static=True, default=0.0)
    quadrature: Any = None
    """f_d^± as a function (t, q0, v, h, params), where they are not by the quadrature of L_d."""

    @property
    def default_sign(self) -> str:
        return self.sign or "+"

    def in_coordinates(self, rows: Data, centre: int, params: Any) -> tuple["LagrangianPairs", Data, Any]:
        return self, rows, params

    # ------------------------------------------------------------------ functions on Q × Q and Q

    def lagrangian(self, t: Any, q0: Vector, q1: Vector, params: Any) -> Scalar:
        """L_d(q0, q1)."""
        ld = discrete_lagrangian(self.system.lagrangian, self.rule)
        return ld(t, q0, (q1 - q0) / self.step, self.step, params)

    def impulses(self, t: Any, q0: Vector, q1: Vector, params: Any) -> tuple[Vector, Vector]:
        """(f_d^−, f_d^+)(q0, q1)."""
        if self.system.forces is None:
            return jnp.zeros_like(q0), jnp.zeros_like(q0)
        impulses = self.quadrature or discrete_forces(self.system.forces, self.rule)
        return impulses(t, q0, (q1 - q0) / self.step, self.step, params)

    @once
    def slots(self, t: Any, q0: Vector, q1: Vector, params: Any) -> tuple[Vector, Vector]:
        """(D1 L_d + f_d^−, D2 L_d + f_d^+)."""
        d1, d2 = slot_derivatives(lambda a, b: self.lagrangian(t, a, b, params), q0, q1)
        first, last = self.impulses(t, q0, q1, params)
        return d1 + first, d2 + last

    def constraint(self, t: Any, q0: Vector, q1: Vector, params: Any) -> Float[Array, " k"]:
        """(w_d(q0, q1), g(q1))."""
        found = self.system.constraints.position_defect(t + self.step, q1, params)
        if self.system.one_forms is None:
            return found
        wd = discrete_constraint(self.system.constraints, self.constraint_rule)
        return jnp.concatenate([wd(t, q0, (q1 - q0) / self.step, self.step, params), found])

    def matrix(self, t: Any, q: Vector, params: Any) -> Float[Array, "k n"]:
        """[W; ∂g/∂q], the one-forms of Δ_Q."""
        return self.system.constraints.matrix(t, q, params)

    def annihilator(self, t: Any, q: Vector, params: Any) -> Float[Array, "n n"]:
        """The projector onto Δ°_Q(q)."""
        return annihilator_projector(self.matrix(t, q, params))

    def outside(self, t: Any, q: Vector, vector: Vector, params: Any) -> Vector:
        """The part of a vector or covector in Δ°_Q(q)."""
        return self.annihilator(t, q, params) @ vector if self._constrained else jnp.zeros_like(vector)

    def admissible(self, t: Any, q: Vector, vector: Vector, units: Vector, params: Any) -> Vector:
        """The vector of Δ_Q(q) that is nearest to one in these units of the coordinates."""
        if not self._constrained:
            return vector
        return vector - units * (annihilator_projector(self.matrix(t, q, params) * units[None, :]) @ (vector / units))

    # ------------------------------------------------------------------ AbstractDiscreteStructure

    @property
    def points(self) -> int:
        return 3

    @property
    def _constrained(self) -> bool:
        return self.shape.m + self.shape.c > 0

    @property
    def without_matrix(self) -> bool:
        return not self._constrained and self.shape.n > MANY

    @property
    def reads(self) -> tuple[str, ...]:
        return ("q", "p", "multipliers") if self._constrained else ("q", "p")

    @property
    def claims(self) -> tuple[Claim, ...]:
        parts = "q̂ ∈ Δ, β + p̂ ∈ Δ°" if self.sign else "w_d = 0, D₂L_d + D₁L_d ∈ Δ°"
        both, forces = (" and multipliers", " and forces") if self._constrained else ("", "")
        return (
            Claim(f"{SIGNS[self.sign]}discrete Dirac structure", ("constraint", "force"), f"{parts} at every step, from q alone"),
            Claim(f"saved p{both}", ("saved",), f"against the Legendre transforms{forces} of q"),
        )

    @property
    def given(self) -> tuple[str, ...]:
        return ("constraint",) if self.sign == "+" else ()

    @property
    def step_form(self) -> FormOnPairs:
        return FormOnPairs(self)

    @property
    def own_constraints(self) -> bool:
        return True

    def constraint_size(self, row: Data, speed: Array, params: Any) -> Float[Array, " k"]:
        """|W||v| + |b|, and the terms of g."""
        speeds = self.system.speeds(row["t"], row["q"], speed, params)
        terms = self.system.constraints.terms(row["t"], row["q"], speed, speeds, params)
        return terms[: self.shape.m + self.shape.c]

    @property
    def counts(self) -> tuple[int, ...]:
        return self.shape.m + self.shape.c, 1, 1

    def membership_terms(self, rows: Data, params: Any) -> Float[Array, "2 numbers"]:
        """(constraints, force, saved): the third is by how much the p and the multipliers saved at the middle point miss the
        Legendre momenta and the force of the three points."""
        if self.without_matrix:
            return self._of_terms(rows, params)
        return self.defects(rows, params, jnp.abs(jnp.ravel(rows["q"])))

    def _of_terms(self, rows: Data, params: Any) -> Float[Array, "2 numbers"]:
        """The same without constraints, by the sizes of the terms alone, which takes no matrix."""
        (t, here, _), (q0, q1, q2), p = rows["t"], rows["q"], rows["p"][1]
        (before0, p1), (before1, p2) = self.slots(t, q0, q1, params), self.slots(here, q1, q2, params)
        jump = p1 + before1
        largest = jnp.max(jnp.abs(p1) + jnp.abs(p2) + jnp.abs(before0) + jnp.abs(before1))
        missed = jnp.stack([jnp.max(jnp.abs(jump)), jnp.max(jnp.abs(p - p1 + self.share * jump))])
        return jnp.stack([missed, jnp.stack([largest, largest])])

    def defects(self, rows: dict[str, Array], params: Any, sizes: Float[Array, " k"]) -> Float[Array, "2 numbers"]:
        """The same in roundings of numbers of these sizes, of which the coordinates of the three points are made."""
        h, (t, here, _), (q0, q1, q2), p = self.step, rows["t"], rows["q"], rows["p"][1]
        n = q0.shape[0]
        multipliers = rows["multipliers"][1] if self._constrained else jnp.zeros(0)
        (before0, p1), (before1, p2) = self.slots(t, q0, q1, params), self.slots(here, q1, q2, params)
        matrix = self.matrix(here, q1, params)
        first, pair = (t, (q0, q1)) if self.sign == "+" else (here, (q1, q2))
        if self.sign is None:
            constraint, force = self.constraint(first, *pair, params), (p1 + before1) / h
            force = force - self.outside(here, q1, force, params)
        else:
            legendre = before0, p1, before1, p2
            constraint, force = self._of_induced_structure((t, here), (q0, q1, q2), pair, legendre, params)
            plain = self.system.holonomic is None and self.system.affine is None
            constraint = constraint if plain else self.constraint(first, *pair, params)

        jump = p1 + before1
        units = sizes_of_rows(matrix)
        of_jump = (pseudo_inverse(matrix / units, ONE_FORM_RANK) / units.T).T @ jump if matrix.shape[0] else jnp.zeros(0)
        taken = p - p1 + self.share * jump
        if self.system.holonomic is not None:
            m = self.shape.m
            taken = p - p1 + self.share * (matrix[:m].T @ multipliers[:m])
            taken = taken - annihilator_projector(matrix[m:]) @ taken  # p is projected along the image of (∂g/∂q)ᵀ
        saved = jnp.concatenate([taken, jump - matrix.T @ multipliers])

        def force_of(z):
            a, b, c = jnp.split(z, 3)
            return self.slots(t, a, b, params)[1] + self.slots(here, b, c, params)[0]

        def reaction_of(q):
            return self.matrix(here, q, params).T @ of_jump

        def constraint_of(z):
            a, b, c = jnp.split(z, 3)
            return self.constraint(first, *((a, b) if self.sign == "+" else (b, c)), params)

        z = jnp.concatenate([q0, q1, q2])
        moved = jnp.maximum(jnp.abs(q1 - q0), jnp.abs(q2 - q1))
        size = sizes + jnp.tile(moved + h * self.system.speeds(here, q1, moved / h, params), 3)
        terms = jnp.abs(p1) + jnp.abs(p2) + jnp.abs(before0) + jnp.abs(before1)
        of_reaction = jnp.abs(jacobian(reaction_of)(q1)) @ size[n : 2 * n]
        largest = jnp.max(terms + jnp.abs(jacobian(force_of)(z)) @ size + of_reaction)
        missed = jnp.stack([jnp.max(jnp.abs(force)) * h, jnp.max(jnp.abs(saved))])
        if constraint.shape[0] == 0:
            return jnp.stack([missed, jnp.stack([largest, largest])])
        of_constraint = jnp.abs(jacobian(constraint_of)(z)) @ size
        missed = jnp.concatenate([jnp.abs(constraint), missed])
        return jnp.stack([missed, jnp.concatenate([of_constraint, jnp.stack([largest, largest])])])

    def _of_induced_structure(
        self,
        times: tuple[Any, Any],
        q: tuple[Vector, Vector, Vector],
        pair: tuple[Vector, Vector],
        legendre: tuple[Vector, Vector, Vector, Vector],
        params: Any,
    ) -> tuple[Array, Array]:
        """(W q̂, (second order, β + p̂ outside Δ°)) of the three points, by the pointwise structures of [PY]."""
        h, (t, here), (q0, q1, q2) = self.step, times, q
        before0, p1, before1, p2 = legendre
        assert self.sign is not None
        forms = None
        if self._constrained:
            forms = UserFunction(lambda q, params: self.matrix(here, q, params), "one_forms", ("q",))
        structure = InducedFiniteDifferenceDirac(forms, step=h, sign=self.sign)
        far, of_force = (here, (q1, q2)) if self.sign == "+" else (t, (q0, q1))
        ld = lambda a, b: self.lagrangian(far, a, b, params)
        _, _, beta, gamma = FiniteDifferenceTriple(step=h, sign=self.sign).dirac_differential(ld, q0, q1, q2)
        beta = beta - sum(self.impulses(far, *of_force, params)) / h
        momenta = (p1, p2) if self.sign == "+" else (-before0, -before1)
        constraint, second_order, force = structure.membership_defect(*pair, momenta, beta, gamma, params)
        return constraint, jnp.concatenate([second_order, force])


def structure_on_pairs(
    system: Any, shape: Shape, step: Any, rule: Any, constraint: Any, *, sign: str | None = None, share: float = 0.0
) -> LagrangianPairs | str:
    """The structure of a discrete Lagrangian and a discrete constraint on a system, or why it has none."""
    lagrangian = system.lagrangian_form()
    if lagrangian is None:
        return f"the points of a {type(system).__name__} are not those of a Lagrangian on Q × Q"
    if lagrangian.forces_see_multipliers:
        return "the forces see the multipliers, which pairs of points do not say"
    return LagrangianPairs(lagrangian, rule, constraint, step, shape, sign, share)
