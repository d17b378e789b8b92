"""Lie–Poisson systems: a Hamiltonian on the dual of a Lie algebra, or of a semidirect product."""

from collections.abc import Callable
from typing import Any

import jax
from jaxtyping import Array, Float

from dirax.geometry.lie_group import AbstractLieGroup, Algebra
from dirax.geometry.manifolds import AbstractManifold
from dirax.geometry.semidirect import Advected, SemidirectProduct
from dirax.geometry.structures import DiracStructure
from dirax.numerics.arrays import Data
from dirax.program.tracing import gradient
from dirax.program.user_functions import UserFunction
from dirax.systems.constraints import no_constraint
from dirax.systems.dirac_system import DiracSystem
from dirax.systems.forms import EnergyForm, RelationForm
from dirax.systems.shape import Shape
from dirax.systems.system import AbstractSystem


class LiePoisson(AbstractSystem):
    """A Hamiltonian h(μ, a) on the dual of 𝔤 ⋉ V: μ̇ = ad*_ξ μ + J(∂h/∂a, a), ȧ = −ξ·a, with ξ = ∂h/∂μ.

    `hamiltonian(mu[, a][, params])`, a scalar, takes a (r,) iff `advected` = r > 0; `group`, `advected`, `representation` and
    the state x = (μ, a) are those of `dx.EulerPoincare`. Stepped by `dx.DiscreteEulerPoincare`; `dirac_system()` is the same
    system with the Lie–Poisson bivector for its Dirac structure.

        body = dx.LiePoisson(dx.SO3(), lambda mu: mu @ (mu / jnp.array([1.0, 2.0, 3.0])) / 2)
    """

    space: SemidirectProduct
    hamiltonian: UserFunction

    def __init__(
        self,
        group: AbstractLieGroup,
        hamiltonian: Callable,
        advected: int = 0,
        representation: Callable | None = None,
    ):
        self.space = SemidirectProduct(group, advected, representation)
        self.hamiltonian = UserFunction(hamiltonian, "hamiltonian", ("mu", *("a",) * (advected > 0)))

    stated_by_momenta = True
    """Whether the function of the system is h(μ, a), not l(ξ, a)."""

    @property
    def manifolds(self) -> dict[str, AbstractManifold]:
        return {"g": self.space.group, "q": self.space.group}

    def lie_algebra_form(self) -> "LiePoisson":
        return self

    def value(self, momentum: Algebra, a: Advected, params: Any = None) -> Float[Array, ""]:
        """h(μ, a)."""
        return self.hamiltonian(*((momentum, a) if self.space.advected else (momentum,)), params)

    def slopes(self, momentum: Algebra, a: Advected, params: Any = None) -> tuple[Algebra, Advected]:
        """(∂h/∂μ, ∂h/∂a)."""
        return gradient(lambda momentum, a: self.value(momentum, a, params), (0, 1))(momentum, a)

    def dirac_system(self) -> DiracSystem:
        """The Dirac system (graph of the Lie–Poisson bivector, h)."""
        hamiltonian = lambda x, params: self.value(*self.space.split(x), params)
        return DiracSystem(DiracStructure.from_bivector(self.space.bivector), hamiltonian)

    def relation_form(self, shape: Shape) -> RelationForm:
        return self.dirac_system().relation_form(shape)

    def energy_form(self, shape: Shape) -> EnergyForm:
        return self.dirac_system().energy_form(shape)

    def sizes(self, data: Data, params: Any) -> tuple[int, int]:
        """(d + r, 0)."""
        momentum, a = checked_point(self.space, data, "LiePoisson", "jnp.concatenate([mu, a])")
        out = self.hamiltonian.shape(*((momentum, a) if self.space.advected else (momentum,)), params)
        if out.shape != ():
            raise ValueError(f"{self.hamiltonian.signature} must return a scalar, but it returned shape {out.shape}.")
        return self.space.size, 0

    def complete(self, data: Data, params: Any, project: bool) -> Data:
        x, dirac = data["x"], self.dirac_system()
        velocity = dirac.hamiltonian_vector(x, dirac.differential(x, params), params)
        return {"x": x, "velocity": velocity, "v": self.slopes(*self.space.split(x), params)[0]}

    def initial_defect(self, data: Data, params: Any) -> Float[Array, "0"]:
        return no_constraint()

    def energy_at(self, row: Data, params: Any) -> Float[Array, ""]:
        """h(μ, a)."""
        return self.value(*self.space.split(row["x"]), params)

    def constraint_at(self, row: Data, params: Any) -> Float[Array, "0"]:
        return no_constraint()

    @property
    def dual(self) -> SemidirectProduct:
        return self.space


def checked_point(space: SemidirectProduct, data: Data, kind: str, way: str) -> tuple[Algebra, Advected]:
    """(μ, a) of the initial data; raises `ValueError` for data that are no point x of shape (d + r,)."""
    d, r, name = space.dimension, space.advected, type(space.group).__name__
    what = f"x= (μ, a) of shape ({d} + {r},)" if r else f"x= μ of shape ({d},)"
    if "x" not in data:
        raise ValueError(f"a {kind} system on {name} starts from {what}, but {', '.join(data)} were given: x={way}.")
    if data["x"].shape != (space.size,):
        raise ValueError(f"a {kind} system on {name} starts from {what}, but x has shape {data['x'].shape}: x={way}.")
    a = data["x"][d:]
    if r and jax.eval_shape(lambda a: space.act(space.group.identity(), a), a).shape != (r,):
        raise ValueError(f"representation(matrix, a) must return shape ({r},) like a.")
    space.refuse_no_representation(a)
    return data["x"][:d], a
