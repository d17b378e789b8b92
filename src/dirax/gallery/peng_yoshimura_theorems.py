"""The theorems of [PY], measured on a skate with a potential and a mass matrix, by formulas in NumPy."""

import itertools
from typing import Any

import jax.numpy as jnp
import numpy as np

from dirax.gallery.theorem_numbers import derivative, gradient, kernel, largest, projector
from dirax.gallery.theorems import Theorem

STEP, STEPS = 0.05, 40
MASS = np.array([[2.0, 0.3, 0.0], [0.3, 1.5, 0.1], [0.0, 0.1, 1.0]])


def lagrangian(q, v, xp: Any = np):
    """½⟨v, Mv⟩ − cos q0 − q1² q2/2."""
    return v @ (MASS @ v) / 2 - xp.cos(q[0]) - q[1] ** 2 * q[2] / 2


def row(q, xp: Any = np):
    """The one-form of the skate."""
    return xp.stack([xp.sin(q[2]), -xp.cos(q[2]), 0.3 * q[0]])


def discrete_lagrangian(q0, q1):
    """h L(q0, Δq/h), with analytic functions."""
    return STEP * lagrangian(q0, (q1 - q0) / STEP)


def theorems() -> list[Theorem]:
    """All rows."""
    from dirax.run.simulate import simulate
    from dirax.schemes.lagrange_dirac import MinusLagrangeDirac, PlusLagrangeDirac
    from dirax.systems.lagrange_dirac import LagrangeDirac

    forms = lambda q: row(q, jnp)[None]
    system = LagrangeDirac(lambda q, v: lagrangian(q, v, jnp), forms)
    start: dict[str, Any] = {"q": [0.1, 0.2, 0.3], "v": [0.4, 0.1, 0.6], "step": STEP, "steps": STEPS, "project": True}
    found = _structures()
    for sign, scheme in (("+", PlusLagrangeDirac()), ("−", MinusLagrangeDirac())):
        q = np.asarray(simulate(system, scheme, **start).q)
        found += [_equations(sign, q), _principle(sign, q)]
    unconstrained: dict[str, Any] = {**start, "project": False}
    free = simulate(LagrangeDirac(lambda q, v: lagrangian(q, v, jnp)), PlusLagrangeDirac(), **unconstrained)
    return [*found, _symplectic(np.asarray(free.q), np.asarray(free.p))]


def _structures() -> list[Theorem]:
    from dirax.geometry.finite_difference import FiniteDifferenceDirac, InducedFiniteDifferenceDirac
    from dirax.geometry.tulczyjew import FiniteDifferenceTriple

    x, omega = np.array([0.3, -0.2, 0.7, 0.1]), np.array([[0, 1, 2, 0], [-1, 0, 0, 3], [-2, 0, 0, 1], [0, -3, -1, 0.0]])

    def w(x, xp: Any = np):
        return xp.stack([x[1], xp.ones(()), -x[0], xp.sin(x[2])])

    structure = FiniteDifferenceDirac(lambda x: jnp.asarray(omega), lambda x: w(x, jnp)[None], step=STEP).at(jnp.asarray(x))
    free, normal = kernel(w(x)[None]), w(x)[:, None]
    ours = np.concatenate([np.block([free, np.zeros((4, 1))]), np.block([omega.T @ free, normal])])
    theirs = np.concatenate([np.asarray(a) for a in structure.image()])
    pairing = ours[:4].T @ ours[4:]
    apart = max(largest(projector(ours) - projector(theirs)), largest(pairing + pairing.T))
    wrong = np.concatenate([np.eye(4), omega.T])  # the graph of Ω♭ without the distribution
    first = Theorem("Theorem 5.7", "D^{d±} = its orthogonal", apart, largest(projector(wrong) - projector(theirs)))

    q = np.array([0.4, 0.2, 0.3])
    induced = InducedFiniteDifferenceDirac(lambda q: row(q, jnp)[None], step=STEP).at(jnp.asarray(q))
    free, zero = kernel(row(q)[None]), np.zeros((3, 3))
    # (q̂, p̂; β, γ): q̂ = γ ∈ Δ, β + p̂ ∈ Δ°
    columns = [np.concatenate([free, zero[:, :2], zero[:, :2], free]), np.concatenate([zero, np.eye(3), -np.eye(3), zero])]
    ours = np.concatenate([*columns, np.concatenate([zero[:, :1], zero[:, :1], row(q)[:, None], zero[:, :1]])], axis=1)
    theirs = np.concatenate([np.asarray(a) for a in induced.image()])
    second = Theorem("Proposition 5.17", "q̂ = γ ∈ Δ, β + p̂ ∈ Δ°", largest(projector(ours) - projector(theirs)))

    triple, random = FiniteDifferenceTriple(step=STEP), np.random.default_rng(0)
    q0, q1, a0, a1, far = random.normal(size=(5, 3))
    given = np.concatenate([np.asarray(a) for a in triple.gamma(q0, q1, a0, a1, far)])
    by_hand = np.concatenate([q1, a1, -(far - a1) / STEP, (q1 - q0) / STEP])
    third = Theorem("(44), (45)", "γ^{d+} = (Ω^{d+})♭ ∘ (κ^d)⁻¹", largest(given - by_hand) / largest(by_hand))
    return [first, second, third]


