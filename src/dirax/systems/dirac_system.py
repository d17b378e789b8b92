"""Dirac systems: a Dirac structure and a Hamiltonian, ẋ ⊕ dH(x) ∈ D_x."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dirax.functions import UserFunction
from dirax.geometry.structures import DiracStructure
from dirax.systems.system import AbstractSystem

RANK_TOLERANCE = 1e-10
"""Singular values of the kernel matrix F below this, relative to the largest, count as zero in the initial check."""


class DiracSystem(AbstractSystem):
    """The Dirac system (D, H): ẋ ⊕ dH(x) ∈ D_x ([BLM] §3), with D = {F(x) ẋ + E(x) dH(x) = 0} in kernel form.

    `structure`: a `DiracStructure` in coordinates x (N,), integrable or not; `hamiltonian(x[, params])` returns a scalar.
    On a submanifold such as the sphere, x are ambient coordinates, and the discretization map names the manifold.

        so3 = dx.DiracStructure.from_bivector(lambda x: jnp.cross(x, jnp.eye(3), axisb=0, axisc=0))
        body = dx.DiracSystem(so3, lambda x: x @ (x / jnp.array([1.0, 2.0, 3.0])) / 2)

    Raises `TypeError` where `structure` is not a DiracStructure or `hamiltonian` not a function of x.
    """

    structure: DiracStructure
    hamiltonian: UserFunction

    def __init__(self, structure: DiracStructure, hamiltonian: Callable):
        if not isinstance(structure, DiracStructure):
            raise TypeError(
                f"structure must be a dx.DiracStructure, but a {type(structure).__name__} was given: "
                "use one of its constructors, e.g. dx.DiracStructure.from_bivector(lambda x: …)."
            )
        self.structure = structure
        self.hamiltonian = UserFunction(hamiltonian, "hamiltonian", ("x",))

    def differential(self, x: Float[Array, " N"], params: Any = None) -> Float[Array, " N"]:
        """dH(x)."""
        return jax.grad(lambda x: self.hamiltonian(x, params))(x)

    def relation(
        self,
        x: Float[Array, " N"],
        velocity: Float[Array, " N"],
        multipliers: Float[Array, "0"],
        t: Any,
        params: Any = None,
        differential: Float[Array, " N"] | None = None,
    ) -> Float[Array, " N"]:
        """F(x) ẋ + E(x) dH(x), zero iff (ẋ, dH(x)) ∈ D_x; `differential` replaces dH(x)."""
        F, E = self.structure.kernel(x, params)
        return jnp.asarray(F @ velocity + E @ (self.differential(x, params) if differential is None else differential))

    def sizes(self, data: dict[str, Array], params: Any) -> tuple[int, int]:
        x = data["x"] if "x" in data else jnp.concatenate([data["q"], data["p"]]) if "p" in data else None
        if x is None:
            raise ValueError(f"a DiracSystem starts from x= (or q=, p= with x = (q, p)), but {', '.join(data)} were given.")
        out = self.hamiltonian.shape(x, params)
        if out.shape != ():
            raise ValueError(f"hamiltonian must return a scalar, but for x of shape {x.shape} it returned shape {out.shape}.")
        F, _ = jax.eval_shape(lambda x: self.structure.kernel(x, params), x)
        if F.shape != (x.size, x.size):
            raise ValueError(
                f"the Dirac structure has dimension {F.shape[0]}, but x has {x.size} entries"
                + (f": {self.structure.ports} ports are open; connect them by `compose`." if self.structure.ports else ".")
            )
        return x.size, 0

    def complete(self, data: dict[str, Array], params: Any, project: bool) -> dict[str, Array]:
        x = data["x"] if "x" in data else jnp.concatenate([data["q"], data["p"]])
        F, E = self.structure.kernel(x, params)
        velocity = -jnp.linalg.pinv(F, rtol=RANK_TOLERANCE) @ (E @ self.differential(x, params))
        return {"x": x, "velocity": velocity}

    def initial_defect(self, data: dict[str, Array], params: Any) -> Float[Array, " N"]:
        """The part of F ẋ + E dH that no velocity makes zero: x is on M_0 where it vanishes."""
        return self.relation(data["x"], data["velocity"], jnp.zeros(0), 0.0, params)

    def energy_at(self, row: dict[str, Array], params: Any) -> Float[Array, ""]:
        """H(x)."""
        return self.hamiltonian(row["x"], params)

    def constraint_at(self, row: dict[str, Array], params: Any) -> Float[Array, " N"]:
        """The defect of x ∈ M_0, as in `initial_defect`."""
        return self.initial_defect(self.complete({"x": row["x"]}, params, False), params)
