"""One step of energy-preserving collocation of a Hamiltonian with a bracket, with ports too."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from dirax.numerics.sparse import FEWEST_SPARSE
from dirax.numerics.tolerances import STRUCTURE_DEFECT
from dirax.program.linear_solves import solve
from dirax.program.roots import nearest_root
from dirax.program.tracing import jacobian
from dirax.program.user_functions import evaluated
from dirax.schemes.energy_collocation_step import EnergyCollocationStep
from dirax.schemes.layout import Layout
from dirax.schemes.step import Field
from dirax.systems.forms import EnergyForm, RelationForm

DIRECTIONS = 3
"""Covectors at random that a bracket of many coordinates is tried with: one finds any defect, except by chance."""


@dataclass(frozen=True, eq=False)
class HamiltonianEnergyCollocation(EnergyCollocationStep):
    """(ẋ, dH) in a Dirac structure that is a graph, with ports: dH replaced by its means in the energy form's relation."""

    relation: RelationForm
    form: EnergyForm
    n: int

    @property
    def moving(self) -> int:
        return self.n

    @property
    def sparse(self) -> bool:
        return self.n >= FEWEST_SPARSE

    @property
    def state(self) -> Layout:
        return Layout(x=self.n, work=2 * int(self.form.ports is not None), energy=(), energy_defect=())

    @property
    def fields(self) -> dict[str, Field]:
        work = {"work": Field((2,), "node", ("work",), "energy supplied and energy dissipated since the start")}
        return {name: Field((self.n,)) for name in self.relation.names} | (work if self.form.ports else {}) | self.book

    def slopes(self, a, rate, t, params):
        return self.form.differential(a, params)

    def _rate(self, a, mean, t, params):
        """ẋ in the relation, where it is linear in ẋ."""
        defect = lambda rate: self.form.residual(a, rate, jnp.zeros(0), t, params, mean)
        zero = jnp.zeros(self.n)
        return nearest_root(defect, zero) if self.sparse else solve(jacobian(defect)(zero), -defect(zero))

    def _bracket(self, a, t, params):
        """Π of ẋ = Π dH (n, n)."""
        return jacobian(lambda mean: self._rate(a, mean, t, params))(jnp.zeros(self.n))

    def rates(self, a, mean, t, params):
        return self._with_books(a, self._rate(a, mean, t, params), mean, t, params)

    def rates_of_relation(self, a, rate, mean, t, params):
        return self.form.residual(a, rate, jnp.zeros(0), t, params, mean), self._with_books(a, rate, mean, t, params)

    def _with_books(self, a, rate, mean, t, params):
        out = [rate]
        if self.form.ports is not None:
            driven, outputs, loss = self.form.ports(t, a, mean, params)
            out += [(driven @ outputs)[None], loss[None]]
        return jnp.concatenate([*out, jnp.zeros(2)])

    def settle(self, before, after, rate, t, h, params):
        old, now = self.state.split(before), self.state.split(after)
        energy = self.form.hamiltonian(now.x, params)
        balance = (lambda change: change[0] - change[1])(now.work - old.work) if self.form.ports is not None else 0.0
        size = jnp.abs(energy) + jnp.abs(now.x) @ jnp.abs(self.form.differential(now.x, params))
        return self.state.join(**self.settled(before, after, energy, balance, size))

    def check(self, data, h, params):
        if self.form.ports is not None:
            return
        point = data["x"] if "x" in data else data["q"]
        x = np.asarray(point if len(point) == self.n else np.concatenate([point, data["p"]]), float)
        t = np.asarray(data.get("t", 0.0), float)
        if self.sparse:
            rate = lambda mean: self._rate(jnp.asarray(x), mean, t, params)
            along = np.random.default_rng(0).normal(size=(DIRECTIONS, self.n))
            terms = along * np.asarray(jax.lax.map(rate, jnp.asarray(along)))
            worst, scale = np.max(np.abs(np.sum(terms, axis=1))), np.max(np.abs(terms))
            defect = f"⟨α, Πα⟩ = {worst:.3g} for numbers α of size 1 at random"
        else:
            bracket = np.asarray(evaluated(self._bracket, x, t, params))
            worst, scale = np.max(np.abs(bracket + bracket.T)), np.max(np.abs(bracket))
            defect = f"max |Π + Πᵀ| = {worst:.3g}"
        if worst > STRUCTURE_DEFECT * scale:
            raise ValueError(
                f"the bracket Π of ẋ = Π dH is not antisymmetric at the initial point: {defect}, so that the energy is not "
                "kept. Put the symmetric part into R of a dx.PortHamiltonian."
            )

    def start(self, data, h, params):
        if "x" not in data:
            raise ValueError("this scheme is a one-step method in x: start it from one point, not from two.")
        x, t = data["x"], data.get("t", 0.0)
        rate = self._rate(x, self.slopes(x, x, t, params), t, params)
        return self.state.join(x=x, energy=self.form.hamiltonian(x, params)), jnp.tile(rate, self.tableau.stages)

    def node(self, state, params):
        now = self.state.split(state)
        row = self.relation.node(now.x, params) | {"energy_defect": now.energy_defect}
        return row | ({"work": now.work} if self.form.ports is not None else {})
