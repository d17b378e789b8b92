"""Discrete Lagrangians L_d(q0, q1) ≈ ∫ L dt, discrete constraints w_d(q0, q1) and discrete forces f_d^±(q0, q1), as
functions of (t0, q0, v) with q1 = q0 + h v.

The velocity is the variable because q1 − q0 loses digits that v keeps: with it the equations are solved to roundoff of v.
"""

from collections.abc import Callable
from typing import Any

from jaxtyping import Array, Float

from dirax.program.tracing import gradient
from dirax.program.user_functions import UserFunction
from dirax.systems.constraints import Constraints

LD_ARGUMENTS = ("q0", "q1", "h")
RULES = ("left", "right", "midpoint", "trapezoidal")
CONSTRAINTS = ("left", "right", "midpoint")
BASE = {"left": 0.0, "right": 1.0, "midpoint": 0.5}
"""Where the point of a one-point rule lies in the step."""

QUADRATURE = {rule: ((base, 1.0),) for rule, base in BASE.items()} | {"trapezoidal": ((0.0, 0.5), (1.0, 0.5))}
"""Where the points of a rule lie in the step, with their weights."""

MIRRORED = {"left": "right", "right": "left", "midpoint": "midpoint", "trapezoidal": "trapezoidal"}

"""The rule that is the same when time runs backwards, by the name of a rule."""


def checked_rule(rule, names: tuple[str, ...], argument: str):
    """A rule name, or the user's function wrapped; raises `ValueError` with the choices otherwise."""
    if callable(rule):
        return rule if isinstance(rule, UserFunction) else UserFunction(rule, argument, LD_ARGUMENTS, timed=True)
    if rule not in names:
        choices = ", ".join(repr(n) for n in names)
        raise ValueError(
            f"{argument} must be one of {choices} or a function of ({', '.join(LD_ARGUMENTS)}[, params]), but {rule!r} was given."
        )
    return rule


def base_point(rule: str, t: Any, q, v, h) -> tuple[Any, Any]:
    """The time and the point at which a one-point rule evaluates."""
    base = BASE[rule]
    return (t, q) if base == 0.0 else (t + base * h, q + base * h * v)


def discrete_lagrangian(lagrangian: UserFunction, rule) -> Callable:
    """L_d as a function (t0, q0, v, h, params) ↦ L_d(t0, q0, q0 + h v)."""
    if isinstance(rule, UserFunction):
        scalar = rule.returning(())
        return lambda t, q, v, h, params: scalar(*rule.given(t, q, q + h * v, h, params))
    if rule == "trapezoidal":

        def trapezoidal(t, q, v, h, params):
            return h * (lagrangian.at(t, q, v, params) + lagrangian.at(t + h, q + h * v, v, params)) / 2

        return trapezoidal

    def one_point(t, q, v, h, params):
        at, point = base_point(rule, t, q, v, h)
        return h * lagrangian.at(at, point, v, params)

    return one_point


def discrete_constraint(constraints: Constraints, rule, m: int | None = None) -> Callable:
    """w_d as a function (t0, q0, v, h, params) ↦ (m,): W v + b at the base point that the rule names, or the user's w_d."""
    if isinstance(rule, UserFunction):
        vector = rule if m is None else rule.returning((m,))
        return lambda t, q, v, h, params: vector(*rule.given(t, q, q + h * v, h, params))

    def one_point(t, q, v, h, params):
        at, point = base_point(rule, t, q, v, h)
        return constraints.nonholonomic_defect(at, point, v, params)

    return one_point


def discrete_forces(forces: Callable, rule) -> Callable:
    """(f_d^−, f_d^+) as a function (t0, q0, v, h, params): the impulses of the force in a step at its first and its last point,
    by the quadrature of L_d; by that of "midpoint" for the user's L_d.

    The discrete Lagrange–d'Alembert principle of Marsden and West, Acta Numerica 2001, §3.2.1.
    """

    def impulses(t, q, v, h, params):
        q1 = q + h * v
        if rule == "left":
            first = h * forces(t, q, v, params)
            return first, 0.0 * first
        if rule == "right":
            last = h * forces(t + h, q1, v, params)
            return 0.0 * last, last
        if rule == "trapezoidal":
            return h / 2 * forces(t, q, v, params), h / 2 * forces(t + h, q1, v, params)
        half = h / 2 * forces(t + h / 2, q + h / 2 * v, v, params)
        return half, half

    return impulses


def slot_derivatives(ld: Callable, t, q, v, h, params) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """(D1 L_d, D2 L_d) at (q, q + h v), from the derivatives with respect to (q, v)."""
    dq, dv = gradient(ld, (1, 2))(t, q, v, h, params)
    return dq - dv / h, dv / h


def derivatives_by_slots(lagrangian: UserFunction, rule: str | UserFunction) -> Callable:
    """(D1 L_d, D2 L_d) of `discrete_lagrangian` as a function (t0, q0, v, h, params).

    L_d = h Σ w_i L(q0 + c_i h v, v) has the derivatives Σ w_i ((1 − c_i) h ∂L/∂q − ∂L/∂v) and Σ w_i (c_i h ∂L/∂q + ∂L/∂v), in
    which nothing cancels: of a separable Lagrangian D1 L_d with "right" and "trapezoidal" has no force at q1 in it, so that the
    equations of the step are linear in v, and are seen to be.
    """
    if isinstance(rule, UserFunction):
        ld = discrete_lagrangian(lagrangian, rule)
        return lambda t, q, v, h, params: slot_derivatives(ld, t, q, v, h, params)

    def by_quadrature(t, q, v, h, params):
        first, last = [], []
        for share, weight in QUADRATURE[rule]:
            at, point = (t + share * h, q + share * h * v) if share else (t, q)
            dq, dv = gradient(lambda q, v, at=at: lagrangian.at(at, q, v, params), (0, 1))(point, v)
            first.append(weight * ((1.0 - share) * h * dq - dv if share != 1.0 else -dv))
            last.append(weight * (share * h * dq + dv if share else dv))
        return sum(first[1:], first[0]), sum(last[1:], last[0])

    return by_quadrature


def mirrored(rule: str | UserFunction, sign: float) -> str | Callable:
    """sign·f(q1, q0, −h) of a function f(q0, q1, h), or the rule of that name's mirror image."""
    if isinstance(rule, str):
        return MIRRORED[rule]
    name = f"adjoint of {rule.name}"
    if rule.takes_time:
        return UserFunction(lambda t, q0, q1, h, params: sign * rule(t + h, q1, q0, -h, params), name, LD_ARGUMENTS, timed=True)
    return UserFunction(lambda q0, q1, h, params: sign * rule(q1, q0, -h, params), name, LD_ARGUMENTS)
