"""Methods 1 and 2 of [BLM] for Lagrangians with constraints by the cotangent lift of any discretization map on Q.

With B = R_d⁻¹, (q, w) = B(q0, q1) and v = w/h, the lift of (p, ṗ) at (q, v) is (−p0, p1) = DB(q0, q1)ᵀ (h ṗ, p). On a
manifold in R^N covectors are the tangent vectors that represent them, and equations of covectors are paired with a frame.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.geometry.manifolds import AbstractManifold
from dirax.geometry.maps import AbstractDiscretizationMap
from dirax.program.linear_solves import solve
from dirax.program.tracing import along, gradient, jacobian, once
from dirax.schemes.constraint_rows import ConstraintRows
from dirax.schemes.lagrangian_methods import lagrangian_fields, rates
from dirax.schemes.step import Shape, StepEquation
from dirax.schemes.work_of_forces import WorkOfForces
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.manifold_lagrangian import ManifoldLagrangian


class Base(NamedTuple):
    """The base point of a step: its time, q and v there, and the covectors −p0 at q0 and p1 at q1 of given (p, ṗ)."""

    t: Any
    q: Float[Array, " N"]
    v: Float[Array, " N"]
    q0: Float[Array, " N"]
    q1: Float[Array, " N"]


class Lift(NamedTuple):
    """The cotangent lift of a map on a manifold of dimension d in R^N, with what puts unknowns on it."""

    map: AbstractDiscretizationMap
    manifold: AbstractManifold

    @property
    def flat(self) -> bool:
        """Whether the ambient coordinates are coordinates of the manifold."""
        return self.manifold.dimension == self.manifold.ambient_dimension

    def end(self, q0: Array, change: Float[Array, " d"]) -> Float[Array, " N"]:
        """The point that is `change` away from q0 in a local parametrization there, on the manifold to roundoff."""
        return q0 + change if self.flat else self.manifold.local_parametrization(q0)(change)

    def base(self, q0: Array, q1: Array, t: Any, h: Any) -> Base:
        """The base point of the step from q0 to q1."""
        q, w = self.map.backward(q0, q1)
        return Base(t + self.map.base_fraction * h, q, w / h, q0, q1)

    def lifted(self, at: Base, force: Array, momentum: Array) -> tuple[Array, Array]:
        """(−p0, p1) = DBᵀ (force, momentum), tangent vectors at q0 and q1."""
        force, momentum = (jnp.asarray(x) for x in (force, momentum))

        def paired(q0, q1):
            q, w = self.map.backward(q0, q1)
            return force @ q + momentum @ w

        first, last = gradient(paired, (0, 1))(at.q0, at.q1)
        return self.tangential(at.q0, first), self.tangential(at.q1, last)

    def tangential(self, q: Array, vector: Array) -> Float[Array, " N"]:
        """The tangent part at q of an ambient vector."""
        return vector if self.flat else self.manifold.projection(q, vector)

    def paired(self, q: Array, covector: Array) -> Float[Array, " d"]:
        """The components of a covector at q, paired with a fixed frame there."""
        if self.flat:
            return covector
        return jax.lax.stop_gradient(self.manifold.frame(q)).T @ self.manifold.projection(q, covector)

    def tangents(self, q0: Array, q: Array) -> Float[Array, "N d"]:
        """A basis of the tangent space at q by columns, smooth in q: a frame at q0, projected."""
        if self.flat:
            return jnp.eye(self.manifold.dimension)
        fixed = jax.lax.stop_gradient(self.manifold.frame(q0))
        return jax.vmap(lambda f: self.manifold.projection(q, f), 1, 1)(fixed)

    def components(self, q: Array, v: Array) -> Float[Array, " d"]:
        """The components of a tangent vector in the frame of `end`."""
        return v if self.flat else self.manifold.coordinates(q, v)

    def turning(self, q: Array, v: Array) -> Float[Array, " N"]:
        """The normal part of v̇ for a curve with velocity v on the manifold."""
        return along(lambda q: self.manifold.projection(q, v), (q,), (v,))


def lift_of(map: AbstractDiscretizationMap, system: LagrangeDirac | ManifoldLagrangian, size: int) -> Lift:
    """The lift of a map for a Lagrangian system with points of length `size`; raises `ValueError` where the map has another
    manifold than the system."""
    manifold = map.manifold(size)
    if isinstance(system, ManifoldLagrangian):
        if system.manifold != manifold:
            raise ValueError(f"the system is on {system.manifold}, but the map {type(map).__name__} is on {manifold}.")
    elif manifold.dimension != size:
        raise ValueError(
            f"the map {type(map).__name__} is on {manifold}, but the q of a dx.{type(system).__name__} are {size} coordinates: "
            "state the Lagrangian on the manifold, dx.ManifoldLagrangian(lagrangian, manifold, one_forms=…, forces=…)."
        )
    return Lift(map, manifold)


def lifted_lagrangian(system: LagrangeDirac | ManifoldLagrangian, shape: Shape, lift: Lift) -> StepEquation:
    """Method 1: the lifted map on p = ∂L/∂q̇, ṗ = ∂L/∂q + f + Wᵀλ, W q̇ + b = 0 ([BLM] §6):

        p0 + D₁Bᵀ(h ṗ, p) = 0,   W(q) v + b = 0,   p1 = D₂Bᵀ(h ṗ, p).

    Unknowns are q1 in a local parametrization at q0, as a velocity, and λ. Without constraints these are the discrete
    Euler–Lagrange equations of L_d = h L(B(q0, q1)/h), also for degenerate L.
    """
    n, d, rows = shape.n, lift.manifold.dimension, ConstraintRows(system, shape)
    k, book = rows.count, WorkOfForces(system, shape.n)

    def ends(u, state, t, h, params):
        """The base point, and (−p0, p1)."""
        q0 = state[:n]
        at = lift.base(q0, lift.end(q0, h * u[:d]), t, h)
        rate, momentum = rates(system, at.t, at.q, at.v, params)
        rate = rate + rows.matrix(at.t, at.q, params).T @ u[d:] if k else rate
        return at, lift.lifted(at, h * rate, momentum)

    def residual(u, state, t, h, params):
        at, (minus_p0, _) = ends(u, state, t, h, params)
        balance = lift.paired(state[:n], state[n : 2 * n] + minus_p0)
        return jnp.concatenate([balance, rows.velocity_defect(at.t, at.q, at.v, params)]) if k else balance

    def advance(u, state, t, h, params):
        at, (_, p1) = ends(u, state, t, h, params)
        return book.after(state, [at.q1, p1], at.t, at.q, at.v, h, params)

    def unpack(state, u, t, h, params):
        row = book.row(state) | {"q": state[:n], "p": state[n : 2 * n]}
        return row | ({"multipliers": rows.all(u[d:])} if shape.m + shape.c else {})

    def start(data, h, params):
        if "q0" not in data:
            return book.start(data["q"], data["p"]), jnp.concatenate([lift.components(data["q"], data["v"]), jnp.zeros(k)])
        if k or not lift.flat:
            raise ValueError("with constraints this scheme starts from q= with v= or p=, not from two points.")
        q0, u = data["q0"], (data["q1"] - data["q0"]) / h
        _, (minus_p0, _) = ends(u, q0, data.get("t", 0.0), h, params)
        return book.start(q0, -minus_p0), u

    return StepEquation(
        start=start,
        residual=residual,
        advance=advance,
        unpack=unpack,
        state_size=2 * n + book.size,
        unknowns=d + k,
        fields=lagrangian_fields(system, n, shape.m + shape.c),
        labels=tuple(f"momentum balance {i}" for i in range(d)) + tuple(f"constraint {r} at the base point" for r in rows.kept),
        canonical=lift.flat and not book.size,
    )


def projected_lagrangian(system: LagrangeDirac | ManifoldLagrangian, shape: Shape, lift: Lift) -> StepEquation:
    """Method 2: the projected lift ([BLM] Prop 7.3) on M_f = {g = 0, W v + b = 0, G v + ∂g/∂t = 0} of a regular Lagrangian.

    At the base point (q, v) ∈ M_f, λ follows from the derivatives of the last two along the flow, and with p = ∂L/∂v, ṗ

        (q_k, p_k) = P(q̃0, p̃0),   (q_{k+1}, p_{k+1}) = P(q̃1, p̃1),   (−p̃0, p̃1) = DB(q̃0, q̃1)ᵀ (h ṗ, p),

    P(q̃, p̃) = (q', p'): q̃ lies in the direction h M⁻¹G(q')ᵀs from q' with g(q') = 0, and p̃ = p' + [W; G](q')ᵀσ with the
    velocity of p' on the other constraints; M = ∂²L/∂v² on the tangent space at q'. Unknowns are the velocity from q̃0 to q̃1,
    σ and s of the first half, and v', σ of the second, with the velocity from q_k to q_{k+1} and s for holonomic constraints.
    """
    n, d, rows = shape.n, lift.manifold.dimension, ConstraintRows(system, shape)
    r, c, book = rows.count, rows.holonomic, WorkOfForces(system, shape.n)
    # (u, σ, s) of the first half, (v', σ) of the second, and (u', s) of its end where there are holonomic constraints
    cuts = [d, d + r, d + r + c, 2 * d + r + c, 2 * (d + r) + c, 3 * d + 2 * r + c]
    unknowns = 3 * d + 2 * r + 2 * c if c else 2 * (d + r)

    def split(u):
        if c:
            return jnp.split(u, cuts)
        first, sigma, last, sigma_1 = jnp.split(u, [d, d + r, 2 * d + r])
        return [first, sigma, jnp.zeros(0), last, sigma_1, first, jnp.zeros(0)]

    def mass(t, q, v, params):
        return jacobian(gradient(lambda v: system.lagrangian.at(t, q, v, params)))(v)

    def flow(q0, t, q, v, params):
        return once(at_point)(q0, t, q, v, params)

    def at_point(q0, t, q, v, params):
        """(p, ṗ, λ) at a point of M_f: M v̇ and [W; G] v̇ with v̇ = F a + its normal part, F tangent vectors at q."""
        rate, p = rates(system, t, q, v, params)
        w, hessian, frame = rows.matrix(t, q, params), mass(t, q, v, params), lift.tangents(q0, q)
        coupling = _along(system, lambda t, q: rates(system, t, q, v, params)[1], t, q, v)
        turning = _along(system, lambda t, q: rows.velocity_defect(t, q, v, params), t, q, v)
        if not lift.flat:
            normal = lift.turning(q, v)
            coupling, turning = coupling + hessian @ normal, turning + w @ normal
        w_tangent = w @ frame
        lifted = solve(frame.T @ hessian @ frame, w_tangent.T)
        multipliers = -solve(w_tangent @ lifted, turning + lifted.T @ (frame.T @ (rate - coupling)))
        return p, rate + w.T @ multipliers, multipliers

    def pushed(t, q, v, s, h, params):
        """q + h M⁻¹G(q)ᵀs; on submanifolds of R^N there are no holonomic constraints."""
        return q + h * solve(mass(t, q, v, params), rows.holonomic_matrix(t, q, params).T @ s)

    def base(u, state, t, h, params):
        """The base point of the step from q̃0 to q̃1."""
        q0, (first, _, s, *_) = state[:n], split(u)
        begun = pushed(t, q0, first, s, h, params) if c else q0
        return lift.base(begun, lift.end(q0, h * first), t, h)

    def finish(u, state, at, h):
        """q_{k+1}."""
        return lift.end(state[:n], h * split(u)[5]) if c else at.q1

    def residual(u, state, t, h, params):
        q0, p0 = state[:n], state[n : 2 * n]
        _, sigma, _, last, sigma_1, _, s1 = split(u)
        at = base(u, state, t, h, params)
        q1 = finish(u, state, at, h)
        p, rate, _ = flow(q0, at.t, at.q, at.v, params)
        minus_p0, p1 = lift.lifted(at, h * rate, p)
        begun = p0 + rows.matrix(t, q0, params).T @ sigma + minus_p0
        v1 = lift.tangents(q0, q1) @ last
        momentum = rates(system, t + h, q1, v1, params)[1] + rows.matrix(t + h, q1, params).T @ sigma_1
        parts = [
            lift.paired(q0, begun),
            rows.velocity_defect(at.t, at.q, at.v, params),
            lift.tangents(q0, q1).T @ (momentum - p1),
            rows.velocity_defect(t + h, q1, v1, params),
        ]
        if c:
            missed = (pushed(t + h, q1, v1, s1, h, params) - at.q1) / h
            parts += [rows.position(at.t, at.q, params) / h, missed, rows.position(t + h, q1, params) / h]
        return jnp.concatenate(parts)

    def advance(u, state, t, h, params):
        at = base(u, state, t, h, params)
        q1 = finish(u, state, at, h)
        v1 = lift.tangents(state[:n], q1) @ split(u)[3]
        p1 = lift.tangential(q1, rates(system, t + h, q1, v1, params)[1])
        return book.after(state, [q1, p1], at.t, at.q, at.v, h, params)

    def unpack(state, u, t, h, params):
        at = base(u, state, t, h, params)
        multipliers = rows.all(flow(state[:n], at.t, at.q, at.v, params)[2])
        return {"q": state[:n], "p": state[n : 2 * n], "multipliers": multipliers, **book.row(state)}

    def start(data, h, params):
        if "q0" in data:
            raise ValueError("Method 2 is a one-step method on M_f: start it from q= with v= or p=, not from two points.")
        v, forces, shift = lift.components(data["q"], data["v"]), jnp.zeros(r), jnp.zeros(c)
        guess = jnp.concatenate([v, forces, shift, v, forces, *([v, shift] if c else [])])
        return book.start(data["q"], data["p"]), guess

    return StepEquation(
        start=start,
        residual=residual,
        advance=advance,
        unpack=unpack,
        state_size=2 * n + book.size,
        unknowns=unknowns,
        fields=lagrangian_fields(system, n, shape.m + shape.c),
        labels=tuple(f"equation {i} of Method 2" for i in range(unknowns)),
        canonical=lift.flat and not book.size,
    )


def _along(system: LagrangeDirac | ManifoldLagrangian, function, t, q, v):
    """The derivative of function(t, q) along q̇ = v, ṫ = 1."""
    if system.depends_on_time:
        return along(function, (jnp.asarray(t, float), q), (jnp.ones(()), v))
    return along(lambda q: function(t, q), (q,), (v,))
