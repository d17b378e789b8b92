"""Explicit splittings of q̈ = F(q): schemes of order 6 stated from outside, for what a batch costs at small accuracy.

For L = v·v/2 − V(q), a step is a row of drifts q += a_i h p and kicks p += b_i h F(q) whose coefficients make use of
V being a function of q alone (Blanes, Moan, "Practical symplectic partitioned Runge–Kutta and Runge–Kutta–Nyström methods",
J. Comput. Appl. Math. 142, 2002): far smaller errors for the same number of forces than compositions of Störmer–Verlet.
"""

from typing import Any

import jax
import jax.numpy as jnp

import dirax as dx


class Splitting(dx.AbstractScheme):
    """b_1 a_1 b_2 … a_1 b_1, or a first, symmetric; of a unit mass matrix."""

    kicks: tuple[float, ...]
    drifts: tuple[float, ...]
    kick_first: bool = True

    def adjoint(self, system: Any) -> "Splitting":
        """The scheme itself."""
        return self

    def step_equation(self, system: Any, shape: Any) -> dx.StepEquation:
        n = shape.n
        state = dx.Layout(q=n, p=n)

        def advance(u, x, t, h, params):
            force = jax.grad(lambda q: system.lagrangian.at(t, q, jnp.zeros(n), params))
            (q, p), kicks, drifts = state.split(x), [*self.kicks], [*self.drifts]
            for i in range(len(kicks) + len(drifts)):
                if self.kick_first == (i % 2 == 0):
                    p = p + h * kicks.pop(0) * force(q)
                else:
                    q = q + h * drifts.pop(0) * p
            return state.join(q=q, p=p)

        return dx.StepEquation(
            start=lambda data, h, params: (state.join(q=data["q"], p=data["p"]), jnp.zeros(0)),
            residual=lambda u, x, t, h, params: jnp.zeros(0),
            advance=advance,
            unpack=lambda x, u, t, h, params: {"q": state.split(x).q, "p": state.split(x).p},
            state_layout=state,
            unknowns=0,
            fields={"q": dx.Field((n,)), "p": dx.Field((n,))},
            canonical=True,
        )


def _mirrored(half: tuple[float, ...], whole: float) -> tuple[float, ...]:
    """Followed by what makes the sum `whole`, in the middle, and by themselves backwards."""
    return (*half, whole - 2 * sum(half), *reversed(half))


def _even(half: tuple[float, ...]) -> tuple[float, ...]:
    """Followed by what makes the sum ½, and all of it backwards."""
    full = (*half, 0.5 - sum(half))
    return (*full, *reversed(full))


ELEVEN = Splitting(
    kicks=_even((0.0414649985182624, 0.198128671918067, -0.0400061921041533, 0.0752539843015807, -0.0115113874206879)),
    drifts=_mirrored((0.123229775946271, 0.290553797799558, -0.127049212625417, -0.246331761062075, 0.357208872795928), 1.0),
)
"""Order 6, eleven forces a step."""

FOURTEEN = Splitting(
    kicks=_even(
        (0.09171915262446165, 0.183983170005006, -0.05653436583288827, 0.004914688774712854, 0.143761127168358, 0.328567693746804)
    ),
    drifts=_mirrored(
        (
            *(0.0378593198406116, 0.102635633102435, -0.0258678882665587, 0.314241403071447),
            *(-0.130144459517415, 0.106417700369543, -0.00879424312851058),
        ),
        1.0,
    ),
    kick_first=False,
)
"""Order 6, fourteen forces a step."""
