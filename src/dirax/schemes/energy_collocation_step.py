"""One step of energy-preserving collocation: the equations of a mean relation at every node, and the book of the energy."""

import warnings
from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.program.tracing import once
from dirax.schemes.abstract_step import AbstractStep
from dirax.schemes.collocation_step import AT_NODE
from dirax.schemes.collocation_tables import Quadrature, Tableau
from dirax.schemes.labels import Labels
from dirax.schemes.layout import Layout
from dirax.schemes.stage_relation import MeanRelation
from dirax.schemes.step import Field, StepEquation

NOTICED = 1e-11
"""Changes of the energy in a step, relative to its terms, from which on they are more than roundoff of the rows, whose angles may
have run to 10⁶."""

GIVEN_BACK = 1e-9
"""Changes of the energy in a step, relative to its terms, up to which they are given back in the momenta, so that they do not
add up over many steps: roundoff, and what is left near a place where the equations are nearly singular."""

FAR = 1e-3
"""The part of |∂L/∂q| |q| that counts among the terms of the energy: far from the origin a last place of q changes the energy by
more than roundoff of the others, by ε |∂L/∂q| |q|, and this lets no more than that pass."""

STEEP = 1e-3
"""Of the terms of the energy, ⟨p, v⟩ below which little is given back."""


