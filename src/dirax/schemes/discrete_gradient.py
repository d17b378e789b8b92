"""Discrete gradients: schemes whose energy balance is exact ([BLM] §7; Gonzalez 1996; Harten, Lax, van Leer 1983)."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from dirax.program.tracing import once
from dirax.schemes.constraint_rows import independent_constraints
from dirax.schemes.step import AbstractScheme, Field, Shape, StepEquation
from dirax.systems.dirac_system import DiracSystem
from dirax.systems.port_hamiltonian import PortHamiltonian

KINDS = ("gonzalez", "mean-value")
EPSILON = 2.220446049250313e-16
NOISE = 1e-11
"""How much of dH the correction may be, relative, where it is roundoff of H only. It fades out for steps so short that it
would be more: dividing roundoff by such a step would push a system that comes to rest."""
TINY = 1e-300


class DiscreteGradient(AbstractScheme):
    """ẋ_d = (J − R)(x̄) ∇̄H + B(x̄) ū, ȳ = B(x̄)ᵀ∇̄H, with ẋ_d = (x_{k+1} − x_k)/h and x̄ the midpoint of the step, where

        ⟨∇̄H(x_k, x_{k+1}), x_{k+1} − x_k⟩ = H(x_{k+1}) − H(x_k),

    so that H(x_{k+1}) − H(x_k) = h⟨ȳ, ū⟩ − h⟨∇̄H, R∇̄H⟩ exactly: [BLM] (20) with the midpoint map, whose own balance
    ⟨dH(x̄), ẋ_d⟩ is not the change of H. On a DiracSystem (ẋ_d, ∇̄H) ∈ D(x̄), and H is conserved; with holonomic constraints
    (ẋ_d, ∇̄H − Gᵀλ) ∈ D(x̄) and G(x̄) ẋ_d = 0, as in Method 1. Second order.

    `kind`: "gonzalez", dH(x̄) corrected along the step, or "mean-value", the mean of dH over the step by Gauss–Legendre
    quadrature with `nodes` points, corrected in the same way by what the quadrature leaves. What roundoff takes from the
    balance in one step is given back in the next, so that it does not add up over many.

    Saved with x: `work` (2,), the energy supplied through the ports and the energy dissipated since the start; per step
    `power` (3,), the rates at which energy is stored, supplied and dissipated.
    """

    kind: str
    nodes: int

    def __init__(self, kind: str = "gonzalez", nodes: int = 4):
        if kind not in KINDS:
            raise ValueError(f"kind must be one of {', '.join(map(repr, KINDS))}, but {kind!r} was given.")
        if nodes < 1:
            raise ValueError(f"nodes must be at least 1, but {nodes} was given.")
        self.kind, self.nodes = kind, int(nodes)

    def discrete_structure(self, system: Any, shape: Shape, step: Any) -> str:
        return "the discrete gradient that (x₁ − x₀)/h is paired with in D is not saved; its balance is measured instead"

    def step_equation(self, system: Any, shape: Shape) -> StepEquation:
        if not isinstance(system, PortHamiltonian | DiracSystem):
            raise TypeError(
                "dx.DiscreteGradient takes PortHamiltonian and DiracSystem systems, which have a Hamiltonian of x, but a "
                f"{type(system).__name__} was given."
            )
        return _with_exact_balance(system, shape, *_quadrature(self.kind, self.nodes))


def _quadrature(kind: str, nodes: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Points of the step (0 to 1) and weights of the mean of dH."""
    if kind == "gonzalez":
        return (0.5,), (1.0,)
    points, weights = np.polynomial.legendre.leggauss(nodes)
    return tuple((points + 1) / 2), tuple(weights / 2)


