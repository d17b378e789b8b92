"""The theorems of [BLM], measured on a rigid body, ports, vortices and a pendulum, by formulas in NumPy."""

import itertools

import jax.numpy as jnp
import numpy as np

from dirax.gallery.theorem_numbers import gradient, kernel, largest, projector
from dirax.gallery.theorems import Theorem

STEP = 0.05


def theorems() -> list[Theorem]:
    """All rows."""
    return [*_linear(), _lift(), _projected(), _rigid_body(), *_phase_space(), *_ports(), _pendulum()]


def _linear() -> list[Theorem]:
    """D_{F,ω} and D_{Λ,F*} by their definitions: the covectors that agree on F, the vectors that agree on F*."""
    from dirax.geometry.linear import LinearDirac

    basis, form = np.random.default_rng(1).normal(size=(5, 3)), np.random.default_rng(2).normal(size=(5, 5))
    form, rest, zero = form - form.T, kernel(basis.T), np.zeros((5, 2))
    ours = np.block([[basis, zero], [form.T @ basis, rest]])
    dual = np.block([[form @ basis, rest], [basis, zero]])
    sets = LinearDirac.from_subspace_and_form(basis, form), LinearDirac.from_codistribution_and_bivector(basis, form)
    apart = [
        largest(projector(by_hand) - projector(np.concatenate([np.asarray(a) for a in found.image()])))
        for by_hand, found in zip((ours, dual), sets, strict=True)
    ]
    return [Theorem("Theorem 2.4", "D_{F,ω}", apart[0]), Theorem("Theorem 2.5", "D_{Λ,F*}", apart[1])]


def _lift() -> Theorem:
    """The lift of the θ map by its formula, and the two symplectic forms on T(T*Q) by its matrix."""
    from dirax.geometry.cotangent_lift import cotangent_lift
    from dirax.geometry.maps import Theta

    theta, one, zero = 0.3, np.eye(2), np.zeros((2, 2))
    # (q, p, q̇, ṗ) ↦ (q0, p0, q1, p1)
    matrix = np.block([
        [one, zero, -theta * one, zero], [zero, one, zero, -(1 - theta) * one],
        [one, zero, (1 - theta) * one, zero], [zero, one, zero, theta * one],
    ])  # fmt: skip
    omega = np.kron([[0, 1], [-1, 0]], one)
    ends = np.block([[-omega, np.zeros((4, 4))], [np.zeros((4, 4)), omega]])
    tangent = np.block([[np.zeros((4, 4)), omega], [omega, np.zeros((4, 4))]])  # dq ∧ dṗ + dq̇ ∧ dp
    z = np.random.default_rng(3).normal(size=8)
    found = np.concatenate([np.asarray(a) for a in cotangent_lift(Theta(theta))(jnp.asarray(z[:4]), jnp.asarray(z[4:]))])
    off = max(largest(matrix @ z - found), largest(matrix.T @ ends @ matrix - tangent))
    return Theorem("Proposition 4.11", "the cotangent lift is symplectic", off)


def _projected() -> Theorem:
    """(P × P) ∘ R_d on the sphere by its formula; D(R_d²) − D(R_d¹) = id at rest, by complex steps."""
    from dirax.geometry.maps import Midpoint
    from dirax.geometry.projected_map import ProjectedMap

    unit = lambda x: x / np.sqrt(x @ x)
    by_hand = lambda x, v: (unit(x - v / 2), unit(x + v / 2))
    x, v = np.array([0.6, 0.0, 0.8]), np.array([0.2, 0.3, -0.15])
    found = ProjectedMap(Midpoint(), lambda x: x / jnp.sqrt(x @ x))(jnp.asarray(x), jnp.asarray(v))
    off = max(largest(np.asarray(a) - b) for a, b in zip(found, by_hand(x, v), strict=True))
    rate = gradient(lambda v: by_hand(x, v)[1] - by_hand(x, v)[0], np.zeros(3)) @ v
    return Theorem("Proposition 7.3", "a projected map is a discretization map", max(off, largest(rate - v)))


