"""A relation of (x, ẋ) discretized by a discretization map: the map as a way to step, and the equation of one step."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from dirax.geometry.cotangent_lift import CotangentLift
from dirax.geometry.maps import AbstractDiscretizationMap, Theta
from dirax.geometry.spaces import Euclidean
from dirax.program.tracing import value_along
from dirax.schemes.labels import Labels
from dirax.schemes.step import Field, StepEquation
from dirax.systems.forms import RelationForm


class Stepping(NamedTuple):
    """`move(x0, u, h) -> (x, v, x1)` with map(x, h v) = (x0, x1), for `unknowns` numbers u, where the `equations` (d,) of
    (x0, u, h) hold, if there are any; `tangent(x0, x)` (d, N) spans the tangent space at x, by rows, and pairs a residual with
    it; `initial(x0, v)` is a first guess of u."""

    unknowns: int
    move: Callable
    tangent: Callable | None
    initial: Callable
    equations: Callable | None = None


def stepping(map: AbstractDiscretizationMap, size: int) -> Stepping:
    """The Stepping of a map for points of length `size`; raises `ValueError` where the map's manifold has another size.

    For the θ maps and their lifts q_1 = q_0 + h v is used as it stands, so that v keeps the digits that a difference of
    the points would lose; else x1 is found in a local parametrization at x0, and stays on the manifold to roundoff. Where the
    inverse of the map is no formula, x and v are unknowns beside the others: map(x, h v) begins at x0.
    """
    manifold = map.manifold(size)
    theta = _theta(map)
    if theta is not None:
        return Stepping(size, lambda x0, u, h: (x0 + _weights(theta, size) * h * u, u, x0 + h * u), None, lambda x0, v: v)
    if isinstance(manifold, Euclidean):

        def move(x0, u, h):
            x1 = x0 + h * u
            x, w = map.backward(x0, x1)
            return x, w / h, x1

        return Stepping(size, move, None, lambda x0, v: v)

    def tangent(x0, x):
        # fixed vectors, projected at x: their span is the tangent space and its dependence on x is differentiable
        fixed = jax.lax.stop_gradient(manifold.frame(x0))
        return jax.vmap(lambda f: manifold.projection(x, f))(fixed.T)

    if not map.has_explicit_inverse:
        d = manifold.dimension

        def base(x0, u, h):
            return value_along(manifold.local_parametrization(x0), (h * u[d:],), (u[:d],))

        def move_forward(x0, u, h):
            x, v = base(x0, u, h)
            return x, v, map.forward(x, h * v)[1]

        def begins_there(x0, u, h):
            x, v = base(x0, u, h)
            return manifold.coordinates(x0, map.forward(x, h * v)[0] - x0)

        def initial(x0, v):
            rate = manifold.coordinates(x0, v)
            return jnp.concatenate([rate, map.base_fraction * rate])

        return Stepping(2 * d, move_forward, tangent, initial, begins_there)

    def move_on_manifold(x0, u, h):
        x1 = manifold.local_parametrization(x0)(h * u)
        x, w = map.backward(x0, x1)
        return x, w / h, x1

    return Stepping(manifold.dimension, move_on_manifold, tangent, lambda x0, v: manifold.coordinates(x0, v))


def _theta(map) -> tuple[float, ...] | None:
    """The fraction of the step at which the base point lies: one for all coordinates, or for q and for p of a lift."""
    if isinstance(map, Theta):
        return (map.theta,)
    if isinstance(map, CotangentLift) and isinstance(map.map, Theta):
        return (map.map.theta, 1.0 - map.map.theta)
    return None


def _weights(theta: tuple[float, ...], size: int):
    return theta[0] if len(set(theta)) == 1 else jnp.repeat(jnp.array(theta), size // 2)


def discretized_relation(
    form: RelationForm, size: int, map: AbstractDiscretizationMap, on_constraints: bool = False
) -> StepEquation:
    """The relation between (x, ẋ) of a system on M, discretized by a map on M: state x (`size`,), unknowns (ẋ, multipliers).

    With `on_constraints` M is where the constraints of the relation hold, and the multipliers are those that keep ẋ tangent to
    it ([BLM] §7.2): all `size` numbers of the relation are solved, in place of their tangential parts and of the constraints.
    Explicit time and ports are taken at t + `map.base_fraction` h, the time of the base point.
    """
    step, m, fraction = stepping(map, size), form.multipliers, map.base_fraction
    d, tangential = step.unknowns, map.manifold(size).dimension

    def residual(u, state, t, h, params):
        x, velocity, _ = step.move(state, u[:d], h)
        r = form.residual(x, velocity, u[d:], t + fraction * h, params)
        if on_constraints:
            r = r[:size]
        elif step.tangent is not None:
            r = jnp.concatenate([step.tangent(state, x) @ r[:size], r[size:]])
        return r if step.equations is None else jnp.concatenate([r, step.equations(state, u[:d], h)])

    def advance(u, state, t, h, params):
        return step.move(state, u[:d], h)[2]

    def unpack(state, u, t, h, params):
        row = form.node(state, params)
        if form.saved:
            row["multipliers"] = form.spread(u[d:])
        if form.observed:
            x, velocity, _ = step.move(state, u[:d], h)
            row |= {seen.name: seen.at(x, velocity, t + fraction * h, params) for seen in form.observed}
        return row

    def start(data, h, params):
        if "x" not in data:
            raise ValueError("this scheme is a one-step method in x: start it from one point, not from two.")
        return data["x"], jnp.concatenate([step.initial(data["x"], data["velocity"]), data.get("guess", jnp.zeros(m))])

    def resume(data, h, params):
        """With the multipliers of the row, where it has some."""
        state, u = start(data, h, params)
        if not form.saved or "multipliers" not in data:
            return state, u
        saved = jax.vmap(form.spread)(jnp.eye(m)) @ data["multipliers"]
        return state, jnp.concatenate([u[:d], jnp.where(jnp.isfinite(saved), saved, u[d:])])

    labels = Labels.numbered("component {} of the Dirac condition", size if on_constraints else tangential)
    labels += () if on_constraints else form.labels
    if step.equations is not None:
        labels += Labels.numbered("component {} of where the step begins", tangential)
    fields = {name: Field((size,)) for name in form.names}
    if form.saved:
        fields["multipliers"] = Field((form.saved,), "step", (form.axis,), "multipliers at the base point")
    fields |= {seen.name: Field(seen.shape, "step", seen.dims, seen.description) for seen in form.observed}
    return StepEquation(
        start=start,
        resume=resume,
        residual=residual,
        advance=advance,
        unpack=unpack,
        state_size=size,
        unknowns=d + m,
        fields=fields,
        labels=labels,
        canonical=form.canonical,
    )
