"""Implicit forms E(x) ẋ = f(x) + B(x) u, on which the constraint algorithm works; the time as a coordinate."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters.partial_eval import dce_jaxpr

from dirax.program.tracing import jacobian
from dirax.program.user_functions import constant_entries
from dirax.systems.forms import ImplicitForm
from dirax.systems.shape import Shape

AFFINE = 1e-9
"""How much slopes that are not constant as they are written may differ, relative to the largest of their equation."""


def of_relation(system: Any, near: Any, params: Any) -> ImplicitForm:
    """The implicit form of a system whose relation form is affine in (ẋ, u), with the constraints g = 0 beside it."""
    at, t = without_time(near)
    form = x = None
    if not isinstance(at, dict) or "x" in at or set(at) == {"q", "p"}:
        x = point_of(at, ("x",), system)
        shape = Shape(*system.sizes({"x": jnp.asarray(x)}, params))
        system.check({"x": jnp.asarray(x)}, params)
        form = system.relation_form(shape)
    if form is None or x is None:
        raise TypeError(
            "the constraint algorithm takes systems with an implicit form, such as dx.ImplicitSystem, dx.DiracSystem, "
            f"dx.PortHamiltonian and dx.LagrangeDirac, but a {type(system).__name__} was given"
            f"{'' if x is None else ' that has none'}: state it as dx.ImplicitSystem(E, f, B)."
        )
    n, unknowns = x.size, np.zeros(x.size + form.multipliers)

    def defect(t, x, y, params):
        positions = system.constraints.position_defect(t, x, params)
        return jnp.concatenate([form.residual(x, y[:n], y[n:], t, params), positions])

    def equations(t, x, params):
        y = jnp.asarray(unknowns)
        return jacobian(lambda y: defect(t, x, y, params))(y), -defect(t, x, y, params)

    _refuse_nonlinear(system, lambda y: defect(t, x, y, params), unknowns, form.labels)
    energy = lambda t, x, params: system.energy_at({"x": x, "t": t}, params)
    timed = uses_time(defect, x, unknowns, params)
    return in_time(timed, t, equations, x, names("x", n), names("u", form.multipliers), energy, "its relation of x and ẋ")


def _refuse_nonlinear(system: Any, defect: Callable, unknowns: np.ndarray, labels: Sequence[str]) -> None:
    """Raise `TypeError` for equations that are not affine in their unknowns, of which no matrix says what they determine."""
    slopes = jacobian(defect)
    found = constant_entries(slopes, unknowns)
    if found is not None and not np.any(np.isnan(found)):
        return
    here, random = np.asarray(slopes(unknowns)), np.random.default_rng(0).normal(size=unknowns.size)
    size = np.max(np.abs(here), axis=1, keepdims=True)
    bends = lambda moved: bool(np.any(np.abs(np.asarray(slopes(random * moved)) - here) > AFFINE * size))
    if bends(np.ones(unknowns.size)):
        rates = unknowns.size - len(labels)
        names = [label if bends(one) else "" for label, one in zip(labels, np.eye(unknowns.size)[rates:], strict=True)]
        where = f" in {', '.join(filter(None, names))}" if any(names) else ""
        raise TypeError(
            "the constraint algorithm takes equations that are affine in the rates ẋ and the multipliers, but those of this "
            f"{type(system).__name__} are not{where}, as with a resistor whose current is a function of its voltage: state it "
            "linearized about a working point."
        )


def in_time(timed: bool, t: float, equations: Callable, x: np.ndarray, coordinates, multipliers, energy, about) -> ImplicitForm:
    """The form of `equations(t, x, params)` and `energy(t, x, params)`: those at t = 0, or with t as the last coordinate."""
    if not timed:
        autonomous = lambda x, params: equations(0.0, x, params)
        return ImplicitForm(autonomous, x, coordinates, multipliers, lambda x, params: energy(0.0, x, params), about)
    n = x.size

    def extended(x, params):
        matrix, right = equations(x[n], x[:n], params)
        matrix = jnp.concatenate([matrix[:, :n], jnp.zeros((matrix.shape[0], 1)), matrix[:, n:]], axis=1)
        clock = jnp.zeros((1, matrix.shape[1])).at[0, n].set(1.0)
        return jnp.concatenate([matrix, clock]), jnp.concatenate([right, jnp.ones(1)])

    of_x = lambda x, params: energy(x[n], x[:n], params)
    words = f"{about}; t as a coordinate"
    return ImplicitForm(extended, np.append(x, t), (*coordinates, "t"), multipliers, of_x, words, clock=True)


def without_time(near) -> tuple[Any, float]:
    """(near without its time, the time)."""
    if not isinstance(near, dict) or "t" not in near:
        return near, 0.0
    return {name: value for name, value in near.items() if name != "t"}, float(near["t"])


def uses_time(function: Callable | None, *values) -> bool:
    """Whether the result of a function of (t, …) depends on t as it is written."""
    if function is None:
        return False
    jaxpr = jax.make_jaxpr(lambda t: function(t, *values))(jnp.zeros(())).jaxpr
    _, (used,) = dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))
    return bool(used)


def point_of(near, keys: tuple[str, ...], system) -> np.ndarray:
    """`near` as a point x (N,): an array, {"x": …} or {"q": …, "p": …}; raises `ValueError` for anything else."""
    if isinstance(near, dict):
        if set(near) == {"q", "p"}:
            near = np.concatenate([np.asarray(near["q"]), np.asarray(near["p"])])
        elif set(near) == {"x"}:
            near = near["x"]
        else:
            raise ValueError(f"near must hold {', '.join(keys)} for a {type(system).__name__}, but holds {', '.join(near)}.")
    x = np.asarray(near, dtype=float)
    if x.ndim != 1 or not x.size or not np.all(np.isfinite(x)):
        raise ValueError(f"near must be one finite point x of shape (N,), but {near!r:.80} was given.")
    return x


def names(letter: str, count: int) -> tuple[str, ...]:
    """("x0", "x1", …) for the letter x."""
    return tuple(f"{letter}{i}" for i in range(count))


def energy_of_x(system):
    """The energy of the system as a function of (x, params)."""
    return lambda x, params: system.energy_at({"x": x}, params)
