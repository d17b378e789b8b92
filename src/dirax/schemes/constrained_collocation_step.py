"""One step at Lobatto nodes of a Lagrangian with constraints: the pair IIIA–IIIB, with the constraints at every node."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.program.linear_solves import solve
from dirax.program.tracing import along, gradient, jacobian, once
from dirax.schemes.abstract_step import AbstractStep
from dirax.schemes.collocation_step import combined
from dirax.schemes.collocation_tables import Tableau
from dirax.schemes.constraint_rows import ConstraintRows
from dirax.schemes.labels import Labels
from dirax.schemes.layout import Layout
from dirax.schemes.step import Field
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.shape import Shape


class Nodes(NamedTuple):
    """What holds at the nodes of a step, a list of one entry a node each."""

    times: list
    q: list
    v: list
    rates: list
    """ṗ = ∂L/∂q + f − [W; G]ᵀλ."""
    works: list
    """The power of the forces."""


@dataclass(frozen=True, eq=False)
class ConstrainedCollocation(AbstractStep):
    """Q_i = q_k + h Σ_j a_ij V_j with the matrix of Lobatto IIIA, ∂L/∂v(Q_i, V_i) = p_k + h Σ_j â_ij Ṗ_j with that of IIIB, and
    p_{k+1} = p_k + h Σ_i b_i Ṗ_i, where Ṗ_i = ∂L/∂q + f − Wᵀ λ_i − Gᵀ μ_i.

    Holonomic constraints: g(Q_i) = 0 at every node, and G q̇ + ∂g/∂t = 0 at the end for the velocity of p_{k+1} (Jay 1996;
    Hairer, Lubich, Wanner, VII.1.4), symplectic on the constraint manifold. The last column of â is zero, so that μ_s acts on
    p_{k+1} alone. Two stages are RATTLE.

    One-forms: W v̂_i + b = 0 at every node for the velocity v̂_i that belongs to p_k + h Σ_j a_ij Ṗ_j, with the matrix of IIIA;
    λ_1 is λ_s of the step before, which the state carries (Jay's SPARK methods; Sato Martín de Almagro, arXiv 1810.10926).

    Saved are `multipliers`, h Σ_i b_i (λ_i, μ_i), and `reactions`, the (λ_i, μ_i) of every node.
    """

    tableau: Tableau
    shape: Shape
    system: LagrangeDirac

    @property
    def n(self) -> int:
        """The number of coordinates."""
        return self.shape.n

    @cached_property
    def rows(self) -> ConstraintRows:
        """The constraints that enter the equations."""
        return ConstraintRows(self.system, self.shape)

    @property
    def forced(self) -> int:
        """How many numbers the work of the forces is: one, or none without forces."""
        return int(self.system.forces is not None)

    @property
    def fields(self) -> dict[str, Field]:
        stages, size = self.tableau.stages, self.shape.m + self.shape.c
        about = "Lagrange multipliers at the nodes of the step, per unit of time"
        found = {
            "q": Field((self.n,)),
            "p": Field((self.n,)),
            "multipliers": Field((size,), "step", ("constraint",), "Lagrange multipliers of the constraints", "sum"),
            "reactions": Field((stages, size), "step", ("node_of_step", "constraint"), about),
        }
        return found | ({"work": Field((), "node", (), "work of the forces since the start")} if self.forced else {})

    @property
    def state(self) -> Layout:
        return Layout(q=self.n, p=self.n, reaction=self.rows.nonholonomic, work=self.forced)

    @property
    def canonical(self) -> bool:
        return not self.forced and not self.rows.nonholonomic

    @property
    def ends(self) -> int:
        """At how many of the last nodes the velocity that belongs to p is wanted."""
        return self.tableau.stages - 1 if self.rows.nonholonomic else 1

    @property
    def unknowns(self) -> Layout:
        s, m, c = self.tableau.stages, self.rows.nonholonomic, self.rows.holonomic
        return Layout(velocities=(s, self.n), one_forms=(s - 1, m), holonomic=(s, c), constrained=(self.ends, self.n))

    @property
    def labels(self) -> Labels:
        s, m, c = self.tableau.stages, self.rows.nonholonomic, self.rows.holonomic
        at = lambda name, count, nodes: sum((Labels.numbered(f"{name} at node {j}", count) for j in nodes), Labels())
        inner, later = at("equation {}", self.n, range(1, s + 1)), range(2, s + 1)
        momenta = at("momentum {}", self.n, range(s + 1 - self.ends, s + 1))
        rates = at("constraint {}", m, later) + Labels.numbered("rate of constraint {} at the end", c)
        return inner + at("holonomic constraint {}", c, later) + momenta + rates

    def reactions(self, u: Array, state: Array) -> list[Float[Array, " k"]]:
        """(λ_i, μ_i) at every node."""
        found = self.unknowns.split(u)
        pulls = [self.state.split(state).reaction, *found.one_forms]
        return [jnp.concatenate(both) for both in zip(pulls, found.holonomic, strict=True)]

    @once
    def slope(self, t, q, v, params):
        """∂L/∂q + f, and the power of f."""
        slope = gradient(lambda q: self.system.lagrangian.at(t, q, v, params))(q)
        if self.system.forces is None:
            return slope, jnp.zeros(())
        force = self.system.forces(t, q, v, params)
        return slope + force, force @ v

    @once
    def nodes(self, u, state, t, h, params) -> Nodes:
        """The nodes of a step."""
        times = [t + c * h for c in self.tableau.nodes.tolist()]
        v = list(self.unknowns.split(u).velocities)
        start = self.state.split(state).q
        q = [start + h * combined(row, v) for row in self.tableau.matrix.tolist()]
        rates, works = [], []
        for at, place, velocity, pull in zip(times, q, v, self.reactions(u, state), strict=True):
            slope, work = self.slope(at, place, velocity, params)
            rates.append(slope - self.rows.matrix(at, place, params).T @ pull)
            works.append(work)
        return Nodes(times, q, v, rates, works)

    def momenta(self, matrix, state, nodes: Nodes, h) -> list[Float[Array, " n"]]:
        """p_k + h Σ_j a_ij Ṗ_j for the rows of a matrix."""
        return [self.state.split(state).p + h * combined(row, nodes.rates) for row in matrix.tolist()]

    def inner(self, nodes: Nodes, state, h, params) -> list[Float[Array, " n"]]:
        """P_i − ∂L/∂v(Q_i, V_i)."""
        given = self.momenta(self.tableau.conjugate, state, nodes, h)
        parts = zip(given, nodes.q, nodes.v, nodes.times, strict=True)
        return [p - self.system.legendre(q, v, params, t) for p, q, v, t in parts]

    def residual(self, u, state, t, h, params):
        nodes, velocities = self.nodes(u, state, t, h, params), list(self.unknowns.split(u).constrained)
        places = list(zip(nodes.times, nodes.q, strict=True))
        # a step moves g by about h² μ, so that g/h and not g is of the size of the other equations
        positions = [self.rows.position(at, q, params) / h for at, q in places[1:]] if self.rows.holonomic else []
        momenta, rates = [], []
        for row, v, (at, q) in zip(self.tableau.matrix[-self.ends :], velocities, places[-self.ends :], strict=True):
            (p,) = self.momenta(row[None], state, nodes, h)
            momenta.append(p - self.system.legendre(q, v, params, at))
            rates.append(self.rows.velocity_defect(at, q, v, params))
        rates = [*(rate[: self.rows.nonholonomic] for rate in rates[:-1]), rates[-1]]
        return jnp.concatenate([*self.inner(nodes, state, h, params), *positions, *momenta, *rates])

    def advance(self, u, state, t, h, params):
        nodes, now, weights = self.nodes(u, state, t, h, params), self.state.split(state), self.tableau.weights.tolist()
        moved = {"q": now.q + h * combined(weights, nodes.v), "p": now.p + h * combined(weights, nodes.rates)}
        if self.rows.nonholonomic:
            moved["reaction"] = self.unknowns.split(u).one_forms[-1]
        return self.state.join(**moved, **({"work": now.work + h * combined(weights, nodes.works)} if self.forced else {}))

    @property
    def interpolation(self):
        return self.interpolate

    def interpolate(self, theta, u, state, t, h, params):
        """q and p by the integrals of the velocities and of Ṗ at the nodes."""
        nodes, now, shares = self.nodes(u, state, t, h, params), self.state.split(state), self.tableau.integrals(theta)
        found = {"q": now.q + h * combined(shares, nodes.v), "p": now.p + h * combined(shares, nodes.rates)}
        return found | ({"work": now.work[0] + h * combined(shares, nodes.works)} if self.forced else {})

    def first_reaction(self, data, params) -> Float[Array, " k"]:
        """λ of the equations of motion at the initial data: the one that keeps W v + b = 0 and G v + ∂g/∂t = 0."""
        t, q, v = jnp.asarray(data.get("t", 0.0), float), data["q"], data["v"]
        momentum = lambda t, q: self.system.legendre(q, v, params, t)
        here, ahead = (t, q), (jnp.ones(()), v)
        free = self.slope(t, q, v, params)[0] - along(momentum, here, ahead)
        drift = along(lambda t, q: self.rows.velocity_defect(t, q, v, params), here, ahead)
        matrix = self.rows.matrix(t, q, params)
        hessian = jacobian(lambda v: self.system.legendre(q, v, params, t))(v)
        solved = solve(hessian, jnp.concatenate([free[:, None], matrix.T], axis=1))
        return solve(matrix @ solved[:, 1:], matrix @ solved[:, 0] + drift)

    def start(self, data, h, params):
        if "q0" in data:
            raise ValueError("collocation is a one-step method: start it from q= with v= or p=, not from two points.")
        s, m, v, pull = self.tableau.stages, self.rows.nonholonomic, data["v"], self.first_reaction(data, params)
        guess = {"velocities": jnp.tile(v, (s, 1)), "constrained": jnp.tile(v, (self.ends, 1))}
        pulls = {"one_forms": jnp.tile(pull[:m], (s - 1, 1)), "holonomic": jnp.tile(pull[m:], (s, 1))}
        return self.state.join(q=data["q"], p=data["p"], reaction=pull[:m]), self.unknowns.join(**guess, **pulls)

    def resume(self, data, h, params):
        """With the λ_1 that was saved, where it was, and not with that of the equations of motion."""
        state, u = self.start(data, h, params)
        if "reactions" in data:
            state = self.state.replace(state, reaction=self.rows.pick(data["reactions"][0])[: self.rows.nonholonomic])
        return state, u

    def unpack(self, state, u, t, h, params):
        now, reactions = self.state.split(state), self.reactions(u, state)
        impulse = h * combined(self.tableau.weights.tolist(), reactions)
        nodes = jnp.stack([self.rows.all(pull) for pull in reactions])
        row = {"q": now.q, "p": now.p, "multipliers": self.rows.all(impulse), "reactions": nodes}
        return row | ({"work": now.work[0]} if self.forced else {})
