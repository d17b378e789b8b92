"""The implicit form of a Lagrangian with constraints: on T*Q with its primary constraints, or on the Pontryagin bundle."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dirax.geometry.structures import canonical_two_form
from dirax.numerics.arrays import Numbers
from dirax.numerics.equilibration import geometric_scales
from dirax.numerics.ranks import significant
from dirax.numerics.tolerances import HESSIAN_RANK
from dirax.program.linear_solves import solve
from dirax.program.tracing import gradient, jacobian, once
from dirax.program.user_functions import constant_entries, evaluated
from dirax.systems.forms import ImplicitForm
from dirax.systems.implicit_form import in_time, names, uses_time, without_time


def implicit_lagrangian(system: Any, stated: Any, near: Any, params: Any) -> ImplicitForm:
    """The implicit form of a `LagrangeDirac` system around `near`; `stated` is the system as the user stated it.

    A Lagrangian whose momenta are affine in the velocities is put on T*Q, x = (q, p), with its primary constraints and their
    multipliers (Dirac, Bergmann); any other on the Pontryagin bundle, x = (q, v, p), and a singular one with forces f(q, v)
    too. What depends on time has t as its last coordinate; `near` has it as "t", zero by default.
    Raises `ValueError` for points of the wrong length.
    """
    near, t = without_time(near)
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
    timed = system.depends_on_time or uses_time(system.forces, q, zero, params)
    affine, hessian = _momenta(system, q, data.get("v", zero) if data is not None else zero, params, t)
    regular = not _kernel(hessian).shape[1]
    if affine and (regular or system.forces is None):
        if data is not None:
            p = data["p"] if "p" in data else system.legendre(q, data.get("v", zero), params, t)
            x = np.concatenate([q, p])
        elif given.size % 2:  # (q, v, p)
            x = np.concatenate([q, given[-q.size :]])
        return _on_cotangent_bundle(system, np.asarray(x), hessian, params, timed, t)
    why = "the momenta of this Lagrangian are not affine in the velocities"
    why = "this Lagrangian is singular and has forces, which are functions of v" if affine else why
    if data is None and (x is None or x.size % 3):
        raise ValueError(f'{why}: give near={{"q": …, "v": …}}.')
    if data is not None:
        if "v" not in data:
            raise ValueError(f'{why}: give near={{"q": …, "v": …}}.')
        x = np.concatenate([q, data["v"], system.legendre(q, data["v"], params, t)])
    return _on_pontryagin_bundle(system, np.asarray(x), params, timed, t, f"{why.split(': ')[0]}: x = (q, v, p)")


def _momenta(system: Any, q, v, params, t) -> tuple[bool, np.ndarray]:
    """Whether ∂L/∂v is affine in v (at three points around q), and the Hessian ∂²L/∂v² at q."""
    of_lagrangian = jax.hessian(lambda v, q: system.lagrangian.at(t, q, v, params))
    hessian = lambda q, v: np.asarray(evaluated(of_lagrangian, v, q))
    rng, q, v = np.random.default_rng(0), np.asarray(q), np.asarray(v)
    here, by_q, by_v = hessian(q, v), _sizes(q), _sizes(v)
    for _ in range(3):
        at = q + 1e-2 * by_q * rng.normal(size=q.shape)
        one, other = (hessian(at, v + r * by_v * rng.normal(size=q.shape)) for r in (0.0, 0.5))
        rows, columns = geometric_scales(np.maximum(np.abs(one), np.abs(other)))
        if np.max(np.abs(one - other) / rows / columns) > HESSIAN_RANK * np.max(np.abs(one) / rows / columns):
            return False, here
    return True, here


def _sizes(values: np.ndarray) -> np.ndarray:
    """The sizes of coordinates, those of the largest, or 1, where they are zero."""
    sizes = np.abs(values)
    return np.where(sizes > 0, sizes, sizes.max() or 1.0)


def _kernel(hessian: np.ndarray) -> np.ndarray:
    """A basis (n, k) of the kernel of a symmetric matrix, orthonormal in the units that bring its entries near 1."""
    rows, columns = geometric_scales(np.abs(hessian))
    _, values, directions = np.linalg.svd(hessian / rows / columns)
    return directions[~significant(values, HESSIAN_RANK)].T / columns.T


def _on_cotangent_bundle(system: Any, x: np.ndarray, hessian: np.ndarray, params, timed: bool, t: float) -> ImplicitForm:
    """x = (q, p): ẋ = X_H + X_φ u + (0, f + Wᵀλ), φ = 0, W q̇ = −b, with the primary constraints φ and H = ⟨p, v⟩ − L."""
    n = x.size // 2
    m, c = system.constraints.sizes(jnp.asarray(x[:n]), params)
    null = _kernel(hessian)
    k = null.shape[1]
    J = canonical_two_form(n)  # as the Poisson matrix: (q̇, ṗ) = J dH

    def mass(t, q, params):
        return jacobian(gradient(lambda v: system.lagrangian.at(t, q, v, params)))(jnp.zeros(n))

    def bordered(t, q, params):
        return jnp.concatenate([jnp.concatenate([mass(t, q, params), null], axis=1), np.pad(null.T, ((0, 0), (0, k)))])

    constant = constant_entries(bordered, t, x[:n], params)
    inverse = None if constant is None or np.any(np.isnan(constant)) else np.linalg.inv(constant)

    @once
    def legendre_inverse(t, x, params):
        """(v, φ) with ∂L/∂v (q, v) = p − Zφ and Zᵀv = 0, Z a basis of the Hessian's kernel at the point of the chain."""
        q, p = x[:n], x[n:]
        right = jnp.concatenate([p - system.legendre(q, jnp.zeros(n), params, t), np.zeros(k)])
        solution = solve(bordered(t, q, params), right, apart=True) if inverse is None else inverse @ right
        return solution[:n], solution[n:]

    def hamiltonian(t, x, params):
        v, _ = legendre_inverse(t, x, params)
        return x[n:] @ v - system.lagrangian.at(t, x[:n], v, params)

    def equations(t, x, params):
        primary = lambda x: legendre_inverse(t, x, params)[1]
        v, dphi = legendre_inverse(t, x, params)[0], jacobian(primary)(x)
        # dH = (−∂L/∂q, v): p − ∂L/∂v is in the kernel, to which v is orthogonal, so that it does not matter how v varies
        rate = gradient(lambda q: system.lagrangian.at(t, q, v, params))(x[:n])
        rate = rate if system.forces is None else rate + system.forces(t, x[:n], v, params)
        flow = jnp.concatenate([v, rate])
        w, moving = system.constraints.matrix(t, x[:n], params), _moving(system, t, x[:n], params)
        forces = jnp.concatenate([J @ dphi.T, jnp.concatenate([jnp.zeros((n, m + c)), w.T])], axis=1)
        top = jnp.concatenate([jnp.eye(2 * n), -forces], axis=1)
        constrained = jnp.concatenate([w[:m], jnp.zeros((m, n + k + m + c))], axis=1)
        matrix = jnp.concatenate([top, jnp.zeros((k, 2 * n + k + m + c)), constrained, jnp.zeros((c, 2 * n + k + m + c))])
        return matrix, jnp.concatenate([flow, primary(x), *moving])

    coordinates, multipliers = (*names("q", n), *names("p", n)), (*names("u", k), *names("λ", m + c))
    rank = f"Hessian of rank {n - k} of {n}" + (f": {k} primary constraint{'s' * (k > 1)}" if k else ", regular")
    form = in_time(timed, t, equations, x, coordinates, multipliers, hamiltonian, rank)
    return form._replace(hessian=lambda x, params: mass(x[-1] if timed else 0.0, x[:n], params))


