"""What one step must satisfy: membership in the discrete Dirac structure, symplecticity, φ*Ω = Ω + dβ under constraints.

All are functions of saved rows, traceable; the first does not use how the step was solved, the last two differentiate the
step map at the engine's solution. Each defect is relative to the size of what should cancel in it.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.engines.xla.lane import first_lane, take_step
from dirax.geometry.discrete import DiscretizationMapDirac
from dirax.geometry.finite_difference import InducedFiniteDifferenceDirac, annihilator_projector
from dirax.geometry.maps import AbstractDiscretizationMap
from dirax.geometry.structures import canonical_two_form
from dirax.geometry.tulczyjew import FiniteDifferenceTriple, slot_derivatives
from dirax.program.compiled import compiled
from dirax.program.user_functions import UserFunction
from dirax.schemes.discrete_lagrangian import discrete_constraint, discrete_forces, discrete_lagrangian
from dirax.schemes.lagrange_dirac import LagrangeDAlembert, MinusLagrangeDirac, PlusLagrangeDirac
from dirax.solution.solution import Solution
from dirax.systems.dirac_system import DiracSystem
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.nonholonomic import as_lagrange_dirac

MAX_ITERATIONS = 50

CHUNK = 4096
"""Rows that go through a function at once."""

Vector = Float[Array, " n"]
Scalar = Float[Array, ""]


class DiscreteSystem(eqx.Module):
    """A Lagrangian system as a discrete Lagrange–d'Alembert scheme sees it: L_d, f_d^± and w_d on Q × Q, [W; ∂g/∂q] on Q,
    and g. The time t is that of q0.

    `sign` is "+" or "-" for the schemes of [PY], None for a general discrete constraint; `share` is the part of the
    constraint force that is taken off the incoming momentum D2 L_d(q_{k−1}, q_k) before it is saved.
    """

    system: LagrangeDirac
    rule: Any
    constraint_rule: Any
    step: Any
    sign: str | None = eqx.field(static=True)
    share: float = eqx.field(static=True, default=0.0)

    @property
    def plain(self) -> bool:
        """Whether the constraints are W v = 0 alone."""
        return self.system.holonomic is None and self.system.affine is None

    def lagrangian(self, t: Any, q0: Vector, q1: Vector, params: Any) -> Scalar:
        """L_d(q0, q1)."""
        ld = discrete_lagrangian(self.system.lagrangian, self.rule)
        return ld(t, q0, (q1 - q0) / self.step, self.step, params)

    def impulses(self, t: Any, q0: Vector, q1: Vector, params: Any) -> tuple[Vector, Vector]:
        """(f_d^−, f_d^+)(q0, q1)."""
        if self.system.forces is None:
            return jnp.zeros_like(q0), jnp.zeros_like(q0)
        return discrete_forces(self.system.forces, self.rule)(t, q0, (q1 - q0) / self.step, self.step, params)

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


def discrete_system(system: Any, scheme: Any, step: Any) -> DiscreteSystem | str:
    """The DiscreteSystem of a scheme on a system, or the reason why there is none."""
    if system is None or scheme is None:
        return "the solution was loaded without its system"
    if not isinstance(scheme, (PlusLagrangeDirac, MinusLagrangeDirac, LagrangeDAlembert)):
        return f"{type(scheme).__name__} has no discrete Lagrangian on Q × Q"
    system = as_lagrange_dirac(system)
    if not isinstance(system, LagrangeDirac):
        return f"the points of a {type(system).__name__} are not those of a Lagrangian on Q × Q"
    rule = scheme.discrete_lagrangian
    if isinstance(scheme, LagrangeDAlembert):
        share = {"incoming": 0.0, "mean": 0.5, "outgoing": 1.0}[scheme.momentum]
        return DiscreteSystem(system, rule, scheme.constraint, step, None, share)
    if isinstance(scheme, PlusLagrangeDirac):
        return DiscreteSystem(system, rule, "right", step, "+")
    return DiscreteSystem(system, rule, "left", step, "-")


def membership_defect(
    discrete: DiscreteSystem,
    t: Any,
    q0: Vector,
    q1: Vector,
    q2: Vector,
    p: Vector,
    multipliers: Float[Array, " m"],
    params: Any,
) -> Float[Array, "3"]:
    """(constraint, force, saved): by how much three points in a row miss the discrete Dirac structure, in roundings, and
    the p and the multipliers saved at the middle one the Legendre momenta and the force of the three points.

    (+) and (−): the element (X^{d±}, d_D^±L_d) at q1 of the induced structure ([PY] Definition 6.7, Proposition 5.17),
    with the Legendre momenta F⁺L_d or F⁻L_d; the constraint is W q̂ of the pair (q0, q1) or (q1, q2). Otherwise
    w_d(q1, q2) = 0 and D2 L_d(q0, q1) + D1 L_d(q1, q2) ∈ Δ°(q1). Δ° is taken from the singular vectors of [W; ∂g/∂q], so
    that Δ = ker W ∩ ker ∂g/∂q; the constraints of a pair (q0, q1) are those of W and g(q1) = 0. Forces add f_d^+ to
    D2 L_d and f_d^− to D1 L_d. `t` is the time of q0.

    Each is divided by the sum of its terms' absolute values and by what it changes when every coordinate is changed by
    itself (its absolute Jacobian times |q| + |Δq| + h): a perfect step that was rounded gives a few 2⁻⁵³.
    """
    h, n = discrete.step, q0.shape[0]
    here = t + h
    (before0, p1), (before1, p2) = discrete.slots(t, q0, q1, params), discrete.slots(here, q1, q2, params)
    matrix = discrete.matrix(here, q1, params)
    first, pair = (t, (q0, q1)) if discrete.sign == "+" else (here, (q1, q2))
    if discrete.sign is None:
        constraint, force = discrete.constraint(first, *pair, params), (p1 + before1) / h
        force = force - discrete.annihilator(here, q1, params) @ force
    else:
        forms = UserFunction(lambda q, params: discrete.matrix(here, q, params), "one_forms", ("q",))
        structure = InducedFiniteDifferenceDirac(forms if matrix.shape[0] else None, step=h, sign=discrete.sign)
        far, of_force = (here, (q1, q2)) if discrete.sign == "+" else (t, (q0, q1))
        ld = lambda a, b: discrete.lagrangian(far, a, b, params)
        _, _, beta, gamma = FiniteDifferenceTriple(step=h, sign=discrete.sign).dirac_differential(ld, q0, q1, q2)
        beta = beta - sum(discrete.impulses(far, *of_force, params)) / h
        momenta = (p1, p2) if discrete.sign == "+" else (-before0, -before1)
        constraint, second_order, force = structure.membership_defect(*pair, momenta, beta, gamma, params)
        constraint = constraint if discrete.plain else discrete.constraint(first, *pair, params)
        force = jnp.concatenate([second_order, force])

    jump = p1 + before1
    of_jump = jnp.linalg.pinv(matrix).T @ jump if matrix.shape[0] else jnp.zeros(0)
    taken = p - p1 + discrete.share * jump
    if discrete.system.holonomic is not None:
        m = discrete.system.constraint_matrix(q1, params, here).shape[0]
        taken = p - p1 + discrete.share * (matrix[:m].T @ multipliers[:m])
        taken = taken - annihilator_projector(matrix[m:]) @ taken  # p is projected along the image of (∂g/∂q)ᵀ
    saved = jnp.concatenate([taken, jump - matrix.T @ multipliers])

    def force_of(z):
        a, b, c = jnp.split(z, 3)
        return discrete.slots(t, a, b, params)[1] + discrete.slots(here, b, c, params)[0]

    def reaction_of(q):
        return discrete.matrix(here, q, params).T @ of_jump

    def constraint_of(z):
        a, b, c = jnp.split(z, 3)
        return discrete.constraint(first, *((a, b) if discrete.sign == "+" else (b, c)), params)

    z = jnp.concatenate([q0, q1, q2])
    moved = jnp.maximum(jnp.abs(q1 - q0), jnp.abs(q2 - q1)) + h
    size = jnp.abs(z) + jnp.tile(moved, 3)
    terms = jnp.abs(p1) + jnp.abs(p2) + jnp.abs(before0) + jnp.abs(before1)
    force_scale = terms + jnp.abs(jax.jacfwd(force_of)(z)) @ size + jnp.abs(jax.jacfwd(reaction_of)(q1)) @ size[n : 2 * n]
    largest = nonzero(jnp.max(force_scale))
    relative_force, relative_saved = jnp.max(jnp.abs(force)) * h / largest, jnp.max(jnp.abs(saved)) / largest
    if constraint.shape[0] == 0:
        return jnp.stack([jnp.zeros(()), relative_force, relative_saved])
    constraint_scale = jnp.abs(jax.jacfwd(constraint_of)(z)) @ size
    return jnp.stack([jnp.max(jnp.abs(constraint) / nonzero(constraint_scale)), relative_force, relative_saved])


def discretization_defect(
    system: DiracSystem, map: AbstractDiscretizationMap, h, x0, x1, multipliers, params
) -> Float[Array, "1"]:
    """By how much a pair misses the discretization-map Dirac structure ([BLM] Definition 5.1) with α = dH − Gᵀλ, in
    roundings, λ the multipliers of holonomic constraints.

    F v + E α at the base point, v = R_d⁻¹(x0, x1)/h, tangent to the manifold of the map; relative to |F||v| + |E||α| and
    to what it changes when every coordinate is changed by itself.
    """
    structure = DiscretizationMapDirac(system.structure, map, h)
    manifold = map.manifold(x0.shape[0])

    def covector(x):
        return system.differential(x, params) - system.holonomic_matrix(x, params).T @ multipliers

    def defect(z):
        a, b = jnp.split(z, 2)
        x, _ = structure.velocity(a, b)
        missed = structure.membership_defect(a, b, covector(x), params)
        return manifold.projection(x, jnp.asarray(missed))

    z = jnp.concatenate([x0, x1])
    x, v = structure.velocity(x0, x1)
    F, E = system.structure.kernel(x, params)
    terms = jnp.abs(F) @ jnp.abs(v) + jnp.abs(E) @ jnp.abs(covector(x))
    size = jnp.abs(z) + jnp.tile(jnp.abs(x1 - x0) + h, 2)
    scale = jnp.max(terms) + jnp.max(jnp.abs(jax.jacfwd(defect)(z)) @ size)
    return jnp.max(jnp.abs(defect(z)))[None] / nonzero(scale)


class DifferentiatedStep(NamedTuple):
    """A step with its derivative ∂(new state)/∂(state), and how well its equations are conditioned (≥ 1)."""

    state: Float[Array, " s"]
    jacobian: Float[Array, "s s"]
    condition: Scalar


def differentiated_step(equation: Any, state, guess, t, h, params) -> DifferentiatedStep:
    """One step solved by the engine's Newton method, differentiated by the implicit function theorem; NaN where it fails.

    With r(u, x) = 0 and x' = a(u, x) of each stage, ∂x'/∂x = ∂_x a − ∂_u a (∂_u r)⁻¹ ∂_x r.
    """
    lane = first_lane(state, (guess,) * len(equation.stages))
    after, unknowns = take_step(equation, lane, t, h, params, MAX_ITERATIONS, differentiable=False)
    jacobian, condition = jnp.eye(state.shape[0]), jnp.ones(())
    for (stage, fraction), u in zip(equation.stages, unknowns, strict=True):

        def both(u, x, stage=stage, at=(t, fraction * h, params)):
            return stage.residual(u, x, *at), stage.advance(u, x, *at)

        (residual_u, residual_x), (advance_u, advance_x) = jax.jacfwd(both, argnums=(0, 1))(u, state)
        if stage.unknowns:
            advance_x = advance_x - advance_u @ jnp.linalg.solve(residual_u, residual_x)
            condition = jnp.maximum(condition, equilibrated_condition(residual_u))
        jacobian = advance_x @ jacobian
        state = stage.advance(u, state, t, fraction * h, params)
        t = t + fraction * h
    good = after.completed > 0
    return DifferentiatedStep(jnp.where(good, state, jnp.nan), jnp.where(good, jacobian, jnp.nan), condition)


def equilibrated_condition(matrix: Float[Array, "k k"]) -> Scalar:
    """The condition number of a matrix after scaling its rows and columns to unit size."""
    for _ in range(3):
        matrix = matrix / nonzero(jnp.max(jnp.abs(matrix), axis=1, keepdims=True))
        matrix = matrix / nonzero(jnp.max(jnp.abs(matrix), axis=0, keepdims=True))
    values = jnp.linalg.svd(matrix, compute_uv=False)
    return values[0] / values[-1]


def symplecticity_defect(system: Any, equation: Any, h, data: dict, t, params) -> Float[Array, "2"]:
    """(‖JᵀΩJ − Ω‖ relative to ‖|J|ᵀ|Ω||J|‖, condition number) of the step from saved data, J = ∂(q', p')/∂(q, p).

    Entries are the largest ones after q and p were brought to balanced units, q → q√s, p → p/√s.
    """
    stage, fraction = equation.stages[0]
    data = {**data, "t": t}
    state, guess = stage.start({**system.complete(data, params, False), "t": t}, fraction * h, params)
    _, jacobian, condition = differentiated_step(equation, state, guess, t, h, params)
    n = state.shape[0] // 2
    form = canonical_two_form(n)
    by_momentum, by_position = jnp.max(jnp.abs(jacobian[:n, n:])), jnp.max(jnp.abs(jacobian[n:, :n]))
    both = (by_momentum > 0) & (by_position > 0)
    unit = jnp.where(both, (nonzero(by_position) / nonzero(by_momentum)) ** 0.25, 1.0)
    units = jnp.concatenate([jnp.full(n, unit), jnp.full(n, 1 / unit)])
    jacobian = jacobian * units[:, None] / units[None, :]
    defect = jnp.max(jnp.abs(jacobian.T @ form @ jacobian - form))
    size = jnp.max(jnp.abs(jacobian).T @ jnp.abs(form) @ jnp.abs(jacobian))
    return jnp.stack([defect / size, condition])


def poisson_defect(system: Any, equation: Any, h, data: dict, t, params) -> Float[Array, "2"]:
    """(‖JΛJᵀ − Λ∘Φ‖ relative to ‖|J||Λ||J|ᵀ‖, condition number) of the step Φ from saved points x of a Lie–Poisson space."""
    stage, fraction = equation.stages[0]
    state, guess = stage.start(system.complete(data, params, False), fraction * h, params)
    after, jacobian, condition = differentiated_step(equation, state, guess, t, h, params)
    n = system.space.size
    jacobian, before = jacobian[:n, :n], system.space.bivector(state[:n])
    defect = jnp.max(jnp.abs(jacobian @ before @ jacobian.T - system.space.bivector(after[:n])))
    size = jnp.max(jnp.abs(jacobian) @ jnp.abs(before) @ jnp.abs(jacobian).T)
    return jnp.stack([defect / nonzero(size), condition])


def structural_defect(discrete: DiscreteSystem, equation: Any, q0: Vector, q1: Vector, t, params) -> Float[Array, "3"]:
    """(defect of φ*Ω = Ω + dβ, ‖φ*Ω − Ω‖, both relative; condition number) at a pair (q0, q1) with w_d(q0, q1) = 0.

    φ(q0, q1) = (q1, q2) is the discrete Lagrange–d'Alembert map, Ω = −d(−D1 L_d dq0) = F⁻L_d*(dq ∧ dp), and
    β = ⟨F, dq1⟩ with F the part in Δ°(q1) of D2 L_d(q0, q1) + D1 L_d(q1, q2) ([PY] §3.2). There β_d is printed as a
    pull-back from the first point of the pair; the variation (11) puts the force at q1, the first point of φ(q0, q1), and
    only this makes the relation true. Both sides are restricted to the vectors tangent to {w_d = 0}, or {w_d = 0, g(q0) = 0,
    g(q1) = 0}, where dβ has no part from holonomic constraints: without others φ is symplectic. `t` is the time of q1.
    """
    n, h = q0.shape[0], discrete.step
    d1 = lambda t, a, b: discrete.slots(t, a, b, params)[0]
    d2 = lambda t, a, b: discrete.slots(t, a, b, params)[1]
    m = equation.stages[0][0].unknowns - n
    guess = jnp.concatenate([(q1 - q0) / h, jnp.zeros(m)])

    def state_of(z):
        return jnp.concatenate([z[n:], d2(t - h, z[:n], z[n:])])

    def force(z, c):
        return discrete.annihilator(t, z[n:], params) @ (d2(t - h, z[:n], z[n:]) + d1(t, z[n:], c))

    def lagrangian_two_form(t, z):
        """−dΘ of Θ = −D1 L_d dq0: dq0 ∧ dq1 with the coefficients −D1 D2 L_d, and nothing else (D1 D1 L_d is symmetric)."""
        mixed = -jax.jacfwd(lambda b: d1(t, z[:n], b))(z[n:])  # ∂p0_i/∂q1_j
        zero = jnp.zeros((n, n))
        return jnp.block([[zero, mixed], [-mixed.T, zero]])

    z = jnp.concatenate([q0, q1])
    state, of_pair = state_of(z), jax.jacfwd(state_of)(z)
    after, of_state, condition = differentiated_step(equation, state, guess, t, h, params)
    q2, q2_of_pair = after[:n], of_state[:n] @ of_pair
    jacobian = jnp.concatenate([jnp.eye(2 * n)[n:], q2_of_pair])  # of φ
    force_z, force_q2 = jax.jacfwd(force, argnums=(0, 1))(z, q2)
    beta = jnp.concatenate([jnp.zeros((n, 2 * n)), force_z + force_q2 @ q2_of_pair])  # ∂_j β_i
    two_form, two_form_after = lagrangian_two_form(t - h, z), lagrangian_two_form(t, jnp.concatenate([q1, q2]))
    change = jacobian.T @ two_form_after @ jacobian - two_form
    dbeta = beta.T - beta  # (dβ)_ij = ∂_i β_j − ∂_j β_i

    def constraints_of_pair(z):
        first = discrete.system.constraints.position_defect(t - h, z[:n], params)
        return jnp.concatenate([discrete.constraint(t - h, z[:n], z[n:], params), first])

    constraint_matrix = jax.jacfwd(constraints_of_pair)(z)
    constraint_matrix = constraint_matrix / nonzero(jnp.max(jnp.abs(constraint_matrix), axis=1, keepdims=True))
    _, values, right = jnp.linalg.svd(constraint_matrix, full_matrices=True)
    kept = jnp.concatenate([values > 1e-10 * values[0], jnp.zeros(right.shape[0] - values.shape[0], bool)])
    tangent = jnp.where(kept, 0.0, right.T)  # without the normal vectors, as many as there are independent constraints
    restricted = lambda form: jnp.max(jnp.abs(tangent.T @ form @ tangent))
    size = jnp.max(jnp.abs(jacobian).T @ jnp.abs(two_form_after) @ jnp.abs(jacobian)) + jnp.max(jnp.abs(beta))
    return jnp.stack([restricted(change - dbeta) / size, restricted(change) / size, condition])


def over_rows(function: Callable, sol: Solution, items: tuple) -> np.ndarray:
    """function(*item, params) for every row of `items`, whose leaves have the shape (rows, …) or (B, rows, …).

    The result is (B, rows, …), with B = 1 for one trajectory. Rows go through in pieces, so that memory stays bounded;
    an `eqx.Partial` of a function of the module is compiled once.
    """
    if sol.batch is None:
        items = jax.tree.map(lambda a: a[None], items)
    rows = jax.tree.leaves(items)[0].shape[1]
    size = max(1, CHUNK // (sol.batch or 1)) if rows * (sol.batch or 1) > CHUNK else rows
    axis = 0 if sol.batch_params and sol.params is not None else None
    found = []
    for start in range(0, rows, size):
        numbers = np.minimum(np.arange(start, start + size), rows - 1)  # the last piece repeats its last row
        piece = jax.tree.map(lambda a, numbers=numbers: jnp.asarray(a[:, numbers]), items)
        found.append(np.asarray(_piece(function, piece, sol.params, axis))[:, : rows - start])
    return np.concatenate(found, axis=1)


@compiled
def _piece(function, items, params, axis):
    lane = jax.vmap(lambda item, params: function(*item, params), in_axes=(0, None))
    return jax.vmap(lane, in_axes=(0, axis))(items, params)


def nonzero(values):
    """The values, with 1 in the place of 0, to divide by."""
    return jnp.where(values > 0, values, 1.0)