def _rigid_body() -> Theorem:
    """Definition 5.1 for so(3) with the sphere's map: (ξ1 − ξ0)/h = ξ̄ × I⁻¹((ξ0 + ξ1)/‖ξ0 + ξ1‖), ξ̄ their mean (4)."""
    from dirax.geometry.maps import SphereProjection
    from dirax.geometry.structures import DiracStructure
    from dirax.run.simulate import simulate
    from dirax.schemes.discrete_dirac import DiscreteDirac
    from dirax.systems.dirac_system import DiracSystem

    inertia = np.array([1.0, 2.0, 3.0])
    spin = DiracStructure.from_bivector(lambda x: jnp.cross(x, jnp.eye(3), axisb=0, axisc=0))
    system = DiracSystem(spin, lambda x: x @ (x / jnp.asarray(inertia)) / 2)
    x = np.asarray(simulate(system, DiscreteDirac(SphereProjection()), x=[0.6, 0.0, 0.8], step=STEP, steps=50).x)

    def missed(x):
        mean, total = (x[:-1] + x[1:]) / 2, x[:-1] + x[1:]
        base = total / np.linalg.norm(total, axis=1, keepdims=True)
        return largest(np.diff(x, axis=0) / STEP - np.cross(mean, base / inertia))

    return Theorem("Definition 5.1, (4)", "the discrete rigid body on the sphere", missed(x), missed(x + 1e-6 * np.sin(9 * x)))


def _phase_space() -> list[Theorem]:
    """L = ⟨α(q), q̇⟩ − H(q) with constant dα, two degrees of freedom: Method 2 is the midpoint rule (14) and preserves dα."""
    from dirax.run.simulate import simulate
    from dirax.schemes.discrete_dirac import DiscreteDirac
    from dirax.systems.phase_space import PhaseSpaceLagrangian

    form = np.array([[0.0, 1.0, 0.5, 0.0], [-1.0, 0.0, 0.0, 0.2], [-0.5, 0.0, 0.0, 2.0], [0.0, -0.2, -2.0, 0.0]])
    weights = np.array([1.0, 2.0, 0.5, 1.5])
    energy = lambda q: weights @ q**2 / 2 + q[0] ** 2 * q[2] ** 2 / 4
    slope = lambda q: weights * q + np.array([q[0] * q[2] ** 2, 0.0, q[0] ** 2 * q[2], 0.0]) / 2
    system = PhaseSpaceLagrangian(lambda q: jnp.asarray(form) @ q / 2, lambda q: energy(q))
    q = np.asarray(simulate(system, DiscreteDirac(constraints="resolve"), q=[0.5, 0.2, -0.4, 0.3], step=STEP, steps=50).q)
    # (∂_jα_i − ∂_iα_j) q̇ʲ = −∂_iH with ∂_jα_i = form_ij/2
    field = lambda q: -np.linalg.solve(form, slope(q))
    off = max(largest((b - a) / STEP - field((a + b) / 2)) for a, b in itertools.pairwise(q))
    mean = (q[7] + q[8]) / 2
    hessian = gradient(lambda q: weights * q + np.array([q[0] * q[2] ** 2, 0, q[0] ** 2 * q[2], 0]) / 2, mean)
    rate = -np.linalg.solve(form, hessian)
    change = lambda theta: np.linalg.solve(np.eye(4) - (1 - theta) * STEP * rate, np.eye(4) + theta * STEP * rate)
    kept = lambda theta: largest(change(theta).T @ form @ change(theta) - form)
    return [
        Theorem("(14)", "Method 2 is the midpoint rule on M_f", off),
        Theorem("Proposition 6.3, Remark 6.4", "it preserves dα, and θ ≠ ½ does not", kept(0.5), kept(0.25)),
    ]


