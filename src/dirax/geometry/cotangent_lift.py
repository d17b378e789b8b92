"""The cotangent lift of a discretization map ([BLM] §4.2), for any map on any manifold, by automatic differentiation."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from dirax.geometry.manifolds import AbstractManifold, Vector
from dirax.geometry.map_report import tangent_coordinates
from dirax.geometry.maps import AbstractDiscretizationMap
from dirax.geometry.spaces import Euclidean
from dirax.program.tracing import once
from dirax.program.user_functions import evaluated


class CotangentBundle(AbstractManifold):
    """T*Q, a point being (q, p) (2N,): q on Q in R^N, and the covector p as the tangent vector at q that represents it.

    ⟨p, v⟩ = p·v, and the canonical symplectic form is the restriction of dq ∧ dp from R^2N. A tangent vector (q̇, ṗ) is
    the velocity of a curve of such points, so ṗ is not tangent to Q in general: on the sphere ⟨q, ṗ⟩ = −⟨q̇, p⟩.
    `projection` is not orthogonal: it keeps the tangential parts of q̇ and ṗ.
    """

    base: AbstractManifold
    dimension: int = eqx.field(static=True)
    ambient_dimension: int = eqx.field(static=True)

    def __init__(self, base: AbstractManifold):
        self.base = base
        self.dimension, self.ambient_dimension = 2 * base.dimension, 2 * base.ambient_dimension

    def defect(self, x):
        """The larger of those of q and of p as a tangent vector at q."""
        q, p = jnp.split(x, 2)
        return jnp.maximum(self.base.defect(q), self.base.tangent_defect(q, p))

    def nearest(self, x):
        """The nearest q, and p projected to the tangent space there."""
        q, p = jnp.split(x, 2)
        q = self.base.nearest(q)
        return jnp.concatenate([q, self.base.projection(q, p)])

    def projection(self, x, v):
        """q̇ projected to the tangent space, and ṗ made the derivative of a p that stays tangent along it."""
        (q, p), (q_dot, p_dot) = jnp.split(x, 2), jnp.split(v, 2)
        q_dot = self.base.projection(q, q_dot)
        return jnp.concatenate([q_dot, self.base.projection(q, p_dot) + moving_with(self.base, q, p, q_dot)])

    def representative(self, x, near):
        """The representative of q nearest to that of `near`, with p carried along."""
        (q, p), target = jnp.split(x, 2), jnp.split(near, 2)[0]
        return jnp.concatenate(jax.jvp(lambda q: self.base.representative(q, target), (q,), (p,)))

    def local_parametrization(self, x):
        """(r, s) ↦ the point of r on Q, and p + Fs projected there, F the frame at q."""
        q, p = jnp.split(x, 2)
        point, frame = self.base.local_parametrization(q), self.base.frame(q)

        def parametrization(r):
            r, s = jnp.split(r, 2)
            return jnp.concatenate([point(r), self.base.projection(point(r), p + frame @ s)])

        return parametrization

    def frame(self, x):
        """The derivative of the parametrization at 0: of q with the p it moves, then of p alone."""
        q, p = jnp.split(x, 2)
        frame = self.base.frame(q)
        moving = jax.vmap(lambda direction: moving_with(self.base, q, p, direction), 1, 1)(frame)
        return jnp.block([[frame, jnp.zeros_like(frame)], [moving, frame]])

    def coordinates(self, x, v):
        """The components of q̇ and of ṗ in the frame of Q."""
        (q, _), (q_dot, p_dot) = jnp.split(x, 2), jnp.split(v, 2)
        return jnp.concatenate([self.base.coordinates(q, q_dot), self.base.coordinates(q, p_dot)])


class CotangentLift(AbstractDiscretizationMap):
    """The lift of a discretization map on Q to one on T*Q: x = (q, p), v = (q̇, ṗ) ↦ (q0, p0), (q1, p1), all (2N,).

    With (q0, q1) = R_d(q, q̇) and J = D R_d(q, q̇), (−p0, p1) = J^{−T}(ṗ, p), that is
    ⟨p1, δq1⟩ − ⟨p0, δq0⟩ = ⟨ṗ, δq⟩ + ⟨p, δq̇⟩ for every variation (δq, δq̇) of (q, q̇) along TQ. It is a discretization
    map, and symplectic: dp1∧dq1 − dp0∧dq0 pulls back to dṗ∧dq + dp∧dq̇ ([BLM] Proposition 4.11, Corollary 4.12).

    J^{−T} is the transposed derivative of R_d⁻¹, so no linear system is solved. On a manifold in R^N the variations are
    tangent to TQ, and covectors are tangent vectors, as in `CotangentBundle`. Make it with `cotangent_lift(map)`.
    """

    map: AbstractDiscretizationMap

    @property
    def is_known(self):
        """Where the map on Q is."""
        return self.map.is_known

    def manifold(self, ambient_dimension):
        """T*Q for the manifold Q of the map; `ValueError` for points of odd length, `TypeError` for a second lift off R^n."""
        if ambient_dimension % 2:
            raise ValueError(f"A point of T*Q is (q, p), of even length, but one of length {ambient_dimension} came.")
        base = self.map.manifold(ambient_dimension // 2)
        if isinstance(base, CotangentBundle):
            raise TypeError("Only maps on vector spaces can be lifted twice: covectors of T*Q have no representation.")
        return Euclidean(ambient_dimension) if isinstance(base, Euclidean) else CotangentBundle(base)

    @property
    def base_fraction(self):
        """That of the map."""
        return self.map.base_fraction

    def forward(self, x, v):
        """((q0, p0), (q1, p1)) with (−p0, p1) = J^{−T}(ṗ, p)."""
        (q, p), (q_dot, p_dot) = jnp.split(x, 2), jnp.split(v, 2)
        base = self.map.manifold(q.shape[0])
        q0, q1 = self.map.forward(q, q_dot)
        minus_p0, p1 = jax.vjp(self.map.backward, q0, q1)[1]((p_dot, p))
        return (
            jnp.concatenate([q0, -base.projection(q0, minus_p0)]),
            jnp.concatenate([q1, base.projection(q1, p1)]),
        )

    def backward(self, x0, x1):
        """(q, q̇) = R_d⁻¹(q0, q1) and (ṗ, p) = Jᵀ(−p0, p1), as x = (q, p) and v = (q̇, ṗ)."""
        (q0, p0), (q1, p1) = jnp.split(x0, 2), jnp.split(x1, 2)
        base = self.map.manifold(q0.shape[0])
        q1, p1 = jax.jvp(lambda q: base.representative(q, q0), (q1,), (p1,))
        q, q_dot = self.map.backward(q0, q1)
        # δq̇ is tangent at q but for the part fixed by δq; `projection` inside keeps the pairing on tangent parts.
        pull_back = jax.vjp(lambda q, q_dot: self.map.forward(q, base.projection(q, q_dot)), q, q_dot)[1]
        p_dot, p = pull_back((-p0, p1))
        return (
            jnp.concatenate([q, p]),
            jnp.concatenate([q_dot, base.projection(q, p_dot) + moving_with(base, q, p, q_dot)]),
        )

    def reach(self, x, v):
        """That of the map at (q, q̇)."""
        return self.map.reach(jnp.split(x, 2)[0], jnp.split(v, 2)[0])


def cotangent_lift(map: AbstractDiscretizationMap) -> CotangentLift:
    """The symplectic discretization map on T*Q that lifts a discretization map on Q ([BLM] Proposition 4.11).

        lift = dx.cotangent_lift(dx.Theta(0.0))
        (q0_p0, q1_p1) = lift(jnp.array([1.0, 2.0]), jnp.array([0.1, 0.2]))     # symplectic Euler: (1, 1.8), (1.1, 2)

    Raises `TypeError` for something that is not a discretization map.
    """
    if not isinstance(map, AbstractDiscretizationMap):
        raise TypeError(f"cotangent_lift needs a discretization map such as Midpoint(), but {map!r} came.")
    return CotangentLift(map)


def moving_with(base: AbstractManifold, q: Vector, p: Vector, q_dot: Vector) -> Vector:
    """The normal part of ṗ for a covector p at q that stays a tangent vector while q moves with velocity q̇."""
    return jax.jvp(lambda q: base.projection(q, p), (q,), (q_dot,))[1]


def symplecticity_defect(lift: AbstractDiscretizationMap, x: ArrayLike, v: ArrayLike) -> Float[Array, ""]:
    """Largest entry of the difference of the two symplectic forms of [BLM] Corollary 4.12 at the tangent vector v at x.

    Ω12 = dp1∧dq1 − dp0∧dq0, pulled back by the map, against d_Tω = dṗ∧dq + dp∧dq̇, both on the coordinates of T(T*Q);
    zero for a cotangent lift. x = (q, p) and v = (q̇, ṗ) have shape (2N,).
    """
    x, v = jnp.asarray(x, dtype=float), jnp.asarray(v, dtype=float)
    return jnp.asarray(evaluated(once(_symplecticity_defect, lift), x, v))


def _symplecticity_defect(lift: AbstractDiscretizationMap, x: Array, v: Array) -> Array:
    tangent, here = tangent_coordinates(lift.manifold(x.shape[0]), x, v)

    def both(z):
        tangent_vector = tangent(z)
        return tangent_vector, lift.forward(*tangent_vector)

    (point, velocity), (first, second) = jax.jacfwd(both)(here)

    def wedge(a, b):
        """Σ dp_i(a) dq_i(b) − dp_i(b) dq_i(a) over the columns of two Jacobians of (q, p)."""
        (qa, pa), (qb, pb) = jnp.split(a, 2), jnp.split(b, 2)
        return pa.T @ qb - qa.T @ pb

    tangent_form = wedge(velocity, point) + wedge(point, velocity)
    return jnp.max(jnp.abs(wedge(second, second) - wedge(first, first) - tangent_form))