@dataclass(frozen=True, eq=False)
class EnergyCollocationStep(AbstractStep):
    """The equations of a mean relation at every node: state (a, b), a of length `moving`.

    Every state ends with its energy and its `energy_defect`, the largest change of H in a step that is not the work of that
    step, relative to the sizes of the terms of H: what the quadrature leaves, and roundoff.

    Of few coordinates the rates at the nodes are all unknowns, and each equation gives one of them. Where `sparse`, what a matrix
    would have to be inverted for is not written out, so that an equation has few unknowns: the rates are those that the
    relation of the system holds for, and what the slopes are taken at beside a, `inner` numbers at each point of the quadrature
    and at the end, are unknowns too.
    """

    tableau: Tableau
    quadrature: Quadrature

    @property
    @abstractmethod
    def moving(self) -> int:
        """The length of a."""

    @property
    def inner(self) -> int:
        """How many unknowns there are at every point beside the rates."""
        return 0

    @property
    def sparse(self) -> bool:
        """Whether the unknowns are so many that no matrix is to be inverted in their equations."""
        return False

    @abstractmethod
    def slopes(self, a: Array, rate: Array, t: Any, params: Any) -> Float[Array, " g"]:
        """The derivatives of H at a point of the polynomial whose derivative there is `rate`, and what else is averaged. Where
        there are `inner` unknowns, these instead of the rate."""

    @abstractmethod
    def rates(self, a: Array, mean: Float[Array, " g"], t: Any, params: Any) -> Float[Array, " s"]:
        """(ȧ, ḃ) at a node, of the mean of the slopes."""

    def rates_of_relation(self, a: Array, rate: Array, mean: Array, t: Any, params: Any) -> tuple[Array, Array]:
        """What is zero (moving,) at the right rate at a node, of the mean of the slopes; and (ȧ, ḃ) (s,) there."""
        rates = self.rates(a, mean, t, params)
        return rate - rates[: self.moving], rates

    def of_inner(self, a: Array, inner: Array, t: Any, params: Any) -> Float[Array, " i"]:
        """Zero at the right inner unknowns of a point."""
        return inner

    @abstractmethod
    def settle(self, before: Array, after: Array, rate: Array, t: Any, h: Any, params: Any) -> Float[Array, " s"]:
        """What is added to the state at the end of a step that ends with this rate."""

    @property
    def unknowns(self) -> Layout:
        rates = {f"rate_{i + 1}": self.moving for i in range(self.tableau.stages)}
        return Layout(**rates, **{f"inner_{k + 1}": self.inner for k in range(len(self.quadrature.points) + 1) if self.inner})

    @property
    def labels(self) -> Labels:
        nodes = [(f"{AT_NODE} {j + 1}", 0, self.moving) for j in range(self.tableau.stages)]
        points = [(f"velocity {{}} at point {k + 1}", 0, self.inner) for k in range(len(self.quadrature.points) + 1)]
        return Labels([*nodes, *points])

    def _at_points(self, u, state, t, h) -> tuple[Array, Array, Array, Array]:
        """The rates at the nodes; at every point of the quadrature and at the end a, the rate or the inner unknowns, and t."""
        table, count = self.quadrature, self.tableau.stages * self.moving
        y, inner = u[:count].reshape(self.tableau.stages, -1), u[count:]
        points, values = np.append(table.points, 1.0), np.concatenate([table.values, table.end[None]])
        a = state[None, : self.moving] + h * (np.concatenate([table.matrix, self.tableau.weights[None]]) @ y)
        return y, a, inner.reshape(len(points), -1) if self.inner else values @ y, t + h * points

    @once
    def _nodes(self, u, state, t, h, params) -> tuple[Array, Array]:
        """What is zero (stages, moving) at the right rates of the nodes, and (ȧ, ḃ) (stages, s) there."""
        y, a, at, times = self._at_points(u, state, t, h)
        slopes = lambda a, rate, t: once(self.slopes)(a, rate, t, params)
        found = self.quadrature.means @ jax.vmap(slopes)(a[:-1], at[:-1], times[:-1])
        there = state[None, : self.moving] + h * (self.tableau.matrix @ y), found, t + h * self.tableau.nodes
        if self.sparse:
            relation = lambda a, mean, t, rate: once(self.rates_of_relation)(a, rate, mean, t, params)
            return jax.vmap(relation)(*there, y)
        rates = jax.vmap(lambda a, mean, t: once(self.rates)(a, mean, t, params))(*there)
        return y - rates[:, : self.moving], rates

    def residual(self, u, state, t, h, params):
        left = self._nodes(u, state, t, h, params)[0].ravel()
        if not self.inner:
            return left
        _, a, inner, times = self._at_points(u, state, t, h)
        of_inner = lambda a, inner, t: once(self.of_inner)(a, inner, t, params)
        return jnp.concatenate([left, jax.vmap(of_inner)(a, inner, times).ravel()])

    def advance(self, u, state, t, h, params):
        after = state + h * (self.tableau.weights @ self._nodes(u, state, t, h, params)[1])
        return after + once(self.settle)(state, after, self._at_points(u, state, t, h)[2][-1], t, h, params)

    @property
    def interpolation(self):
        return self.interpolate

    @abstractmethod
    def node(self, state: Array, params: Any) -> dict[str, Array]:
        """The fields of nodes at a state."""

    def unpack(self, state, u, t, h, params):
        return self.node(state, params)

    def lifted(self, place: Array, rate: Array, t: Any, params: Any) -> Float[Array, " s"]:
        """What is added to a place of the polynomial for the state that it stands for, with a rate near its own."""
        return jnp.zeros_like(place)

    def interpolate(self, theta, u, state, t, h, params):
        """At the integral of the polynomial of the rates, lifted, with its share of what else is settled at the end."""
        rates = self._nodes(u, state, t, h, params)[1]
        inner = state + h * (jnp.stack(self.tableau.integrals(theta)) @ rates)
        end = state + h * (self.tableau.weights @ rates)
        last = self._at_points(u, state, t, h)[2][-1]
        settled = once(self.settle)(state, end, last, t, h, params) - once(self.lifted)(end, last, t + h, params)
        return self.node(inner + once(self.lifted)(inner, last, t + theta * h, params) + theta * settled, params)

    def settled(self, before: Array, after: Array, energy: Any, work: Any, size: Any) -> dict[str, Array]:
        """The parts of what is added that belong to the energy at the end, with the work of the step and the size of the
        terms of the energy."""
        left = jnp.abs((energy - before[-2]) - work) / _divisor(size)
        return {"energy": energy - after[-2], "energy_defect": jnp.where(left > before[-1], left, before[-1]) - after[-1]}

    @property
    def book(self) -> dict[str, Field]:
        """The field that every step saves."""
        about = "largest change of the energy in a step, less its work, relative to the terms of the energy"
        return {"energy_defect": Field((), "node", (), about)}

    def review(self, fields):
        defect = float(np.nanmax(fields["energy_defect"], initial=0.0))
        if defect > NOTICED:
            warnings.warn(
                f"the energy changed by {defect:.1e} of the size of its terms in a step of dx.EnergyCollocation, more than "
                f"roundoff: the quadrature with {len(self.quadrature.points)} points is not exact for such steps, or one of them "
                "passed a place where the equations are nearly singular. Take smaller steps, or more points=.",
                stacklevel=4,
            )
        return {"energy_defect": defect}

    def equation(self) -> StepEquation:
        """The StepEquation, with the mean relation that it is made of, of few coordinates."""
        extra, functions = self.state.size - self.moving, (self.slopes, self.rates, self.settle)
        relation = None if self.sparse else MeanRelation(self.moving, extra, *functions, self.tableau, self.quadrature)
        return replace(super().equation(), collocation=relation)


def given_back(left: Any, power: Any, size: Any, terms: Any) -> tuple[Any, Any]:
    """What of the energy `left` out in a step is given back, and by which part of themselves the momenta p change for it, with
    `power` ⟨p, v⟩ and the `size` of the energy; `terms` are those by whose roundoff it is off."""
    kept = jnp.where(jnp.abs(left) <= GIVEN_BACK * terms, left, 0.0)
    return kept, kept * power / _divisor(power * power + (STEEP * size) ** 2)


def _divisor(terms: Any) -> Any:
    """The size of terms, 1 where all of them are zero, as at rest."""
    return jnp.where(terms > 0.0, terms, 1.0)
