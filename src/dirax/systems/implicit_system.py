"""Implicit systems E(x) ẋ = f(x) + B(x) u, and the implicit form of every other system."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.functions import UserFunction
from dirax.geometry.structures import canonical_two_form
from dirax.roots import scaled_pseudo_inverse
from dirax.systems.dirac_system import DiracSystem
from dirax.systems.lagrange_dirac import LagrangeDirac
from dirax.systems.nonholonomic import NonholonomicMechanics
from dirax.systems.phase_space import PhaseSpaceLagrangian
from dirax.systems.port_hamiltonian import PortHamiltonian
from dirax.systems.system import AbstractSystem

RANK_TOLERANCE = 1e-9


class ImplicitSystem(AbstractSystem):
    """E(x) ẋ = f(x) + B(x) u, with u free: a submanifold S_0 of TM that is affine in the velocity ([BLM] §3).

    `E(x[, params])` (r, N), `f(x[, params])` (r,), `B(x[, params])` (r, m), none by default; E may be singular and need
    not be square. `hamiltonian(x[, params])`, a scalar, only serves to report an energy.

        pendulum = dx.ImplicitSystem(  # x = (q, p, tension as the multiplier), |q| = 1
            E=lambda x: jnp.eye(5)[:, :4], f=lambda x: jnp.array([x[2], x[3], 0.0, -1.0, x[0]**2 + x[1]**2 - 1.0]),
            B=lambda x: jnp.array([0.0, 0.0, x[0], x[1], 0.0])[:, None])
    """

    E: UserFunction
    f: UserFunction
    B: UserFunction | None
    hamiltonian: UserFunction | None

    def __init__(self, E: Callable, f: Callable, B: Callable | None = None, hamiltonian: Callable | None = None):
        self.E, self.f = UserFunction(E, "E", ("x",)), UserFunction(f, "f", ("x",))
        self.B = None if B is None else UserFunction(B, "B", ("x",))
        self.hamiltonian = None if hamiltonian is None else UserFunction(hamiltonian, "hamiltonian", ("x",))

    def equations(self, x: Float[Array, " N"], params: Any = None) -> tuple[Array, Array]:
        """([E, −B], f), of shapes (r, N + m) and (r,): the linear equations of (ẋ, u)."""
        E, f = self.E(x, params), self.f(x, params)
        return (E if self.B is None else jnp.concatenate([E, -self.B(x, params)], axis=1)), f

    def relation(
        self,
        x: Float[Array, " N"],
        velocity: Float[Array, " N"],
        multipliers: Float[Array, " m"],
        t: Any,
        params: Any = None,
    ) -> Float[Array, " r"]:
        """E ẋ − f − B u."""
        matrix, f = self.equations(x, params)
        return matrix @ jnp.concatenate([velocity, multipliers]) - f

    def sizes(self, data: dict[str, Array], params: Any) -> tuple[int, int]:
        if "x" not in data:
            raise ValueError(f"an ImplicitSystem starts from x=, but {', '.join(data)} were given.")
        x = data["x"]
        E, f = self.E.shape(x, params).shape, self.f.shape(x, params).shape
        if len(E) != 2 or E[1] != x.size:
            raise ValueError(f"E must have shape (r, {x.size}), one row an equation, but it returned shape {E}.")
        if f != (E[0],):
            raise ValueError(f"f must have shape ({E[0]},) like the rows of E, but it returned shape {f}.")
        if self.B is None:
            return x.size, 0
        B = self.B.shape(x, params).shape
        if len(B) != 2 or B[0] != E[0]:
            raise ValueError(f"B must have shape ({E[0]}, m), one column a multiplier, but it returned shape {B}.")
        return x.size, B[1]

    def complete(self, data: dict[str, Array], params: Any, project: bool) -> dict[str, Array]:
        x = data["x"]
        matrix, f = self.equations(x, params)
        velocity = scaled_pseudo_inverse(matrix)[0] @ f
        return {"x": x, "velocity": velocity[: x.size], "defect": matrix @ velocity - f}

    def initial_defect(self, data: dict[str, Array], params: Any) -> Float[Array, " r"]:
        """The part of f that no (ẋ, u) reaches: x is on M_0 where it vanishes."""
        return data["defect"]

    def energy_at(self, row: dict[str, Array], params: Any) -> Float[Array, ""]:
        """H(x); NaN for a system stated without one."""
        return jnp.array(jnp.nan) if self.hamiltonian is None else self.hamiltonian(row["x"], params)

    def constraint_at(self, row: dict[str, Array], params: Any) -> Float[Array, " r"]:
        return self.initial_defect(self.complete({"x": row["x"]}, params, False), params)


class ImplicitForm(NamedTuple):
    """A system as linear equations matrix (ẋ, u) = right at every x, and the point it was asked for.

    `multipliers` names the entries of u, `coordinates` those of x.
    """

    equations: Callable
    point: np.ndarray
    coordinates: tuple[str, ...]
    multipliers: tuple[str, ...]
    energy: Callable
    about: str


def implicit_form(system: AbstractSystem, near: Any, params: Any) -> ImplicitForm:
    """The implicit form of a system around the point `near`: an array x, or a dict of initial data such as {"q": …, "v": …}.

    Systems on T*Q have x = (q, p). A Lagrangian whose momenta are affine in the velocities is put on T*Q with its primary
    constraints and their multipliers (Dirac, Bergmann); any other on the Pontryagin bundle, x = (q, v, p).
    Raises `TypeError` for systems without an implicit form, `ValueError` for open ports and points of the wrong length.
    """
    if isinstance(system, ImplicitSystem):
        x = _point(near, ("x",), system)
        _, m = system.sizes({"x": jnp.asarray(x)}, params)
        return ImplicitForm(system.equations, x, _names("x", x.size), _names("u", m), _of_x(system), "as stated")
    if isinstance(system, DiracSystem):
        x = _point(near, ("x",), system)
        c = sum(system.sizes({"x": jnp.asarray(x)}, params)[1:])

        def dirac(x, params):
            matrix, right = system.equations(x, params)
            return jnp.concatenate([matrix, jnp.zeros((c, x.size + c))]), jnp.concatenate(
                [right, system.constraints.position_defect(0.0, x, params)]
            )

        about = "F ẋ = −E dH" if not c else "F ẋ = −E (dH − Gᵀλ), g = 0"
        return ImplicitForm(dirac, x, _names("x", x.size), _names("λ", c), _of_x(system), about)
    if isinstance(system, PortHamiltonian):
        return _port_hamiltonian(system, near, params)
    if isinstance(system, NonholonomicMechanics | PhaseSpaceLagrangian):
        return _lagrangian(system.lagrange_dirac(), system, near, params)
    if isinstance(system, LagrangeDirac):
        return _lagrangian(system, system, near, params)
    raise TypeError(
        "the constraint algorithm takes ImplicitSystem, DiracSystem, PortHamiltonian, LagrangeDirac, NonholonomicMechanics "
        f"and PhaseSpaceLagrangian systems, but a {type(system).__name__} was given: state it as dx.ImplicitSystem(E, f, B)."
    )


def _port_hamiltonian(system: PortHamiltonian, near, params) -> ImplicitForm:
    x = _point(near, ("x",), system)
    n, m = system.sizes({"x": jnp.asarray(x)}, params)

    def equations(x, params):
        dh = system.differential(x, params)
        closed = system.closed_matrix(x, params)
        right = system.flow_matrix(x, params) @ dh + system.open_matrix(x, params) @ system.input(0.0, x, params)
        matrix = jnp.block([[jnp.eye(n), -closed], [jnp.zeros((m, n + m))]])
        return matrix, jnp.concatenate([right, closed.T @ dh])

    about = "closed ports: u keeps y = 0" if m else "no closed ports"
    return ImplicitForm(equations, x, _names("x", n), _names("u", m), _of_x(system), about)


def _lagrangian(system: LagrangeDirac, stated, near, params) -> ImplicitForm:
    if system.depends_on_time or system.forces is not None:
        raise ValueError(
            "the constraint algorithm takes Lagrangian systems without forces and explicit time: make the time a coordinate, or "
            "state the equations as dx.ImplicitSystem(E, f, B)."
        )
    data: Any = {k: jnp.asarray(v, float) for k, v in near.items()} if isinstance(near, dict) else None
    if data is not None and set(data) not in ({"q", "v"}, {"q", "p"}, {"q"}):
        raise ValueError(f"near must hold q with v or p for a Lagrangian system, but it holds {', '.join(data)}.")
    x = None if data is not None else np.asarray(near, float)
    if x is not None and (x.ndim != 1 or (x.size % 2 and x.size % 3)):
        raise ValueError(f"near must be x = (q, p), or {{'q': q, 'v': v}}, but an array of shape {x.shape} was given.")
    given = np.zeros(0) if x is None else x
    q = data["q"] if data is not None else jnp.asarray(given[: given.size // (2 if given.size % 2 == 0 else 3)])
    zero = jnp.zeros_like(q)
    stated.sizes({"q": q, "v": zero}, params)
    affine, hessian = _momenta(system, q, data.get("v", zero) if data is not None else zero, params)
    if affine:
        if data is not None:
            p = data["p"] if "p" in data else system.legendre(q, data.get("v", zero), params)
            x = np.concatenate([q, p])
        return _on_cotangent_bundle(system, stated, np.asarray(x), hessian, params)
    if data is None and (x is None or x.size % 3):
        raise ValueError('the momenta of this Lagrangian are not affine in the velocities: give near={"q": …, "v": …}.')
    if data is not None:
        if "v" not in data:
            raise ValueError('the momenta of this Lagrangian are not affine in the velocities: give near={"q": …, "v": …}.')
        x = np.concatenate([q, data["v"], system.legendre(q, data["v"], params)])
    return _on_pontryagin_bundle(system, np.asarray(x), params)


def _momenta(system: LagrangeDirac, q, v, params) -> tuple[bool, np.ndarray]:
    """Whether ∂L/∂v is affine in v (at three points around q), and the Hessian ∂²L/∂v² at q."""
    hessian = jax.jit(lambda q, v: jax.hessian(lambda v: system.lagrangian(q, v, params))(v))
    rng, q, v = np.random.default_rng(0), np.asarray(q), np.asarray(v)
    here, scale = np.asarray(hessian(q, v)), 1.0 + np.abs(q).max()
    for _ in range(3):
        at = q + 1e-2 * scale * rng.normal(size=q.shape)
        one, other = (np.asarray(hessian(at, v + r * rng.normal(size=q.shape))) for r in (0.0, 0.5))
        if np.abs(one - other).max() > 1e-9 * (1e-300 + np.abs(one).max()):
            return False, here
    return True, here


def _on_cotangent_bundle(system: LagrangeDirac, stated, x: np.ndarray, hessian: np.ndarray, params) -> ImplicitForm:
    """x = (q, p): ẋ = X_H + X_φ u + (0, Wᵀλ), φ = 0, W q̇ = 0, with the primary constraints φ and H = ⟨p, v⟩ − L."""
    n = x.size // 2
    m, c = system.constraints.sizes(jnp.asarray(x[:n]), params)
    values, vectors = np.linalg.eigh(hessian)
    null = jnp.asarray(vectors[:, np.abs(values) <= RANK_TOLERANCE * max(np.abs(values).max(initial=0.0), 1e-300)])
    k = null.shape[1]
    J = canonical_two_form(n)  # as the Poisson matrix: (q̇, ṗ) = J dH

    def legendre_inverse(x, params):
        """(v, φ) with ∂L/∂v (q, v) = p − Zφ and Zᵀv = 0, Z a basis of the Hessian's kernel at the point of the chain."""
        q, p = x[:n], x[n:]
        zero = jnp.zeros(n)
        mass = jax.hessian(lambda v: system.lagrangian(q, v, params))(zero)
        bordered = jnp.block([[mass, null], [null.T, jnp.zeros((k, k))]])
        solution = jnp.linalg.solve(bordered, jnp.concatenate([p - system.legendre(q, zero, params), jnp.zeros(k)]))
        return solution[:n], solution[n:]

    def hamiltonian(x, params):
        v, _ = legendre_inverse(x, params)
        return x[n:] @ v - system.lagrangian(x[:n], v, params)

    def equations(x, params):
        primary = lambda x: legendre_inverse(x, params)[1]
        dh, dphi = jax.grad(hamiltonian)(x, params), jax.jacfwd(primary)(x)
        w, moving = system.constraints.matrix(0.0, x[:n], params), _moving(system, x[:n], params)
        forces = jnp.concatenate([J @ dphi.T, jnp.concatenate([jnp.zeros((n, m + c)), w.T])], axis=1)
        top = jnp.concatenate([jnp.eye(2 * n), -forces], axis=1)
        constrained = jnp.concatenate([w[:m], jnp.zeros((m, n + k + m + c))], axis=1)
        matrix = jnp.concatenate([top, jnp.zeros((k, 2 * n + k + m + c)), constrained, jnp.zeros((c, 2 * n + k + m + c))])
        return matrix, jnp.concatenate([J @ dh, primary(x), *moving])

    names = (*_names("q", n), *_names("p", n))
    rank = f"Hessian of rank {n - k} of {n}" + (f": {k} primary constraint{'s' * (k > 1)}" if k else ", regular")
    return ImplicitForm(equations, x, names, (*_names("u", k), *_names("λ", m + c)), hamiltonian, rank)


