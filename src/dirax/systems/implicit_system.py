"""Implicit systems E(x) ẋ = f(x) + B(x) u."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Float

from dirax.numerics.arrays import Data, Numbers
from dirax.program.linear_solves import scaled_pseudo_inverse
from dirax.program.tracing import gradient, jacobian
from dirax.program.user_functions import UserFunction
from dirax.systems.forms import ImplicitForm, RelationForm
from dirax.systems.implicit_form import energy_of_x, names, point_of, without_time
from dirax.systems.magnitudes import MOST, as_large_as_energy, of_solution, power_of
from dirax.systems.shape import Shape
from dirax.systems.system import AbstractSystem


class ImplicitSystem(AbstractSystem):
    """E(x) ẋ = f(x) + B(x) u, with u free: a submanifold S_0 of TM that is affine in the velocity ([BLM] §3).

    `E(x[, params])` (r, N), `f(x[, params])` (r,), `B(x[, params])` (r, m), none by default; E may be singular and need
    not be square. `hamiltonian(x[, params])`, a scalar, only serves to report an energy.

        pendulum = dx.ImplicitSystem(  # x = (q, p, tension as the multiplier), |q| = 1
            E=lambda x: jnp.eye(5)[:, :4], f=lambda x: jnp.array([x[2], x[3], 0.0, -1.0, x[0]**2 + x[1]**2 - 1.0]),
            B=lambda x: jnp.array([0.0, 0.0, x[0], x[1], 0.0])[:, None])
    """

    E: UserFunction
    f: UserFunction
    B: UserFunction | None
    hamiltonian: UserFunction | None

    def __init__(self, E: Callable, f: Callable, B: Callable | None = None, hamiltonian: Callable | None = None):
        self.E, self.f = UserFunction(E, "E", ("x",)), UserFunction(f, "f", ("x",))
        self.B = None if B is None else UserFunction(B, "B", ("x",))
        self.hamiltonian = None if hamiltonian is None else UserFunction(hamiltonian, "hamiltonian", ("x",))

    def equations(self, x: Float[Numbers, " N"], params: Any = None) -> tuple[Numbers, Numbers]:
        """([E, −B], f), of shapes (r, N + m) and (r,): the linear equations of (ẋ, u)."""
        E, f = self.E(x, params), self.f(x, params)
        return (E if self.B is None else jnp.concatenate([E, -self.B(x, params)], axis=1)), f

    def relation(
        self,
        x: Float[Numbers, " N"],
        velocity: Float[Numbers, " N"],
        multipliers: Float[Numbers, " m"],
        t: Any,
        params: Any = None,
    ) -> Float[Numbers, " r"]:
        """E ẋ − f − B u."""
        matrix, f = self.equations(x, params)
        return matrix @ jnp.concatenate([velocity, multipliers]) - f

    def relation_form(self, shape: Shape) -> RelationForm:
        labels = tuple(f"output y[{a}]" for a in range(shape.m))
        return RelationForm(self.relation, shape.m, labels, shape.m, axis="closed_port")

    def implicit_form(self, near: Any, params: Any) -> ImplicitForm:
        x = point_of(without_time(near)[0], ("x",), self)
        _, m = self.sizes({"x": jnp.asarray(x)}, params)
        return ImplicitForm(self.equations, x, names("x", x.size), names("u", m), energy_of_x(self), "as stated")

    def sizes(self, data: Data, params: Any) -> tuple[int, int]:
        if "x" not in data:
            raise ValueError(f"an ImplicitSystem starts from x=, but {', '.join(data)} were given.")
        x = data["x"]
        E, f = self.E.shape(x, params).shape, self.f.shape(x, params).shape
        if len(E) != 2 or E[1] != x.size:
            raise ValueError(f"E must have shape (r, {x.size}), one row an equation, but it returned shape {E}.")
        if f != (E[0],):
            raise ValueError(f"f must have shape ({E[0]},) like the rows of E, but it returned shape {f}.")
        if self.B is None:
            return x.size, 0
        B = self.B.shape(x, params).shape
        if len(B) != 2 or B[0] != E[0]:
            raise ValueError(f"B must have shape ({E[0]}, m), one column a multiplier, but it returned shape {B}.")
        return x.size, B[1]

    def complete(self, data: Data, params: Any, project: bool) -> Data:
        x = data["x"]
        matrix, f = self.equations(x, params)
        velocity = scaled_pseudo_inverse(matrix) @ f
        return {"x": x, "velocity": velocity[: x.size], "multipliers": velocity[x.size :]}

    def initial_defect(self, data: Data, params: Any) -> Float[Numbers, " r"]:
        """The part of f that no (ẋ, u) reaches: x is on M_0 where it vanishes."""
        return self.relation(data["x"], data["velocity"], data["multipliers"], 0.0, params)

    def sizes_of_data(self, data: Data, params: Any) -> Data:
        """Rates that are zero up to roundoff of the others, and of the terms of f, which may cancel; coordinates that are so
        beside others with as much energy."""
        x, solution = data["x"], jnp.concatenate([data["velocity"], data["multipliers"]])
        largest = jnp.abs(x)
        if self.hamiltonian is not None:
            largest = largest + as_large_as_energy(gradient(lambda x: self.hamiltonian(x, params)), x)
        terms = jnp.abs(jacobian(lambda x: self.equations(x, params)[1])(x)) @ largest if x.size <= MOST else None
        rates = of_solution(lambda: self.equations(x, params)[0], solution, terms)
        sizes = {name: jnp.abs(a) for name, a in data.items()}
        return sizes | {"x": largest, "velocity": rates[: x.size], "multipliers": rates[x.size :]}

    def energy_at(self, row: Data, params: Any) -> Float[Numbers, ""]:
        """H(x); NaN for a system stated without one."""
        return jnp.array(jnp.nan) if self.hamiltonian is None else self.hamiltonian(row["x"], params)

    @property
    def has_power(self) -> bool:
        return self.hamiltonian is not None

    def power_at(self, row: Data, params: Any) -> Float[Numbers, " 2"]:
        """dH·ẋ, with the ẋ of least norm where the equations leave one open."""
        assert self.hamiltonian is not None
        return power_of(self.hamiltonian, row["x"], self.complete({"x": row["x"]}, params, False)["velocity"], params)

    def constraint_at(self, row: Data, params: Any) -> Float[Numbers, " r"]:
        return self.initial_defect(self.complete({"x": row["x"]}, params, False), params)

    @property
    def projected(self) -> str:
        return ""
