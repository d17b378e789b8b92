"""Mechanics on a Lie group, reduced by the group: Euler–Poincaré and Euler–Poincaré–Suslov systems on its Lie algebra."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.geometry.lie_group import AbstractLieGroup, Algebra
from dirax.geometry.manifolds import AbstractManifold
from dirax.geometry.semidirect import Advected, SemidirectProduct
from dirax.numerics.arrays import Data
from dirax.numerics.ranks import rank_of_equations
from dirax.numerics.tolerances import INERTIA_RANK, ONE_FORM_RANK
from dirax.program.legendre import constrained_velocity, moves
from dirax.program.roots import nearest_root
from dirax.program.tracing import gradient, jacobian, once
from dirax.program.user_functions import UserFunction
from dirax.reduction.lie_poisson import LiePoisson, checked_point
from dirax.systems.constraints import no_constraint
from dirax.systems.forms import EnergyForm
from dirax.systems.magnitudes import as_large_as_kinetic
from dirax.systems.premise import Premise
from dirax.systems.shape import Shape
from dirax.systems.system import AbstractSystem, refuse_start


class EulerPoincare(AbstractSystem):
    """A left-invariant Lagrangian on a Lie group, reduced to l(ξ, a), ξ = g⁻¹ġ the body velocity.

        d/dt ∂l/∂ξ = ad*_ξ ∂l/∂ξ − J(∂l/∂a, a) + Aᵀλ,   ȧ = −ξ·a,   A ξ = 0,   ġ = g ξ,   ⟨J, η⟩ = ⟨∂l/∂a, η·a⟩

    (Holm, Marsden & Ratiu 1998; with constraints the equations of Suslov and of Fedorov & Kozlov).

    - `group`: `dx.SO3()` and others; algebra vectors (d,) are ordered (velocity, angular velocity).
    - `lagrangian(xi[, a][, params])`, a scalar; it takes a (r,) iff `advected` = r > 0.
    - `one_forms`: an (m, d) array A, or a function `one_forms([a][, params])` that returns one, takes a iff there is one.
    - `representation`: how the group acts on a, as in `dx.SemidirectProduct`; by default a is made of vectors it turns.

    The state is x = (μ, a) with the body momentum μ = ∂l/∂ξ; `state(xi, a)` makes one from a velocity. Without advected
    quantities a run also starts from q=, v= or q=, p=, an element g of the group and a tangent vector or covector there.
    Stepped by `dx.DiscreteEulerPoincare`; `dx.reconstruct` gives the motion on the group.

        body = dx.EulerPoincare(dx.SO3(), lambda xi: xi @ (jnp.array([1.0, 2.0, 3.0]) * xi) / 2)
        sol = dx.simulate(body, dx.DiscreteEulerPoincare(), x=body.state([0.1, 1.0, 0.1]), step=0.1, steps=100)

    Raises `TypeError` for functions of other arguments and groups that are none, `ValueError` for shapes that do not fit.
    """

    space: SemidirectProduct
    lagrangian: UserFunction
    one_forms: UserFunction | None

    def __init__(
        self,
        group: AbstractLieGroup,
        lagrangian: Callable,
        one_forms: Any = None,
        advected: int = 0,
        representation: Callable | None = None,
    ):
        self.space = SemidirectProduct(group, advected, representation)
        a = ("a",) * (advected > 0)
        self.lagrangian = UserFunction(lagrangian, "lagrangian", ("xi", *a))
        forms = one_forms if one_forms is None or callable(one_forms) else _constant(one_forms)
        self.one_forms = None if forms is None else UserFunction(forms, "one_forms", a)

    # ------------------------------------------------------------------ l and A

    stated_by_momenta = False
    """Whether the function of the system is h(μ, a), not l(ξ, a)."""

    @property
    def manifolds(self) -> dict[str, AbstractManifold]:
        return {"g": self.space.group, "q": self.space.group}

    @property
    def linearized_as(self) -> str:
        return "linearize its .lie_poisson(), whose state x is (μ, a)"

    def lie_algebra_form(self) -> "EulerPoincare":
        return self

    def value(self, xi: Algebra, a: Advected, params: Any = None) -> Float[Array, ""]:
        """l(ξ, a)."""
        return self.lagrangian(*self._given(xi, a), params)

    @once
    def slopes(self, xi: Algebra, a: Advected, params: Any = None) -> tuple[Algebra, Advected]:
        """(∂l/∂ξ, ∂l/∂a)."""
        return gradient(lambda xi, a: self.value(xi, a, params), (0, 1))(xi, a)

    def legendre(self, xi: Algebra, a: Advected, params: Any = None) -> Algebra:
        """The body momentum μ = ∂l/∂ξ."""
        return self.slopes(xi, a, params)[0]

    def inverse_legendre(self, momentum: Algebra, a: Advected, params: Any = None, guess: Algebra | None = None) -> Algebra:
        """The ξ with ∂l/∂ξ = μ, of several one near `guess` (zero by default); of an l that is quadratic in ξ by linear
        equations. NaN where there is none."""
        of_xi = lambda xi: self.value(xi, a, params)
        if moves(jax.hessian(of_xi), momentum):
            begin = jnp.zeros_like(momentum) if guess is None else guess
            return nearest_root(lambda xi: self.legendre(xi, a, params) - momentum, begin, strict=True)
        return constrained_velocity(of_xi, momentum, jnp.zeros((0, len(momentum))), jnp.zeros(0), momentum)[0]

    def constraint_forms(self, a: Advected, params: Any = None) -> Float[Array, "m d"]:
        """A; (0, d) without constraints."""
        if self.one_forms is None:
            return jnp.zeros((0, self.space.dimension))
        return self.one_forms(*((a, params) if self.space.advected else (params,)))

    def state(self, xi: Any, a: Any = None, params: Any = None) -> Array:
        """The point x = (μ, a) (d + r,) of a body velocity ξ (d,), or a batch of them; raises `ValueError` for other shapes."""
        d, r = self.space.dimension, self.space.advected
        xi, a = jnp.asarray(xi, float), jnp.zeros((*np.shape(xi)[:-1], 0)) if a is None else jnp.asarray(a, float)
        if xi.ndim not in (1, 2) or xi.shape[-1] != d or a.shape[-1:] != (r,):
            raise ValueError(
                f"on {type(self.space.group).__name__} xi must have shape ({d},), ordered (velocity, angular velocity), and a "
                f"shape ({r},), but shapes {xi.shape} and {a.shape} were given."
            )
        point = lambda xi, a: jnp.concatenate([self.legendre(xi, a, params), a])
        return point(xi, a) if xi.ndim == 1 else jax.vmap(point)(xi, jnp.broadcast_to(a, (len(xi), r)))

    def lie_poisson(self) -> LiePoisson:
        """The system h(μ, a) = ⟨μ, ξ⟩ − l(ξ, a) on the dual; raises `ValueError` where there are constraints."""
        if self.one_forms is not None:
            raise ValueError("a system with constraints is no Lie–Poisson system: leave out one_forms.")
        if self.space.advected:
            hamiltonian = lambda mu, a, params: self._energy(mu, a, params)
        else:
            hamiltonian = lambda mu, params: self._energy(mu, jnp.zeros(0), params)
        return LiePoisson(self.space.group, hamiltonian, self.space.advected, self.space.representation)

    def _given(self, xi, a):
        return (xi, a) if self.space.advected else (xi,)

    def _energy(self, momentum, a, params, guess=None):
        xi = self.inverse_legendre(momentum, a, params, guess)
        return momentum @ xi - self.value(xi, a, params)

    # ------------------------------------------------------------------ AbstractSystem

    def energy_form(self, shape: Shape) -> EnergyForm | None:
        """h(μ, a) with the Lie–Poisson bivector; None where there are constraints."""
        if self.one_forms is not None:
            return None

        def hamiltonian(x, params):
            return self._energy(*self.space.split(x), params)

        def differential(x, params):
            momentum, a = self.space.split(x)
            xi = self.inverse_legendre(momentum, a, params)
            return jnp.concatenate([xi, -self.slopes(xi, a, params)[1]])

        def residual(x, rate, multipliers, t, params, gradient):
            return rate - self.space.bivector(x) @ gradient

        return EnergyForm(hamiltonian, differential, residual)

    def velocity_at(self, row: Data, params: Any) -> Array:
        """ẋ by the Lie–Poisson bivector. Raises `TypeError` where constraints push as well."""
        form = self.energy_form(Shape(0))
        if form is None:
            raise TypeError("the rate of a dx.EulerPoincare with constraints is not at hand: dx.VariableSteps does not take it.")
        return self.space.bivector(row["x"]) @ form.differential(row["x"], params)

    def sizes(self, data: Data, params: Any) -> tuple[int, int]:
        """(d + r, m)."""
        if set(data) - {"t"} == {"q"}:
            refuse_start(self, data, "x", "q, v", "q, p")
        data = self._on_the_dual(data, params)
        momentum, a = checked_point(self.space, data, "EulerPoincare", "body.state(xi, a)")
        d, given = self.space.dimension, self._given(momentum, a)
        out = self.lagrangian.shape(*given, params)
        if out.shape != ():
            raise ValueError(f"{self.lagrangian.signature} must return a scalar, but it returned shape {out.shape}.")
        m = 0
        if self.one_forms is not None:
            shape = self.one_forms.shape(*given[1:], params).shape
            if len(shape) != 2 or shape[1] != d or not 0 < shape[0] < d:
                raise ValueError(
                    f"one_forms must have shape (m, d) = (m, {d}), 0 < m < {d}, one row a constraint on ξ, but it has {shape}."
                )
            m = shape[0]
        return self.space.size, m

    def premise(self, data: Data, params: Any) -> Premise:
        """The inertia is regular, and the one-forms are independent."""
        return Premise(self._inertia_and_forms, self._refuse_singular)

    def _refuse_singular(self, found) -> None:
        inertia, forms = found
        if not (np.all(np.isfinite(inertia)) and np.all(np.isfinite(forms))):
            return  # the first step says where
        if len(forms) and (rank := rank_of_equations(forms[None], ONE_FORM_RANK)[0][0]) < len(forms):
            raise ValueError(f"one_forms must be independent, but A = {forms.tolist()} has rank {rank}.")
        if (rank := rank_of_equations(inertia[None], INERTIA_RANK)[0][0]) < len(inertia):
            raise ValueError(
                f"the inertia ∂²l/∂ξ² is singular at the initial data: it has rank {rank} of {len(inertia)}, so that μ does not "
                "determine ξ. Give every direction of the algebra an inertia, or take a smaller group."
            )

    def _inertia_and_forms(self, data, params):
        """∂²l/∂ξ² at the ξ of μ, and A."""
        momentum, a = self.space.split(self._on_the_dual(data, params)["x"])
        xi = self.inverse_legendre(momentum, a, params)
        return jacobian(lambda xi: self.legendre(xi, a, params))(xi), self.constraint_forms(a, params)

    def _on_the_dual(self, data: Data, params: Any) -> dict[str, Array]:
        """x = μ of data q with v or p on the group; other data as they are."""
        if "q" not in data or self.space.advected:
            return data
        group, q = self.space.group, jnp.asarray(data["q"])
        group.check_point(q, "q")
        if "p" in data:
            return {"x": group.body_momentum(q, jnp.asarray(data["p"]))}
        group.check_tangent(q, data["v"], "v")
        return {"x": self.legendre(group.to_algebra(q, data["v"]), jnp.zeros(0), params)}

    def complete(self, data: Data, params: Any, project: bool) -> Data:
        momentum, a = self.space.split(self._on_the_dual(data, params)["x"])
        xi = self.inverse_legendre(momentum, a, params)
        if project and self.one_forms is not None:
            xi = self._constrained_velocity(momentum, a, xi, params)
            momentum = self.legendre(xi, a, params)
        start = {"g": data["q"]} if "q" in data else {}
        return {"x": jnp.concatenate([momentum, a]), "v": xi} | start

    def _constrained_velocity(self, momentum, a, guess, params):
        """The ξ with A ξ = 0 and μ − ∂l/∂ξ a reaction Aᵀσ."""
        d, forms = self.space.dimension, self.constraint_forms(a, params)

        def defect(u):
            return jnp.concatenate([self.legendre(u[:d], a, params) - momentum - forms.T @ u[d:], forms @ u[:d]])

        return nearest_root(defect, jnp.concatenate([guess, jnp.zeros(len(forms))]))[:d]

    def initial_defect(self, data: Data, params: Any) -> Float[Array, " m"]:
        if self.one_forms is None:
            return no_constraint()
        return self.constraint_forms(self.space.split(data["x"])[1], params) @ data["v"]

    def sizes_of_data(self, data: Data, params: Any) -> Data:
        """Each component of ξ as large as the kinetic energy makes it."""
        a, xi = self.space.split(data["x"])[1], data["v"]
        largest = jnp.abs(xi) + as_large_as_kinetic(lambda xi: self.legendre(xi, a, params), xi)
        return {name: jnp.abs(value) for name, value in data.items()} | {"v": largest}

    @property
    def searches_near(self) -> tuple[str, ...]:
        return ("xi",)

    def energy_at(self, row: Data, params: Any) -> Float[Array, ""]:
        """⟨μ, ξ⟩ − l(ξ, a)."""
        return self._energy(*self.space.split(row["x"]), params, row.get("about"))

    def constraint_at(self, row: Data, params: Any) -> Float[Array, " m"]:
        """A ξ."""
        if self.one_forms is None:
            return no_constraint()
        momentum, a = self.space.split(row["x"])
        return self.constraint_forms(a, params) @ self.inverse_legendre(momentum, a, params, row.get("about"))

    @property
    def stepped_by(self) -> str:
        """dx.DiscreteEulerPoincare, and without constraints more."""
        if self.one_forms is not None:
            return "With constraints, dx.EulerPoincare systems are stepped by dx.DiscreteEulerPoincare."
        return (
            "dx.EulerPoincare systems are stepped by dx.DiscreteEulerPoincare and energy-preserving collocation; most other "
            "schemes step the same motion as that of system.lie_poisson()."
        )

    @property
    def projected(self) -> str:
        return "the momentum by the forces of the constraint"

    @property
    def dual(self) -> SemidirectProduct:
        return self.space


def _constant(matrix: Any) -> Callable:
    values = np.asarray(matrix, dtype=float)
    return lambda *_: jnp.asarray(values)