def slots(q0, q1) -> tuple[np.ndarray, np.ndarray]:
    """(D1 L_d, D2 L_d)."""
    return gradient(lambda a: discrete_lagrangian(a, q1), q0), gradient(lambda b: discrete_lagrangian(q0, b), q1)


def _equations(sign: str, q: np.ndarray) -> Theorem:
    """(53) and (54) from q alone."""

    def missed(q):
        worst = 0.0
        for a, b, c in zip(q[:-2], q[1:-1], q[2:], strict=True):
            force = slots(a, b)[1] + slots(b, c)[0]
            worst = max(worst, largest(kernel(row(b)[None]).T @ force), abs(row(c if sign == "+" else b) @ (c - b)))
        return worst / largest(slots(q[0], q[1])[0])

    name = f"Definition 6.7 ({sign})"
    return Theorem(name, "the discrete Lagrange–Dirac equations (53), (54)", missed(q), missed(q + 1e-6 * np.sin(q * 9)))


def _principle(sign: str, q: np.ndarray) -> Theorem:
    """The derivative of the action sum along admissible variations, by complex steps."""

    def missed(q):
        varied = np.sin(np.outer(np.arange(len(q)), [1.0, 2.0, 3.0]))
        varied[[0, -1]] = 0.0
        for k in range(1, len(q) - 1):
            free = kernel(row(q[k])[None])
            varied[k] = free @ (free.T @ varied[k])
        total = lambda q: sum(discrete_lagrangian(a, b) for a, b in itertools.pairwise(q))
        return abs(derivative(total, q, varied)) / (len(q) * largest(slots(q[0], q[1])[0]))

    moved = q + 1e-3 * np.sin(np.arange(len(q)))[:, None] * np.array([1.0, -2.0, 1.0])
    return Theorem(f"Theorem 7.4 ({sign})", "the action sum is stationary", missed(q), missed(moved))


def _symplectic(q: np.ndarray, p: np.ndarray) -> Theorem:
    """The map (q, p) ↦ (q', p') of h L(q0, Δq/h), which is explicit, and its derivative by complex steps."""

    def flow(z):
        q, p = z[:3], z[3:]
        force = np.array([np.sin(q[0]), -q[1] * q[2], -(q[1] ** 2) / 2])
        v = np.linalg.solve(MASS.astype(z.dtype), p + STEP * force)
        return np.concatenate([q + STEP * v, MASS @ v])

    z, omega = np.concatenate([q, p], axis=1), np.kron([[0, 1], [-1, 0]], np.eye(3))
    J = gradient(flow, z[3])
    off = max(largest(flow(a) - b) for a, b in itertools.pairwise(z))
    return Theorem("§3.2, W = 0", "the discrete flow is symplectic", max(off, largest(J.T @ omega @ J - omega)))
