"""Generalized Dirac systems (D, 𝓛): a Dirac structure and a Lagrangian submanifold of T*M."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dirax.geometry.lagrangian_submanifolds import LagrangianSubmanifold
from dirax.geometry.representations import KERNEL_PAIRS
from dirax.geometry.structures import DiracStructure
from dirax.numerics.arrays import Data, Numbers
from dirax.program.roots import nearest_root
from dirax.program.tracing import gradient, jacobian
from dirax.systems.forms import ImplicitForm, RelationForm
from dirax.systems.implicit_form import names
from dirax.systems.magnitudes import as_large_as_energy, of_solution
from dirax.systems.premise import Premise
from dirax.systems.shape import Shape
from dirax.systems.system import AbstractSystem


class GeneralizedDiracSystem(AbstractSystem):
    """The generalized Dirac system (D, 𝓛): (ẋ, α) ∈ D_x with α ∈ 𝓛 over x ([BLM] §3), 𝓛 any Lagrangian submanifold of T*M.

    `structure`: a `dx.DiracStructure` on M, coordinates x (N,), integrable or not; `submanifold`: a `dx.LagrangianSubmanifold`.
    With 𝓛 the graph of dH it is the `dx.DiracSystem` of H; with that of a Lagrangian, singular or not, and D induced by Δ on
    T*Q, the Lagrange–Dirac system; with F = H(x) + ⟨s, g(x)⟩ the system constrained to g = 0. The unknowns of a step are ẋ and
    the parameters s (k,) of the Morse family F(x, s), which are saved as `multipliers`; its energy is F.

        D, L = dx.induced_dirac(W, 2), lambda q, v: v @ v / 2 - q[0]
        system = dx.GeneralizedDiracSystem(D, dx.LagrangianSubmanifold.from_lagrangian(L, 2))

    Data are x=, or q=, p= with x = (q, p); of a Lagrangian q=, v= too, which give p and s = v. `dx.constraint_algorithm` works on
    (x, s). Raises `TypeError` for other kinds of objects, and `ValueError` for functions and data of wrong shapes, and where the
    matrices are those of no Dirac structure or F is no Morse family at the initial point; `verify` asks it along the way.
    """

    structure: DiracStructure
    submanifold: LagrangianSubmanifold

    def __init__(self, structure: DiracStructure, submanifold: LagrangianSubmanifold):
        if not isinstance(structure, DiracStructure):
            raise TypeError(f"structure must be a dx.DiracStructure, but a {type(structure).__name__} was given.")
        if not isinstance(submanifold, LagrangianSubmanifold):
            raise TypeError(
                f"submanifold must be a dx.LagrangianSubmanifold, but a {type(submanifold).__name__} was given: "
                "dx.LagrangianSubmanifold.from_hamiltonian(H), from_lagrangian(L, n) or from_morse_family(F, k)."
            )
        self.structure, self.submanifold = structure, submanifold

    def relation(
        self, x: Float[Numbers, " N"], velocity: Float[Numbers, " N"], s: Float[Numbers, " k"], t: Any, params: Any = None
    ) -> Float[Numbers, " N+k"]:
        """(F ẋ + E ∂F/∂x(x, s), ∂F/∂s(x, s)) for D = {F v + E α = 0}."""
        F, E = self.structure.kernel(x, params)
        balance = jnp.asarray(F @ velocity + E @ self.submanifold.covector(x, s, params))
        return jnp.concatenate([balance, self.submanifold.defect(x, s, params)]) if self.submanifold.parameters else balance

    def relation_form(self, shape: Shape) -> RelationForm:
        k = self.submanifold.parameters
        labels = tuple(f"derivative of the Morse family by s[{a}]" for a in range(k))
        return RelationForm(self.relation, k, labels, k, axis="parameter", dirac="(ẋ, α) ∈ D, α ∈ 𝓛")

    def implicit_form(self, near: Any, params: Any) -> ImplicitForm:
        """On (x, s): F ẋ = −E ∂F/∂x, 0 = ∂F/∂s, with ṡ free of them."""
        named = near if isinstance(near, dict) else {"x": near}
        given: Data = {name: jnp.asarray(value, dtype=float) for name, value in named.items()}
        N, k = self.sizes(given, params)
        self.check(given, params)
        found = self.complete(given, params, False)

        def equations(z, params):
            x, s = z[:N], z[N:]
            F, E = map(jnp.asarray, self.structure.kernel(x, params))
            matrix = jnp.zeros((N + k, N + k)).at[:N, :N].set(F)
            return matrix, jnp.concatenate([-E @ self.submanifold.covector(x, s, params), self.submanifold.defect(x, s, params)])

        energy = lambda z, params: self.submanifold.family(z[:N], z[N:], params)
        point = np.concatenate([np.asarray(found["x"]), np.asarray(found["guess"])])
        return ImplicitForm(equations, point, (*names("x", N), *names("s", k)), (), energy, "F ẋ = −E ∂F/∂x, ∂F/∂s = 0")

    # ------------------------------------------------------------------ AbstractSystem

    def point(self, data: Data) -> Float[Numbers, " N"]:
        """x of initial data without parameters; raises as `started`."""
        return self.started(data, None)[0]

    def started(self, data: Data, params: Any) -> tuple[Float[Numbers, " N"], Float[Numbers, " k"]]:
        """x of initial data and a first guess of s, zero where nothing is known `about` it. Raises `ValueError` for other data
        than x, q and p, or a Lagrangian's q and v."""
        given, k, lagrangian = set(data) - {"t", "about"}, self.submanifold.parameters, self.submanifold.lagrangian
        if given == {"q", "v"} and lagrangian is not None:
            q, v = data["q"], data["v"]
            if q.shape != (k,) or v.shape != (k,):
                raise ValueError(f"q and v must have shape ({k},), the n of from_lagrangian, but have {q.shape} and {v.shape}.")
            return jnp.concatenate([q, gradient(lambda v: lagrangian(q, v, params))(v)]), v
        if "x" not in given and given != {"q", "p"}:
            way = " (or q=, v=)" if lagrangian is not None else ""
            raise ValueError(
                f"a GeneralizedDiracSystem starts from x= or q=, p=, x = (q, p){way}, but {', '.join(sorted(given))} were given."
            )
        x = data["x"] if "x" in data else jnp.concatenate([data["q"], data["p"]])
        if lagrangian is not None and x.shape != (2 * k,):
            raise ValueError(f"x = (q, p) must have shape ({2 * k},), 2n of from_lagrangian, but its shape is {x.shape}.")
        return x, data.get("about", jnp.zeros(k))

    def sizes(self, data: Data, params: Any) -> tuple[int, int]:
        """(N, k)."""
        k = self.submanifold.parameters
        x, s = jax.eval_shape(lambda data: self.started(data, params), data)
        out = self.submanifold.family.shape(x, s, params)
        if out.shape != ():
            raise ValueError(f"{self.submanifold.family.name} must return a scalar, but it returned shape {out.shape}.")
        N = self.structure.n or jax.eval_shape(lambda x: self.structure.kernel(x, params), x)[0].shape[0]
        if x.shape[0] != N:
            raise ValueError(f"the Dirac structure has dimension {N}, but x has {x.shape[0]} entries.")
        return x.shape[0], k

    @property
    def premise_everywhere(self) -> bool:
        return True

    def premise(self, data: Data, params: Any) -> Premise:
        """The matrices are those of a Dirac structure, and F(x, s) is a Morse family: [∂²F/∂s∂x, ∂²F/∂s∂s] has full rank."""
        return Premise(self._matrices_and_slopes, self._refuse)

    def _matrices_and_slopes(self, data, params):
        start = {name: data[name] for name in ("x", "q", "p", "v") if name in data}
        found = self.complete(start, params, False)
        x, s = found["x"], found["guess"]
        return self.structure.evaluate(x, params), x, s, self.submanifold.slopes(x, s, params)

    def _refuse(self, found):
        matrices, x, s, slopes = found
        KERNEL_PAIRS[self.structure.representation](*matrices)
        if len(s) and (rank := np.linalg.matrix_rank(slopes)) < len(s):
            raise ValueError(
                f"F(x, s) is no Morse family at the initial point x = {x}, s = {s}: [∂²F/∂s∂x, ∂²F/∂s∂s] has rank {rank} of "
                f"{len(s)} there; leave out parameters."
            )

    def complete(self, data: Data, params: Any, project: bool) -> Data:
        """x, ẋ and the parameters s as the first `guess` of the multipliers."""
        x, s = self.started(data, params)
        N = x.shape[0]
        found = nearest_root(lambda u: self.relation(x, u[:N], u[N:], 0.0, params), jnp.concatenate([jnp.zeros(N), s]))
        return {"x": x, "velocity": found[:N], "guess": found[N:]}

    def initial_defect(self, data: Data, params: Any) -> Float[Numbers, " N+k"]:
        """What of (F ẋ + E ∂F/∂x, ∂F/∂s) no ẋ and s make zero: x is on M_0 where it vanishes."""
        return self.relation(data["x"], data["velocity"], data["guess"], 0.0, params)

    def sizes_of_data(self, data: Data, params: Any) -> Data:
        """Each number of (x, s) as large as all of F makes it, and of (ẋ, s) those that are zero up to roundoff of the others."""
        x, s = data["x"], data["guess"]
        N, both, found = x.shape[0], jnp.concatenate([x, s]), jnp.concatenate([data["velocity"], s])
        slope = gradient(lambda z: self.submanifold.family(z[:N], z[N:], params))
        energetic = as_large_as_energy(slope, both)
        solved = of_solution(lambda: jacobian(lambda u: self.relation(x, u[:N], u[N:], 0.0, params))(found), found)
        sizes = {name: jnp.abs(a) for name, a in data.items()}
        return sizes | {"x": sizes["x"] + energetic[:N], "velocity": solved[:N], "guess": solved[N:] + energetic[N:]}

    @property
    def searches_near(self) -> tuple[str, ...]:
        return ("multipliers",)

    def energy_at(self, row: Data, params: Any) -> Float[Numbers, ""]:
        """F(x, s) for the s over x."""
        found = self._found(row, params)
        return self.submanifold.family(found["x"], found["guess"], params)

    def constraint_at(self, row: Data, params: Any) -> Float[Numbers, " N+k"]:
        """The defect of x, as in `initial_defect`."""
        return self.initial_defect(self._found(row, params), params)

    def _found(self, row, params):
        """What is complete over the x of a row, with the s near those that its step had."""
        return self.complete({name: row[name] for name in ("x", "about") if name in row}, params, False)

    @property
    def projected(self) -> str:
        return ""

    @property
    def constrains_differential(self) -> bool:
        return True

    @property
    def has_constraint_sizes(self) -> bool:
        return True

    def constraint_sizes_at(self, row: Data, params: Any) -> Float[Numbers, " N+k"]:
        """The terms of F ẋ + E ∂F/∂x: those of a two-form cancel, and are as large as it is. Of ∂F/∂s no more is known."""
        found = self._found(row, params)
        F, E = (jnp.abs(jnp.asarray(a)) for a in self.structure.kernel(found["x"], params))
        covector = self.submanifold.covector(found["x"], found["guess"], params)
        terms = F @ jnp.abs(found["velocity"]) + E @ jnp.abs(covector)
        return jnp.concatenate([terms, jnp.zeros(self.submanifold.parameters)])
