"""The discrete Dirac structures of discretization maps ([BLM] Definition 5.1), on points x and on T*Q of a Lagrangian."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.geometry.cotangent_lift import CotangentLift, cotangent_lift
from dirax.geometry.finite_difference import annihilator_projector
from dirax.geometry.maps import AbstractDiscretizationMap
from dirax.geometry.spaces import AbstractFlat
from dirax.program.tracing import gradient, jacobian
from dirax.schemes.discrete_structure import AbstractDiscreteStructure, Claim
from dirax.systems.forms import RelationForm
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.manifold_lagrangian import ManifoldLagrangian
from dirax.systems.shape import Shape

NAME = "discretization-map Dirac structure"
PROJECTED = "Method 2 projects the step of D onto the final manifold"


def moved(first: Array, last: Array) -> Array:
    """What both points change when every coordinate is changed by itself: |x| + |Δx|."""
    return jnp.abs(jnp.concatenate([first, last])) + jnp.tile(jnp.abs(last - first), 2)


class RelationPairs(AbstractDiscreteStructure):
    """A relation between points x and velocities, discretized by a map R_d: R_d⁻¹(x0, x1)/h satisfies it at its base point,
    with the saved multipliers.

    Of a Dirac system the relation is (ẋ, dH) ∈ D: that is [BLM] Definition 5.1.
    """

    relation: RelationForm = eqx.field(static=True)
    map: AbstractDiscretizationMap
    step: Any

    @property
    def points(self) -> int:
        return 2

    @property
    def reads(self) -> tuple[str, ...]:
        return (self._name, "multipliers") if self.relation.saved else (self._name,)

    @property
    def theta(self) -> float | None:
        return self.map.base_fraction

    def curved(self, n: int) -> bool:
        return not isinstance(self.map.manifold(n), AbstractFlat)

    @property
    def _name(self) -> str:
        """That of the field of points."""
        return self.relation.names[0]

    @property
    def claims(self) -> tuple[Claim, ...]:
        x, says = self._name, self.relation.dirac or "(x, ẋ) ∈ S₀"
        statement = says.replace("ẋ", f"R_d⁻¹({x}₀, {x}₁)/h")
        quantity = NAME if self.relation.dirac else "discretized implicit system"
        return (Claim(quantity, ("relation",), f"{statement} at every step, from {x} alone"),)

    def membership_terms(self, rows: dict[str, Array], params: Any) -> Float[Array, "2 1"]:
        """Relative to the terms of the relation that are linear in v and in the multipliers, and the rest."""
        (x0, x1), at = rows[self._name], rows["t"][0] + self.map.base_fraction * self.step
        multipliers = jnp.zeros(self.relation.multipliers)
        if self.relation.saved:
            multipliers = jax.vmap(self.relation.spread)(jnp.eye(self.relation.multipliers)) @ rows["multipliers"][0]
        n = x0.shape[0]
        manifold = self.map.manifold(n)

        def velocity(a, b):
            x, v = self.map.inverse(a, b)
            return x, v / self.step

        def defect(z):
            x, v = velocity(*jnp.split(z, 2))
            missed = jnp.asarray(self.relation.residual(x, v, multipliers, at, params))
            return jnp.concatenate([manifold.projection(x, missed[:n]), missed[n:]])

        x, v = velocity(x0, x1)
        relation = lambda v, multipliers: jnp.asarray(self.relation.residual(x, v, multipliers, at, params))
        of_velocity, of_multipliers = jacobian(relation, (0, 1))(v, multipliers)
        rest = relation(jnp.zeros_like(v), jnp.zeros_like(multipliers))
        terms = jnp.abs(of_velocity) @ jnp.abs(v) + jnp.abs(of_multipliers) @ jnp.abs(multipliers) + jnp.abs(rest)
        z = jnp.concatenate([x0, x1])
        scale = jnp.max(terms) + jnp.max(jnp.abs(jacobian(defect)(z)) @ moved(x0, x1))
        return jnp.stack([jnp.max(jnp.abs(defect(z))), scale])[:, None]


class LiftedPairs(AbstractDiscreteStructure):
    """[BLM] Definition 5.1 on T*Q for a Lagrangian and the Dirac structure of Δ = ker [W; ∂g/∂q], by a lifted map.

    With ((q, p), (q̇, ṗ)) = R_d⁻¹((q0, p0), (q1, p1))/h: p = ∂L/∂q̇, q̇ ∈ Δ (with affine parts and explicit time
    W q̇ + b = 0, ∂g/∂q q̇ + ∂g/∂t = 0) and ṗ − ∂L/∂q − f ∈ Δ°, which is [W; ∂g/∂q]ᵀλ with the saved multipliers λ. On a
    manifold in R^N, L is extended to all vectors by their tangent parts, and covectors are judged by theirs.
    """

    system: LagrangeDirac | ManifoldLagrangian
    map: CotangentLift
    step: Any
    constraint_count: int = eqx.field(static=True)

    @property
    def constrained(self) -> bool:
        """Whether there are constraints."""
        return self.constraint_count > 0

    @property
    def points(self) -> int:
        return 2

    @property
    def reads(self) -> tuple[str, ...]:
        return ("q", "p", "multipliers") if self.constrained else ("q", "p")

    @property
    def counts(self) -> tuple[int, ...]:
        return (1, 1, self.constraint_count, 1) if self.constrained else (1, 1)

    @property
    def claims(self) -> tuple[Claim, ...]:
        parts = "p = ∂L/∂q̇, q̇ ∈ Δ, ṗ − ∂L/∂q ∈ Δ°" if self.constrained else "p = ∂L/∂q̇, ṗ = ∂L/∂q"
        names = ("momentum", "force", "constraint") if self.constrained else ("momentum", "force")
        own = Claim(NAME, names, f"{parts} at the base point of R_d⁻¹ at every step, from q and p alone")
        if not self.constrained:
            return (own,)
        return own, Claim("saved multipliers", ("multipliers",), "against the forces at the base points", solved=True)

    def membership_terms(self, rows: dict[str, Array], params: Any) -> Float[Array, "2 numbers"]:
        (q0, q1), (p0, p1), h = rows["q"], rows["p"], self.step
        n, t = q0.shape[0], rows["t"][0] + self.map.base_fraction * h
        multipliers = rows["multipliers"][0] if self.constrained else jnp.zeros(0)
        constraints, manifold = self.system.constraints, self.map.map.manifold(n)

        def base(z):
            x0, x1 = jnp.split(z, 2)
            (q, p), (q_dot, p_dot) = (jnp.split(part, 2) for part in self.map.inverse(x0, x1))
            return q, p, q_dot / h, p_dot / h

        def slopes(q, v):
            return gradient(lambda q, v: self.system.lagrangian.at(t, q, manifold.projection(q, v), params), (0, 1))(q, v)

        def terms_of(z):
            """The terms of p − ∂L/∂q̇, and of the balance of forces: ṗ, ∂L/∂q, f, Wᵀλ."""
            q, p, v, rate = base(z)
            along, momentum = slopes(q, v)
            force = jnp.zeros(n) if self.system.forces is None else self.system.forces(t, q, v, params)
            reaction = constraints.matrix(t, q, params).T @ multipliers
            tangential = jax.vmap(lambda vector: manifold.projection(q, vector))
            return tangential(jnp.stack([p, -momentum])), tangential(jnp.stack([rate, -along, -force, -reaction]))

        def missed(z):
            legendre, balance = terms_of(z)
            q, _, v, _ = base(z)
            constraint = constraints.velocity_defect(t, q, v, params)
            return jnp.concatenate([jnp.sum(legendre, axis=0), jnp.sum(balance, axis=0), constraint])

        z = jnp.concatenate([q0, p0, q1, p1])
        size = moved(jnp.concatenate([q0, p0]), jnp.concatenate([q1, p1]))
        of_each = lambda numbers: jnp.split(numbers, [n, 2 * n])
        (momentum, force, constraint), scales = of_each(missed(z)), of_each(jnp.abs(jacobian(missed)(z)) @ size)
        legendre, balance = terms_of(z)
        of_momentum = jnp.max(jnp.sum(jnp.abs(legendre), axis=0) + scales[0])
        of_force = jnp.max(jnp.sum(jnp.abs(balance), axis=0) + scales[1])
        first, whole = jnp.max(jnp.abs(momentum)), jnp.max(jnp.abs(force))
        if not self.constrained:
            return jnp.stack([jnp.stack([first, whole]), jnp.stack([of_momentum, of_force])])
        outside = force - annihilator_projector(constraints.matrix(t, base(z)[0], params)) @ force
        numbers = jnp.concatenate([jnp.stack([first, jnp.max(jnp.abs(outside))]), jnp.abs(constraint), whole[None]])
        sizes = jnp.concatenate([jnp.stack([of_momentum, of_force]), scales[2], of_force[None]])
        return jnp.stack([numbers, sizes])


def structure_on_cotangent_bundle(
    system: LagrangeDirac | ManifoldLagrangian, shape: Shape, map: AbstractDiscretizationMap, step: Any
) -> LiftedPairs:
    """The structure of a Lagrangian by a map on Q, or by its lift."""
    lift = map if isinstance(map, CotangentLift) else cotangent_lift(map)
    return LiftedPairs(system, lift, step, shape.m + shape.c)
