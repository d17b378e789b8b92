"""The theorems of [RL], measured on a system with two cyclic coordinates, by formulas in NumPy."""

import itertools

import jax.numpy as jnp
import numpy as np

from dirax.gallery.theorem_numbers import derivative, gradient, largest
from dirax.gallery.theorems import Theorem

STEP, STEPS = 0.05, 40
A = np.array([[0.3, -0.2], [0.5, 0.4]])
"""q = (x0, x1, g0, g1), h_d(q0, x1) = g0 + A (x1 − x0)."""


def lagrangian(q, v, xp=np):
    """Free of q2 and q3."""
    kinetic = (v @ v + (v[2] + xp.sin(q[0]) * v[1]) ** 2 + v[3] * v[0] * xp.cos(q[1])) / 2
    return kinetic - xp.cos(q[0] - q[1])


def discrete_lagrangian(q0, q1):
    """h L at the midpoint."""
    return STEP * lagrangian((q0 + q1) / 2, (q1 - q0) / STEP)


def slots(q0, q1) -> tuple[np.ndarray, np.ndarray]:
    """(D1 L_d, D2 L_d)."""
    return gradient(lambda a: discrete_lagrangian(a, q1), q0), gradient(lambda b: discrete_lagrangian(q0, b), q1)


def theorems() -> list[Theorem]:
    """All rows."""
    from dirax.reduction.connection import LinearConnection
    from dirax.reduction.reduce import reduce
    from dirax.run.simulate import simulate
    from dirax.schemes.lagrange_dirac import MinusLagrangeDirac, PlusLagrangeDirac
    from dirax.solution.reconstruction import reconstruct
    from dirax.systems.lagrange_dirac import LagrangeDirac

    system = LagrangeDirac(lambda q, v: lagrangian(q, v, jnp))
    quotient = reduce(system, LinearConnection([2, 3], A))
    staged = reduce(reduce(system, LinearConnection([3])), LinearConnection([2]))
    start = {"q": [0.2, 0.5, 0.1, -0.3], "v": [0.4, -0.3, 0.5, 0.2], "step": STEP, "steps": STEPS}
    found = []
    for sign, scheme in (("+", PlusLagrangeDirac("midpoint")), ("−", MinusLagrangeDirac("midpoint"))):
        whole, reduced = simulate(system, scheme, **start), simulate(quotient, scheme, **start)
        found += _whole(sign, np.asarray(whole.q))
        rows = {name: np.asarray(reduced.fields[name]) for name in ("x", "w", "mu", "g")}
        lifted = np.asarray(reconstruct(reduced).q)
        found.append(Theorem(f"§4 ({sign})", "reduced and reconstructed is unreduced", largest(lifted - np.asarray(whole.q))))
        found += _reduced(sign, rows)
    once = simulate(reduce(system, LinearConnection([3, 2])), PlusLagrangeDirac("midpoint"), **start)
    twice = simulate(staged, PlusLagrangeDirac("midpoint"), **start)
    apart = max(largest(np.asarray(once.fields[n]) - np.asarray(twice.fields[n])) for n in ("x", "w", "mu", "g"))
    return [*found, Theorem("future work", "reduction by stages is that by the product", apart)]


def _whole(sign: str, q: np.ndarray) -> list[Theorem]:
    """Theorems 2.9 and 2.10 by complex steps of the action in all of q, v and p; and the momentum map."""
    d1, d2 = (np.array(a) for a in zip(*(slots(a, b) for a, b in itertools.pairwise(q)), strict=True))
    plus = sign == "+"
    other, p = (q[1:], d2) if plus else (q[:-1], -d1)  # (q⁺, p_{k+1}) or (q⁻, p_k)

    def action(z):
        nodes, moved, p = z
        pairs = zip(nodes[:-1], moved, strict=True) if plus else zip(moved, nodes[1:], strict=True)
        total = sum(discrete_lagrangian(a, b) for a, b in pairs)
        # for (−) the stationary value of p_k is D1 L_d, the momentum with the other sign
        return total + (np.sum(p * (nodes[1:] - moved)) if plus else np.sum(-p * (nodes[:-1] - moved)))

    def missed(q):
        waves = [np.sin(np.arange(a.size) * c).reshape(a.shape) for a, c in ((q, 1.0), (other, 2.0), (p, 3.0))]
        waves[0][[0, -1]] = 0.0
        step = 1e-30
        moved = action([a + 1j * step * b for a, b in zip((q, other, p), waves, strict=True)])
        return abs(np.imag(moved) / step) / (len(q) * largest(p))

    wrong = q + 1e-3 * np.sin(np.arange(q.size).reshape(q.shape))
    number = "2.9" if plus else "2.10"
    matched = largest(d2[:-1] + d1[1:]) / largest(d2)
    return [
        Theorem(f"Theorem {number}", "the Lagrange–Pontryagin action is stationary", missed(q), missed(wrong)),
        Theorem(f"(2.9), ({sign})", "discrete Euler–Lagrange equations", matched),
        Theorem(f"Lemma 2.2 ({sign})", "the momentum map is conserved", largest(np.ptp(d2[:, 2:], axis=0)) / largest(d2)),
    ]


def _reduced(sign: str, rows: dict[str, np.ndarray]) -> list[Theorem]:
    """Propositions 3.8 and 3.10 with 4.3 and 4.4, and Theorems 5.5 and 5.9 by complex steps."""
    x, g, plus = rows["x"], rows["g"], sign == "+"
    q = np.concatenate([x, g], axis=1)

    def reduced_lagrangian(x0, x1, vertical):
        zero = np.zeros(2)
        if plus:
            return discrete_lagrangian(np.concatenate([x0, zero]), np.concatenate([x1, vertical + A @ (x1 - x0)]))
        return discrete_lagrangian(np.concatenate([x0, -vertical - A @ (x1 - x0)]), np.concatenate([x1, zero]))

    def action(z):
        x, g = z[:, :2], z[:, 2:]
        vertical = np.diff(g, axis=0) - np.diff(x, axis=0) @ A.T
        return sum(reduced_lagrangian(*step) for step in zip(x[:-1], x[1:], vertical, strict=True))

    varied = np.sin(np.arange(q.size) * 1.7).reshape(q.shape)
    varied[[0, -1]] = 0.0
    size = len(q) * largest(slots(q[0], q[1])[1])
    wrong = q + 1e-3 * np.sin(np.arange(q.size).reshape(q.shape))
    principle = [abs(derivative(action, at, varied)) / size for at in (q, wrong)]

    def structure(w, mu):
        """Both sides of (pair, covector) ∈ [D̂^{d±}] that are not equal by their names: momenta of both points, w and p."""
        worst = 0.0
        for k in range(len(q) - 1):
            d1, d2 = slots(q[k], q[k + 1])
            for own, at, p in ((w[k], mu[k], -d1), (w[k + 1], mu[k + 1], d2)):
                worst = max(worst, largest(own - (p[:2] + A.T @ p[2:])), largest(at - p[2:]))
        return worst / largest(slots(q[0], q[1])[1])

    numbers = ("3.8, 4.3", "5.5") if plus else ("3.10, 4.4", "5.9")
    off = structure(rows["w"] + 1e-6, rows["mu"])
    return [
        Theorem(f"Propositions {numbers[0]}", f"steps lie in [D̂^{{d{sign}}}]", structure(rows["w"], rows["mu"]), off),
        Theorem(f"Theorem {numbers[1]}", "the reduced action is stationary", *principle),
    ]