def _on_pontryagin_bundle(system: Any, x: np.ndarray, params, timed: bool, t: float, about: str) -> ImplicitForm:
    """x = (q, v, p): q̇ = v, ṗ = ∂L/∂q + f + Wᵀλ, 0 = p − ∂L/∂v, 0 = W v + b."""
    n = x.size // 3
    m, c = system.constraints.sizes(jnp.asarray(x[:n]), params)

    def equations(t, x, params):
        q, v, p = x[:n], x[n : 2 * n], x[2 * n :]
        dq, dv = gradient(lambda q, v: system.lagrangian.at(t, q, v, params), (0, 1))(q, v)
        rate = dq if system.forces is None else dq + system.forces(t, q, v, params)
        w, (minus_b, g) = system.constraints.matrix(t, q, params), _moving(system, t, q, params)
        eye, zero = jnp.eye(n), jnp.zeros((n, n))
        position = jnp.concatenate([eye, zero, zero, jnp.zeros((n, m + c))], axis=1)
        momentum = jnp.concatenate([zero, zero, eye, -w.T], axis=1)
        matrix = jnp.concatenate([position, momentum, jnp.zeros((n + m + c, 3 * n + m + c))])
        return matrix, jnp.concatenate([v, rate, p - dv, w[:m] @ v - minus_b, g])

    def energy(t, x, params):
        return system.generalized_energy(x[:n], x[n : 2 * n], x[2 * n :], params, t)

    coordinates = (*names("q", n), *names("v", n), *names("p", n))
    return in_time(timed, t, equations, x, coordinates, names("λ", m + c), energy, about)


def _moving(system: Any, t, q, params) -> tuple[Numbers, Numbers]:
    """(−b, g): the right-hand sides of W q̇ = −b and 0 = g."""
    constraints = system.constraints
    return -constraints.nonholonomic_defect(t, q, jnp.zeros_like(q), params), constraints.position_defect(t, q, params)
