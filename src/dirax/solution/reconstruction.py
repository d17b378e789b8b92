"""From a trajectory on the quotient back to the configuration space."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dirax.geometry.group_retractions import coadjoint
from dirax.geometry.lie_group import AbstractLieGroup
from dirax.numerics.tolerances import GROUP_DEFECT
from dirax.program.memo import by_value
from dirax.program.user_functions import is_traced
from dirax.schemes.lagrange_dirac import LagrangeDAlembert
from dirax.schemes.routh import DiscreteRouth
from dirax.schemes.step import Field
from dirax.solution.each_row import each_row, plain
from dirax.solution.events import Events
from dirax.solution.loading import with_code
from dirax.solution.solution import Solution
from dirax.solution.steps_again import Entries
from dirax.text.representation import shortened


def reconstruct(solution: Solution, g0: Any = None) -> Solution:
    """The motion (q, p) on T*Q over a reduced solution, as a Solution of the system that was reduced by the scheme whose
    equations on Q × Q it satisfies (of Routh's, `dx.LagrangeDAlembert`).

    Of a system made by `dx.reduce`: q = (x, g) with g_{k+1} = g_k + ω_d + A(x_{k+1} − x_k), p = (w − h*_{d,Σ}(μ), μ)
    ([RL] §4), multipliers those of the one-forms at q, work as it was; on Σ × G with a group that is not abelian
    g_{k+1} = g_k h⁰_d v, with the vertical part v. Of a `dx.EulerPoincare` or `dx.LiePoisson` system: q
    the group element g_k = g0 f_0 ⋯ f_{k−1} (N,), p the covector at it with the body momentum μ, `spatial_momentum`
    Ad*_{g⁻¹} μ (d,), and the reduced fields as they were; `g0` is an element (N,), a matrix (k, k), in a batch also (B, N),
    or the identity, as for a run that started from q=.

    Raises `TypeError` for a solution of another system, `ValueError` for a g0 that is no element of the group, and
    for a run on a group by a scheme other than `dx.DiscreteEulerPoincare`, which saves no steps on it.
    """
    if not isinstance(solution, Solution):
        raise TypeError(f"solution must be a dirax Solution (from dx.simulate or dx.load), but {shortened(solution)} was given.")
    stated = solution.system
    if stated is not None and (on_algebra := stated.lie_algebra_form()) is not None:
        return _on_group(solution, on_algebra.space.group, on_algebra.space.dimension, g0)
    system = None if stated is None else stated.quotient_form()
    if system is None:
        raise TypeError(
            "dx.reconstruct takes a solution of a dx.EulerPoincare, dx.LiePoisson or dx.reduce system, but this one is of "
            f"{stated!r}."
        )
    if g0 is not None:
        raise ValueError("g0 is for systems on a Lie group: here the initial data name the group coordinate already.")
    reduced = (*system.own_fields, "vertical")
    of_rows = lambda fields, _: each_row({name: fields[name] for name in system.own_fields}, system.unreduced_row)
    lifted = of_rows(solution.fields, None)
    lifted |= {name: a for name, a in solution.fields.items() if name not in reduced}
    if system.system.one_forms is not None:
        lifted["multipliers"] = _multipliers_at(solution, lifted["q"])
    n = lifted["q"].shape[-1]
    info = {"q": Field((n,)), "p": Field((n,)), "chart": Field((n,), description="the centre of a chart at the row", chosen=True)}
    about = {name: info.get(name) or solution.field_info[name] for name in lifted}
    whole = _lifted(solution, system.system, lifted, about, of_rows)
    whole.scheme = jax.tree.map(_on_q, solution.scheme, is_leaf=lambda part: isinstance(part, DiscreteRouth))
    return whole if is_traced(lifted) or solution.equation is None else with_code(whole, whole.system, whole.scheme)


def _on_q(part: Any) -> Any:
    """The scheme on Q × Q whose trajectories those of Routh's equations are, also inside a composition."""
    if not isinstance(part, DiscreteRouth):
        return part
    return LagrangeDAlembert(part.discrete_lagrangian, part.constraint, part.momentum)


def _multipliers_at(solution: Solution, q: Any) -> Any:
    """The λ of the one-forms W(q): on the quotient they are those of W(x, 0), whose rows span the same after the translation
    but may be others, so that W(q)ᵀλ is the same force."""
    system, multipliers = solution.system, solution.fields["multipliers"]
    m, _ = system.constraints.sizes(jnp.zeros(np.shape(q)[-1]), solution.params_of_one)
    kept = np.array([i for i in range(m) if i not in solution.stats.get("redundant_constraints", ())], int)

    def at(t, q, given, params):
        fixed, moved = (
            system.at_identity(point, system.constraints.one_forms_at(t, point, params)[kept])
            for point in (system.origin_of(q), q)
        )
        force = moved @ (fixed.T @ given[kept])
        return given.at[kept].set(jnp.linalg.solve(moved @ moved.T, force))

    t, rows = solution.t[:-1], q[..., :-1, :]
    if not is_traced(t, rows, multipliers, solution.given_params):
        batch, flat = solution.batch or 1, lambda a: np.reshape(a, (-1, np.shape(a)[-1]))
        values, lanes = (np.tile(t, batch), flat(rows), flat(multipliers)), np.repeat(np.arange(batch), len(t))
        key = _multipliers_at, by_value(system), tuple(kept.tolist())
        each = lambda values, params: at(values[0], values[1], values[2], params)
        return Entries(solution)(each, lanes, values, *key).reshape(np.shape(multipliers))
    along = jax.vmap(at, in_axes=(0, 0, 0, None))
    if solution.batch is not None:
        along = jax.vmap(along, in_axes=(None, 0, 0, 0 if solution.batch_params else None))
    return jax.jit(along)(jnp.asarray(t), rows, multipliers, solution.params)


def _on_group(solution: Solution, group: AbstractLieGroup, d: int, g0: Any) -> Solution:
    if "g" not in solution.fields:
        raise ValueError(
            f"the rows of this run by dx.{type(solution.scheme).__name__} hold no steps on the group, of which a motion is made: "
            "run it by dx.DiscreteEulerPoincare()."
        )
    start = _element(group, g0, solution.batch)
    batched = start.ndim == 2

    def rows(lane, g, x):
        q = group.nearest(group.multiply(lane, g))
        return {"q": q, "p": group.covector(q, x[:d]), "spatial_momentum": coadjoint(group, group.inverse(q), x[:d])}

    along = jax.vmap(rows, in_axes=(None, 0, 0))
    if solution.batch is not None:
        along = jax.vmap(along, in_axes=(0 if batched else None, 0, 0))
    lifted = plain(jax.jit(along)(start, jnp.asarray(solution.fields["g"]), jnp.asarray(solution.fields["x"])))

    def of_events(fields, lanes):
        each = jax.vmap(rows, in_axes=(0 if batched else None, 0, 0))
        return plain(each(start[lanes] if batched else start, jnp.asarray(fields["g"]), jnp.asarray(fields["x"])))

    kept = {name: a for name, a in solution.fields.items() if name != "g"}
    about = {
        "q": Field((group.ambient_dimension,), dims=("group",), description="group element"),
        "p": Field((group.ambient_dimension,), dims=("group",), description="covector at q, as a tangent vector"),
        "spatial_momentum": Field((d,), dims=("algebra",), description="Ad*_{g⁻¹} μ"),
    }
    about |= {name: solution.field_info[name] for name in kept}
    whole = _lifted(solution, solution.system, lifted | kept, about, of_events, solution.equation)
    whole.lifted = Lifted(solution, of_events)
    return whole


class Lifted(NamedTuple):
    """What a motion on a group was reconstructed from: `function(fields, trajectories)` of reduced rows one after the other."""

    before: Solution
    function: Callable

    def at(self, fields: dict[str, Any], lead: tuple[int, ...]) -> dict[str, Any]:
        """The fields that are made of reduced ones at moments, (…, size) with this `lead`, the trajectories of a batch first."""
        count, lanes = math.prod(lead), self.before.batch or 1
        flat = {name: a.reshape(count, *np.shape(a)[len(lead) :]) for name, a in fields.items()}
        made = self.function(flat, np.repeat(np.arange(lanes), count // lanes))
        return {name: a.reshape(*lead, *a.shape[1:]) for name, a in made.items()}


def _element(group: AbstractLieGroup, g0: Any, batch: int | None) -> jax.Array:
    if g0 is None:
        return group.identity()
    g, size = jnp.asarray(g0, float), group.ambient_dimension
    matrix = jax.eval_shape(group.matrix, group.identity()).shape
    if g.shape == matrix:
        element = group.from_matrix(g)
        defect = jnp.max(jnp.abs(group.matrix(element) - g))
    elif g.shape == (size,) or (batch is not None and g.shape == (batch, size)):
        element, defect = g, jnp.max(jax.vmap(group.defect)(jnp.atleast_2d(g)))
    else:
        many = f", or ({batch}, {size})" if batch is not None else ""
        raise ValueError(
            f"g0 must be an element of {type(group).__name__} of shape ({size},){many}, or a matrix {matrix}, but it has shape "
            f"{g.shape}."
        )
    if not is_traced(g) and not float(defect) < GROUP_DEFECT:
        raise ValueError(f"g0 is no element of {type(group).__name__}: it is off by {float(defect):.3g}.")
    return element


def _lifted(
    solution: Solution, system: Any, fields: dict[str, Any], info: dict[str, Field], of_events: Callable, equation: Any = None
) -> Solution:
    """The solution with these fields, and its events with those that `of_events` makes of theirs and their trajectories."""
    whole = Solution(
        t=solution.axis,
        fields=fields,
        field_info=info,
        step=solution.step,
        save_every=solution.save_every,
        stats=solution.stats,
        ok=solution.ok,
        message=solution.message,
        system=system,
        scheme=solution.scheme,
        equation=equation,
        params=solution.params,
        batch_params=solution.batch_params,
        initial=solution.initial,
    )
    whole.counts = solution.counts
    if (events := solution.events) is not None:
        kept = {name: a for name, a in events.fields.items() if name in fields}
        found = of_events(events.fields, events.lane) | kept
        whole.events = Events(events.t, events.index, events.direction, events.lane, found)
    return whole
