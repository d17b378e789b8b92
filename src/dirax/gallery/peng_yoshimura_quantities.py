"""[PY] §8: what its table and its figures are both made from."""

import jax
import numpy as np

from dirax.schemes.discrete_lagrangian import discrete_lagrangian, slot_derivatives
from dirax.solution.solution import Solution

SIGN = {"+": "(+)", "-": "(−)"}
TEXT_END, AXIS_END = 50, 100
"""Where the disk's runs end: [0, 50] in the text, 100 on the axes of Figures 10–12, 15 and 16."""


def path_energy(sol: Solution) -> np.ndarray:
    """E(q_k, (q_{k+1} − q_k)/h) of the trajectory's steps, (rows − 1,)."""
    q = np.asarray(sol.q)
    along = jax.jit(jax.vmap(lambda q, v: sol.system.energy(q, v, sol.params)))
    return np.asarray(along(q[:-1], np.diff(q, axis=0) / sol.step))


def generalized_energy(sol: Solution, sign: str) -> np.ndarray:
    """The discrete generalized energy of [PY] Def 7.1 at each step, (rows − 1,); it is about h times the energy.

    E⁺ = ⟨p_{k+1}, q_{k+1} − q_k⟩ − L_d with p_{k+1} = D2 L_d, and E⁻ = ⟨p_k, q_{k+1} − q_k⟩ − L_d with p_k = −D1 L_d.
    """
    ld = discrete_lagrangian(sol.system.lagrangian, "left")
    h = sol.step

    def of_step(q, v):
        d1, d2 = slot_derivatives(ld, 0.0, q, v, h, sol.params)
        return h * ((d2 if sign == "+" else -d1) @ v) - ld(0.0, q, v, h, sol.params)

    q = np.asarray(sol.q)
    return np.asarray(jax.jit(jax.vmap(of_step))(q[:-1], np.diff(q, axis=0) / h))