def _ports() -> list[Theorem]:
    """Proposition 7.1 by null spaces, and the balance of power of §7.1."""
    from dirax.run.simulate import simulate
    from dirax.schemes.discrete_dirac import DiscreteDirac
    from dirax.systems.port_hamiltonian import PortHamiltonian

    random = np.random.default_rng(4)
    J, B = random.normal(size=(4, 4)), random.normal(size=(4, 1))
    J, x = J - J.T, jnp.asarray(random.normal(size=4))
    free, zero = kernel(B.T), np.zeros((4, 1))
    energy = lambda x: x @ x / 2 + x[0] ** 4
    opened, closed = (PortHamiltonian(energy, J, B, closed=shut) for shut in (False, True))
    ours, orthogonal = np.block([[J, B], [np.eye(4), zero]]), np.concatenate([J @ free, free])
    theirs = opened.dirac_structure(x)
    subspace = lambda found: projector(np.concatenate([np.asarray(a) for a in found.image()]))
    coisotropic = max(
        largest(projector(ours) - subspace(theirs)),
        largest(projector(orthogonal) - subspace(theirs.orthogonal())),
        largest((np.eye(8) - projector(ours)) @ orthogonal),
    )
    printed = largest(projector(np.concatenate([J, np.eye(4)])) - subspace(theirs.orthogonal()))
    shut = np.block([[J @ free, B], [free, zero]])
    dirac = max(
        largest(projector(shut) - subspace(closed.dirac_structure(x))), largest(shut[:4].T @ shut[4:] + shut[4:].T @ shut[:4])
    )
    driven = opened.with_inputs(lambda t, x: jnp.cos(3 * t)[None])
    sol = simulate(driven, DiscreteDirac(), x=np.full(4, 0.3), step=STEP, steps=50)
    rows, t = np.asarray(sol.x), np.asarray(sol.t)
    mean, moved = (rows[:-1] + rows[1:]) / 2, np.diff(rows, axis=0)
    slope = mean + 4 * np.where(np.arange(4) == 0, mean, 0.0) ** 3
    supplied = STEP * np.cos(3 * (t[:-1] + STEP / 2)) * (slope @ B)[:, 0]
    return [
        Theorem("Proposition 7.1, (22)", "open: coisotropic, D^⊥ with Bᵀα = 0 (printed: all α)", coisotropic, printed),
        Theorem("Proposition 7.1, (23)", "closed: Dirac", dirac),
        Theorem("§7.1", "h⟨ȳ, ū⟩ = ⟨dH(x̄), Δx⟩", largest(np.sum(slope * moved, axis=1) - supplied)),
    ]


def _pendulum() -> Theorem:
    """The chain of the pendulum in the plane with its tension λ as a coordinate: M_f, and the field on it, by hand."""
    from dirax.systems.constraint_algorithm import constraint_algorithm
    from dirax.systems.lagrange_dirac import LagrangeDirac

    system = LagrangeDirac(lambda q, v: v[:2] @ v[:2] / 2 - q[1] + q[2] * (q[:2] @ q[:2] - 1))
    chain = constraint_algorithm(system, near={"q": [0.6, -0.8, 0.0], "v": [0.3, 0.2, 0.0]})
    value = dict(zip(chain.coordinates, np.asarray(chain.point), strict=True))
    rate = dict(zip(chain.coordinates, np.asarray(chain.field(jnp.asarray(chain.point))), strict=True))
    names = list(chain.coordinates)
    q, v = (np.array([value[name] for name in names[i : i + 2]]) for i in (0, 3))
    tension = value[names[2]]
    # |q|² = 1, q·v = 0, |v|² + q·a = 0 with a = (0, −1) + 2λq
    force = np.array([0.0, -1.0]) + 2 * tension * q
    off = [q @ q - 1, q @ v, v @ v + q @ force]
    off += [*(np.array([rate[name] for name in names[:2]]) - v), *(np.array([rate[name] for name in names[3:5]]) - force)]
    return Theorem("§3", "the constraint algorithm finds M_f and its field", largest(off))
