"""Discrete Lagrangians L_d(q0, q1) ≈ ∫ L dt, and discrete constraints w_d(q0, q1), as functions of (q0, v) with q1 = q0 + h v.

The velocity is the variable because q1 − q0 loses digits that v keeps: with it the equations are solved to roundoff of v.
"""

from collections.abc import Callable

import jax
from jaxtyping import Array, Float

from dirax.functions import UserFunction

RULES = ("left", "right", "midpoint", "trapezoidal")
CONSTRAINTS = ("left", "right", "midpoint")


def checked_rule(rule, names: tuple[str, ...], argument: str, user_arguments: tuple[str, ...]):
    """A rule name, or the user's function wrapped; raises `ValueError` with the choices otherwise."""
    if callable(rule):
        return rule if isinstance(rule, UserFunction) else UserFunction(rule, argument, user_arguments)
    if rule not in names:
        choices = ", ".join(repr(n) for n in names)
        raise ValueError(
            f"{argument} must be one of {choices} or a function of ({', '.join(user_arguments)}[, params]), "
            f"but {rule!r} was given."
        )
    return rule


def discrete_lagrangian(lagrangian: UserFunction, rule) -> Callable:
    """L_d as a function (q0, v, h, params) ↦ L_d(q0, q0 + h v)."""
    if isinstance(rule, UserFunction):
        scalar = rule.returning(())
        return lambda q, v, h, params: scalar(q, q + h * v, h, params)
    rules = {
        "left": lambda q, v, h, params: h * lagrangian(q, v, params),
        "right": lambda q, v, h, params: h * lagrangian(q + h * v, v, params),
        "midpoint": lambda q, v, h, params: h * lagrangian(q + h * v / 2, v, params),
        "trapezoidal": lambda q, v, h, params: h * (lagrangian(q, v, params) + lagrangian(q + h * v, v, params)) / 2,
    }
    return rules[rule]


def discrete_constraint(constraint_matrix: Callable, rule, m: int | None = None) -> Callable:
    """w_d as a function (q0, v, h, params) ↦ (m,): W v at the base point that the rule names, or the user's w_d."""
    if isinstance(rule, UserFunction):
        vector = rule if m is None else rule.returning((m,))
        return lambda q, v, h, params: vector(q, q + h * v, h, params)
    base = {"left": 0.0, "right": 1.0, "midpoint": 0.5}[rule]
    return lambda q, v, h, params: constraint_matrix(q + base * h * v, params) @ v


def slot_derivatives(ld: Callable, q, v, h, params) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """(D1 L_d, D2 L_d) at (q, q + h v), from the derivatives with respect to (q, v)."""
    dq, dv = jax.grad(ld, argnums=(0, 1))(q, v, h, params)
    return dq - dv / h, dv / h
