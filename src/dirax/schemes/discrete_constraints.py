"""The discrete constraint algorithm: the constraint algorithm for the difference equations of a scheme ([BLM] Remark 6.1).

One step of size h is a relation S_d ⊂ M × M between the state and the next. As in the continuous algorithm,

    M_{d,0} = the states that have a next one,   S_{d,k+1} = S_{d,k} ∩ (M_{d,k} × M_{d,k}),

until it repeats. How it is found is in `discrete_constraint_search`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.numerics.tolerances import CONSTRAINT_DEFECT
from dirax.program.user_functions import check_finite, is_traced
from dirax.schemes.discrete_constraint_search import SAMPLES, DiscreteConstraintSearch
from dirax.schemes.step import AbstractScheme, Shape, StepEquation, make_step_equation
from dirax.systems.constraint_algorithm import constraint_algorithm
from dirax.systems.constraint_chain import EMPTY, IRREGULAR, ConstraintChain, ConstraintLevel
from dirax.systems.system import AbstractSystem
from dirax.text.tables import text_table


@dataclass(frozen=True, eq=False)
class DiscreteConstraintChain:
    """The chain M_{d,0} ⊃ M_{d,1} ⊃ … ⊃ M_{d,f} of a scheme around a state; prints as a table.

    - `levels`: the manifolds of states, each with its new `constraints(state, params) -> (count,)`.
    - `verdict`: "determined", "gauge freedom", "empty" or "irregular", and `explanation` in words.
    - `freedom`: the number of undetermined directions of the next state on M_{d,f}.
    - `state` (s,) and `unknowns` (k,): a point of S_{d,f} (of the last level reached); `step` is h.
    - `continuous`: the chain of the system itself, None where it has none; `distance`: the largest of its constraints at
      nodes of M_{d,f}, NaN without; `agrees`: whether M_{d,f} is the final manifold M_f of the system.
    """

    levels: tuple[ConstraintLevel, ...]
    state: np.ndarray
    unknowns: np.ndarray
    step: float
    verdict: str
    explanation: str
    freedom: int
    continuous: ConstraintChain | None = field(repr=False)
    distance: float
    agrees: bool
    comparison: str
    params: Any = field(repr=False)

    @property
    def dimension(self) -> int:
        """The dimension of M_{d,f}; −1 where it is empty."""
        return -1 if self.verdict == EMPTY else self.levels[-1].dimension

    @property
    def empty(self) -> bool:
        """Whether no trajectory of the scheme passes near the given state."""
        return self.verdict == EMPTY

    def constraints(self, state: Float[Array, " s"], params: Any = None) -> Float[Array, " c"]:
        """All constraint functions of M_{d,f} at a state, level by level; traceable."""
        params = self.params if params is None else params
        return jnp.concatenate([jnp.zeros(0), *(level.constraints(state, params) for level in self.levels)])

    def to_dict(self) -> dict[str, Any]:
        """The table as plain Python values."""
        rows = [level.to_dict() for level in self.levels]
        keys = ("step", "verdict", "explanation", "freedom", "dimension", "distance", "agrees", "comparison")
        return {"levels": rows, **{key: getattr(self, key) for key in keys}}

    def __str__(self) -> str:
        header = ("level", "new constraints", "dim M_d,k", "rank of ∂(r, φ∘a)/∂u", "")
        rows = [(f"M_d,{v.number}", str(v.count), str(v.dimension), str(v.rank), v.note) for v in self.levels]
        return "\n".join([text_table(header, rows), f"{self.verdict}: {self.explanation}", self.comparison])


def discrete_constraint_algorithm(
    system: AbstractSystem,
    scheme: AbstractScheme,
    near: Any,
    step: float,
    params: Any = None,
    radius: float = 0.02,
) -> DiscreteConstraintChain:
    """The chain of constraint manifolds of the difference equations that `scheme` makes of `system`, with step size `step`.

    `near`: initial data as a dict such as {"q": …, "v": …}, or a point x (N,), not necessarily on any constraint;
    `radius`: size of the neighbourhood, relative to 1 + |x| in natural units, in which ranks are checked to be constant.

        print(dx.discrete_constraint_algorithm(system, dx.DiscreteDirac(), near={"q": q, "v": v}, step=0.01))

    The discrete chain need not be that of the system: Method 1 of a degenerate Lagrangian may be regular, so that every
    state has a next one, where the system itself lives on a smaller manifold ([BLM] Remark 6.1). `comparison` says which.
    Raises `TypeError` for a composition, and what the scheme raises; what is found is no exception but the `verdict`.
    """
    if is_traced(near, params):
        raise TypeError("discrete_constraint_algorithm inspects values: call it outside jax.jit.")
    if not step > 0:
        raise ValueError(f"step must be positive, but {step!r} was given.")
    if not 0 < radius < 1:
        raise ValueError(f"radius must lie between 0 and 1, but {radius!r} was given.")
    given = dict(near) if isinstance(near, Mapping) else {"x": near}
    check_finite("near", given)
    data = {name: jnp.asarray(value, float) for name, value in given.items()}
    equation = make_step_equation(scheme, system, Shape(*system.sizes(data, params)))
    system.check(data, params)
    if not isinstance(equation, StepEquation):
        raise TypeError(
            "the discrete constraint algorithm takes one equation a step, but the scheme is a composition of several."
        )
    begin = lambda data: equation.start(system.complete(data, params, False), jnp.asarray(float(step)), params)
    state, unknowns = jax.jit(begin)(data)
    search = DiscreteConstraintSearch(equation, np.asarray(state), np.asarray(unknowns), float(step), params, radius)
    verdict, explanation, freedom = search.run()
    try:
        continuous = constraint_algorithm(system, near, params)
    except (TypeError, ValueError):
        continuous = None
    distance, agrees, comparison = _compared(search, verdict, continuous)
    state, unknowns, levels = search.found()
    return DiscreteConstraintChain(
        levels=levels,
        state=state,
        unknowns=unknowns,
        step=float(step),
        verdict=verdict,
        explanation=explanation,
        freedom=freedom,
        continuous=continuous,
        distance=distance,
        agrees=agrees,
        comparison=comparison,
        params=params,
    )


def _compared(search: DiscreteConstraintSearch, verdict: str, chain: ConstraintChain | None) -> tuple[float, bool, str]:
    """(distance, agrees, comparison) of the discrete final manifold and that of the system."""
    if chain is None:
        return np.nan, False, "The system has no implicit form to compare with."
    if verdict == EMPTY or chain.empty:
        both = verdict == EMPTY and chain.empty
        return np.nan, both, "The system ends empty too." if both else f"The system itself ends {chain.verdict}."
    if verdict == IRREGULAR or chain.verdict == IRREGULAR:
        return np.nan, False, f"The chain of the system ends {chain.verdict}: the two are not compared."
    nodes = search.nodes(SAMPLES + 1)
    if len(nodes[0]) != len(chain.coordinates):
        return np.nan, False, f"The chain of the system is one of {', '.join(chain.coordinates)}: the two are not compared."
    distance = max(float(np.abs(np.asarray(chain.constraints(jnp.asarray(x)))).max(initial=0.0)) for x in nodes)
    on = distance <= CONSTRAINT_DEFECT * (1.0 + max(np.abs(x / chain.units[: len(x)]).max() for x in nodes))
    dimension = search.levels[-1].dimension
    if on and dimension == chain.dimension:
        return distance, True, f"M_d,f is M_f, of dimension {chain.dimension}: the nodes stay on it."
    if on:
        return distance, False, f"M_d,f lies in M_f, which has dimension {chain.dimension}."
    if dimension > chain.dimension:
        words = (
            f"M_f of the system has dimension {chain.dimension}: the scheme has trajectories off it, and is a method of "
            "its own on the larger manifold."
        )
    else:
        words = (
            f"M_f has the dimension {chain.dimension} too, but is another manifold: the nodes are off it by up to "
            f"{distance:.2g}, less with a shorter step."
        )
    return distance, False, words