def _with_exact_balance(system: PortHamiltonian | DiracSystem, shape: Shape, points, weights) -> StepEquation:
    """State (x, supplied, dissipated, their lost digits, H(x_0)); unknowns (ẋ_d, u of the closed ports)."""
    n = shape.n
    system, m, all_of_them = independent_constraints(system, shape)
    ported = system if isinstance(system, PortHamiltonian) else None

    def account(state):
        """What H has to be at x by the books: H(x_0) + supplied − dissipated, in two parts."""
        supplied, dissipated, lost_supplied, lost_dissipated, first = state[n:]
        return first, (supplied - dissipated) + (lost_supplied - lost_dissipated)

    def discrete_gradient(u, state, h, params):
        return once(whole_gradient)(u, state, h, params)

    def whole_gradient(u, state, h, params):
        """∇̄H, with ⟨∇̄H, Δx⟩ = H(x + Δx) − account, and x̄."""
        x, change = state[:n], h * u[:n]
        at = lambda s: system.differential(x + s * change, params)
        gradient = jnp.stack([w * at(s) for s, w in zip(points, weights, strict=True)]).sum(axis=0)
        first, gained = account(state)
        stored = (system.hamiltonian(x + change, params) - first) - gained
        blurred = EPSILON * (jnp.abs(first) + jnp.abs(gained)) / NOISE
        length = jnp.sqrt((change @ change) ** 2 + (blurred**2 / (gradient @ gradient + TINY)) ** 2 + TINY)
        return gradient + (stored - gradient @ change) / length * change, x + change / 2

    def ports(u, state, t, h, params):
        return once(all_ports)(u, state, t, h, params)

    def all_ports(u, state, t, h, params):
        """(ū, ȳ, dissipated power) of the step."""
        gradient, middle = discrete_gradient(u, state, h, params)
        if ported is None:
            return jnp.zeros(0), jnp.zeros(0), jnp.zeros(())
        driven = ported.input(t + h / 2, middle, params)
        outputs = ported.open_matrix(middle, params).T @ gradient
        loss = jnp.zeros(()) if ported.R is None else gradient @ ported.R(middle, params) @ gradient
        return driven, outputs, loss

    def residual(u, state, t, h, params):
        gradient, middle = discrete_gradient(u, state, h, params)
        return system.relation(middle, u[:n], u[n:], t + h / 2, params, gradient)

    def advance(u, state, t, h, params):
        driven, outputs, loss = ports(u, state, t, h, params)
        supplied, dissipated, lost_supplied, lost_dissipated, first = state[n:]
        supplied, lost_supplied = _add(supplied, lost_supplied, h * (driven @ outputs))
        dissipated, lost_dissipated = _add(dissipated, lost_dissipated, h * loss)
        books = jnp.stack([supplied, dissipated, lost_supplied, lost_dissipated, first])
        return jnp.concatenate([state[:n] + h * u[:n], books])

    def unpack(state, u, t, h, params):
        gradient, _ = discrete_gradient(u, state, h, params)
        driven, outputs, loss = ports(u, state, t, h, params)
        power = jnp.stack([gradient @ u[:n], driven @ outputs, loss])
        row = {"x": state[:n], "work": state[n : n + 2] + state[n + 2 : n + 4], "power": power}
        return row | {"multipliers": all_of_them(u[n:])} if m else row

    def start(data, h, params):
        if "x" not in data:
            raise ValueError("this scheme starts from x=.")
        x = data["x"]
        books = jnp.concatenate([jnp.zeros(4), system.hamiltonian(x, params)[None]])
        return jnp.concatenate([x, books]), jnp.concatenate([data["velocity"], jnp.zeros(m)])

    fields = {
        "x": Field((n,)),
        "work": Field((2,), "node", ("work",), "energy supplied and energy dissipated since the start"),
        "power": Field((3,), "step", ("power",), "power stored, supplied and dissipated"),
    }
    if m:
        about = "multipliers of the constraints" if shape.c else "inputs that keep the closed ports closed"
        axis = "constraint" if shape.c else "closed_port"
        fields["multipliers"] = Field((shape.m + shape.c,), "step", (axis,), about)
    return StepEquation(
        start=start,
        residual=residual,
        advance=advance,
        unpack=unpack,
        state_size=n + 5,
        unknowns=n + m,
        fields=fields,
        labels=tuple(f"component {i} of the discrete balance" for i in range(n)) + tuple(f"output y[{a}]" for a in range(m)),
    )


def _add(total, lost, term):
    """A running sum and its lost digits after one more term (Neumaier's compensated summation)."""
    new = total + term
    small = jnp.where(jnp.abs(total) >= jnp.abs(term), (total - new) + term, (term - new) + total)
    return new, lost + small
