"""One step of a collocation method, on the stage relation of a Lagrangian or of a relation between x and ẋ."""

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.program.tracing import gradient, once
from dirax.schemes.abstract_step import AbstractStep
from dirax.schemes.collocation_tables import Tableau
from dirax.schemes.labels import Labels
from dirax.schemes.layout import Layout
from dirax.schemes.stage_relation import StageRelation
from dirax.schemes.step import Field, StepEquation
from dirax.systems.forms import RelationForm
from dirax.systems.lagrange_dirac import LagrangeDirac

AT_NODE = "equation {} at node"


@dataclass(frozen=True, eq=False)
class CollocationStep(AbstractStep):
    """The equations of a stage relation at every node; `n` is the length of y."""

    tableau: Tableau
    n: int

    @abstractmethod
    def rates(self, a: Float[Array, " n"], y: Float[Array, " n"], t: Any, params: Any) -> Float[Array, " b"]:
        """ḃ."""

    @abstractmethod
    def relation(self, a: Array, b: Array, y: Array, t: Any, params: Any) -> Float[Array, " n"]:
        """ρ, zero at the right y."""

    @property
    def unknowns(self) -> Layout:
        return Layout(**{f"rate_{i + 1}": self.n for i in range(self.tableau.stages)})

    @property
    def labels(self) -> Labels:
        return sum((Labels.numbered(f"{AT_NODE} {j + 1}", self.n) for j in range(self.tableau.stages)), Labels())

    @once
    def nodes(self, u, state, t, h, params) -> tuple[list, list, list, list]:
        """(time, y, a, ḃ) at every node."""
        times = [t + c * h for c in self.tableau.nodes.tolist()]
        y = list(self.unknowns.split(u))
        a = [state[: self.n] + h * combined(row, y) for row in self.tableau.matrix.tolist()]
        return times, y, a, [self.rates(*at, params) for at in zip(a, y, times, strict=True)]

    def residual(self, u, state, t, h, params):
        times, y, a, rates = self.nodes(u, state, t, h, params)
        rows = []
        for i, row in enumerate(self.tableau.conjugate.tolist()):
            b = state[self.n :] + h * combined(row, rates)
            rows.append(self.relation(a[i], b, y[i], times[i], params))
        return jnp.concatenate(rows)

    def advance(self, u, state, t, h, params):
        _, y, _, rates = self.nodes(u, state, t, h, params)
        weights = self.tableau.weights.tolist()
        return state + h * jnp.concatenate([combined(weights, y), combined(weights, rates)])

    @property
    def interpolation(self):
        return self.interpolate

    @abstractmethod
    def node(self, state: Array, params: Any) -> dict[str, Array]:
        """The fields of nodes at a state."""

    def interpolate(self, theta, u, state, t, h, params):
        """At state + h Σ_j ∫_0^θ ℓ_j (ȧ_j, ḃ_j)."""
        _, y, _, rates = self.nodes(u, state, t, h, params)
        shares = self.tableau.integrals(theta)
        return self.node(state + h * jnp.concatenate([combined(shares, y), combined(shares, rates)]), params)

    def equation(self) -> StepEquation:
        """The StepEquation, which says that it is made of stages where one matrix is that of all of the state."""
        if not np.allclose(self.tableau.conjugate, self.tableau.matrix, rtol=0.0, atol=1e-12):
            return super().equation()
        stage = StageRelation(self.n, self.state.size - self.n, self.rates, self.relation, self.tableau)
        return replace(super().equation(), collocation=stage)


@dataclass(frozen=True, eq=False)
class LagrangianCollocation(CollocationStep):
    """ṗ = ∂L/∂q + f, p = ∂L/∂v, q̇ = v: state (q, p), with forces the work too; unknowns the velocities at the nodes."""

    system: LagrangeDirac

    @property
    def state(self) -> Layout:
        return Layout(q=self.n, p=self.n, work=int(self.system.forces is not None))

    @property
    def canonical(self) -> bool:
        return True

    @property
    def fields(self) -> dict[str, Field]:
        work = {"work": Field((), "node", (), "work of the forces since the start")}
        return {"q": Field((self.n,)), "p": Field((self.n,))} | (work if self.system.forces is not None else {})

    def rates(self, a, y, t, params):
        slope = gradient(lambda q: self.system.lagrangian.at(t, q, y, params))(a)
        if self.system.forces is None:
            return slope
        force = self.system.forces(t, a, y, params)
        return jnp.concatenate([slope + force, (force @ y)[None]])

    def relation(self, a, b, y, t, params):
        return b[: self.n] - self.system.legendre(a, y, params, t)

    def start(self, data, h, params):
        if "q0" in data:
            raise ValueError("collocation is a one-step method: start it from q= with v= or p=, not from two points.")
        return self.state.join(q=data["q"], p=data["p"]), jnp.tile(data["v"], self.tableau.stages)

    def unpack(self, state, u, t, h, params):
        return self.node(state, params)

    def node(self, state, params):
        q, p, work = self.state.split(state)
        return {"q": q, "p": p} | ({"work": work[0]} if self.system.forces is not None else {})


@dataclass(frozen=True, eq=False)
class RelationCollocation(CollocationStep):
    """A relation between x and ẋ: state x, unknowns ẋ at the nodes."""

    form: RelationForm

    @property
    def state(self) -> Layout:
        return Layout(x=self.n)

    @property
    def canonical(self) -> bool:
        return self.form.canonical

    @property
    def fields(self) -> dict[str, Field]:
        return {name: Field((self.n,)) for name in self.form.names}

    def rates(self, a, y, t, params):
        return jnp.zeros(0)

    def relation(self, a, b, y, t, params):
        return self.form.residual(a, y, jnp.zeros(0), t, params)

    def start(self, data, h, params):
        if "x" not in data:
            raise ValueError("this scheme is a one-step method in x: start it from one point, not from two.")
        return data["x"], jnp.tile(data["velocity"], self.tableau.stages)

    def unpack(self, state, u, t, h, params):
        return self.node(state, params)

    def node(self, state, params):
        return self.form.node(state, params)


def combined(coefficients: list[Any], vectors: list[Float[Array, " n"]]) -> Float[Array, " n"]:
    """Σ coefficient·vector."""
    total = coefficients[0] * vectors[0]
    for coefficient, vector in zip(coefficients[1:], vectors[1:], strict=True):
        total = total + coefficient * vector
    return total