def _on_pontryagin_bundle(system: LagrangeDirac, x: np.ndarray, params) -> ImplicitForm:
    """x = (q, v, p): q̇ = v, ṗ = ∂L/∂q + Wᵀλ, 0 = p − ∂L/∂v, 0 = W v."""
    n = x.size // 3
    m, c = system.constraints.sizes(jnp.asarray(x[:n]), params)

    def equations(x, params):
        q, v, p = x[:n], x[n : 2 * n], x[2 * n :]
        dq, dv = jax.grad(lambda q, v: system.lagrangian(q, v, params), argnums=(0, 1))(q, v)
        w, (minus_b, g) = system.constraints.matrix(0.0, q, params), _moving(system, q, params)
        eye, zero = jnp.eye(n), jnp.zeros((n, n))
        position = jnp.concatenate([eye, zero, zero, jnp.zeros((n, m + c))], axis=1)
        momentum = jnp.concatenate([zero, zero, eye, -w.T], axis=1)
        matrix = jnp.concatenate([position, momentum, jnp.zeros((n + m + c, 3 * n + m + c))])
        return matrix, jnp.concatenate([v, dq, p - dv, w[:m] @ v - minus_b, g])

    def energy(x, params):
        return system.generalized_energy(x[:n], x[n : 2 * n], x[2 * n :], params)

    names = (*_names("q", n), *_names("v", n), *_names("p", n))
    return ImplicitForm(equations, x, names, _names("λ", m + c), energy, "momenta not affine in the velocities: x = (q, v, p)")


def _moving(system: LagrangeDirac, q, params) -> tuple[Array, Array]:
    """(−b, g): the right-hand sides of W q̇ = −b and 0 = g."""
    constraints = system.constraints
    return -constraints.nonholonomic_defect(0.0, q, jnp.zeros_like(q), params), constraints.position_defect(0.0, q, params)


def _point(near, keys: tuple[str, ...], system) -> np.ndarray:
    if isinstance(near, dict):
        if set(near) == {"q", "p"}:
            near = np.concatenate([np.asarray(near["q"]), np.asarray(near["p"])])
        elif set(near) == {"x"}:
            near = near["x"]
        else:
            raise ValueError(f"near must hold {', '.join(keys)} for a {type(system).__name__}, but holds {', '.join(near)}.")
    x = np.asarray(near, dtype=float)
    if x.ndim != 1 or not x.size or not np.all(np.isfinite(x)):
        raise ValueError(f"near must be one finite point x of shape (N,), but {near!r:.80} was given.")
    return x


def _names(letter: str, count: int) -> tuple[str, ...]:
    return tuple(f"{letter}{i}" for i in range(count))


def _of_x(system):
    return lambda x, params: system.energy_at({"x": x}, params)
