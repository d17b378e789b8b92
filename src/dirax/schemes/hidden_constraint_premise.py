"""The premise of schemes that solve for ẋ, Method 2 among them, that a system without stated constraints has none: refused at
initial data where it does not hold."""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from dirax.numerics.ranks import rank_of_equations
from dirax.program.tracing import gradient, jacobian
from dirax.program.user_functions import evaluated
from dirax.schemes.step import StepEquation
from dirax.systems.constraint_algorithm import final_manifold_needed
from dirax.systems.forms import RelationForm
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.manifold_lagrangian import ManifoldLagrangian
from dirax.systems.system import AbstractSystem

METHOD_2 = "Method 2"


def nothing_hidden_in_relation(
    system: AbstractSystem, form: RelationForm, equation: StepEquation, scheme: str = METHOD_2
) -> StepEquation:
    """The equation of a scheme of this name, which refuses initial data at which the matrix of ẋ is singular."""

    def matrix(data, params):
        x, none = system.complete(data, params, False)["x"], jnp.zeros(0)
        return jacobian(lambda velocity: form.residual(x, velocity, none, data["t"], params))(jnp.zeros_like(x)), x

    def at(data, h, params):
        found, x = evaluated(matrix, {"t": np.zeros(()), **data}, params)
        return found, "the matrix of ẋ", np.asarray(x)

    return _refusing(system, at, equation, scheme)


def nothing_hidden_in_lagrangian(system: LagrangeDirac | ManifoldLagrangian, equation: StepEquation) -> StepEquation:
    """The equation, which refuses initial data at which the Hessian ∂²L/∂v² is singular."""

    def hessian(t, q, v, params):
        whole = jacobian(gradient(lambda v: system.lagrangian.at(t, q, v, params)))(v)
        if not isinstance(system, ManifoldLagrangian):
            return whole
        frame = system.manifold.frame(q)
        return frame.T @ whole @ frame

    def at(data, h, params):
        if "p" in data:
            return None
        q, v = (data["q0"], (data["q1"] - data["q0"]) / h) if "q0" in data else (data["q"], data["v"])
        return evaluated(hessian, data.get("t", np.zeros(())), q, v, params), "∂²L/∂v²", {"q": q, "v": v}

    return _refusing(system, at, equation)


def _refusing(system: AbstractSystem, at: Callable, equation: StepEquation, scheme: str = METHOD_2) -> StepEquation:
    def check(data, h, params):
        if (found := at(data, h, params)) is not None:
            refuse(found, params)
        equation.check(data, h, params)

    def refuse(found, params):
        matrix, what, near = np.asarray(found[0]), *found[1:]
        rank = int(rank_of_equations(matrix[None])[0][0])
        if rank < max(matrix.shape):
            raise ValueError(
                f"{what} has rank {rank} of {max(matrix.shape)} at the initial data, and {scheme} of this "
                f"{type(system).__name__} {final_manifold_needed(system, near, params)}."
            )

    return dataclasses.replace(equation, check=check)
