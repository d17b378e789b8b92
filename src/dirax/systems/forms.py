"""The forms in which a system shows itself to schemes and to the constraint algorithm: plain records of functions."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np


class ImplicitForm(NamedTuple):
    """A system as linear equations matrix (ẋ, u) = right at every x, and the point it was asked for.

    `equations(x, params)` gives (matrix, right), `energy(x, params)` a scalar. `multipliers` names the entries of u,
    `coordinates` those of x; with a `clock` the last of them is the time, ṫ = 1. `about` says in words what they are.
    `hessian(x, params)` is ∂²L/∂v² where the form is made for one of constant rank.
    """

    equations: Callable
    point: np.ndarray
    coordinates: tuple[str, ...]
    multipliers: tuple[str, ...]
    energy: Callable
    about: str
    clock: bool = False
    hessian: Callable | None = None


class Observed(NamedTuple):
    """What a run saves of every step beside the state, under `name`: `at(x, ẋ, t, params)` at the base point, of `shape`."""

    name: str
    at: Callable
    shape: tuple[int, ...]
    dims: tuple[str, ...]
    description: str


class RelationForm(NamedTuple):
    """A system as a relation between points x (N,) of a manifold M and their velocities: what a discretization map on M needs.

    `residual(x, ẋ, u, t, params)` is zero where (x, ẋ) satisfies the system with multipliers u (k,): N numbers, which are
    paired with the tangent space where M is a submanifold of R^N, and k more, named by `labels`. `spread(u)` puts the
    multipliers among all `saved` ones, whose axis is called `axis`. `observed` is what else is saved by
    steps of a discretization map.
    `canonical`: x is (q, p) on T*Q. `dirac` tells the relation where it is one of a Dirac structure. A node is saved as
    `node(x, params)`, a dict with the keys `names`, arrays (N,) each. `two_form(x, params)` (N, N) is the two-form whose graph D
    is, up to its sign, `bivector(x, params)` (N, N) the bivector, where D is one or the other. `explicit`: without multipliers
    it is ẋ less a function of x, so that it determines ẋ everywhere.
    """

    residual: Callable
    multipliers: int = 0
    labels: tuple[str, ...] = ()
    saved: int = 0
    spread: Callable = lambda multipliers: multipliers
    axis: str = "constraint"
    observed: tuple[Observed, ...] = ()
    canonical: bool = False
    dirac: str = ""
    names: tuple[str, ...] = ("x",)
    node: Callable = lambda x, params: {"x": x}
    two_form: Callable | None = None
    bivector: Callable | None = None
    explicit: bool = False


class EnergyForm(NamedTuple):
    """What a scheme with an exact energy balance needs of a system with a relation form, beside that form.

    `hamiltonian(x, params)` is a number and `differential(x, params)` its dH (N,); `residual(x, ẋ, u, t, params, gradient)`
    is that of the relation form with another covector in place of dH(x). `ports(t, x, gradient, params)` gives the inputs
    and outputs of open ports, the product of which is the power supplied, and the power dissipated; None without ports.
    """

    hamiltonian: Callable
    differential: Callable
    residual: Callable
    ports: Callable | None = None


class FinalManifold(NamedTuple):
    """M_f = {φ = 0} with what a step needs, functions of (x, params): constraints φ, `size` of them; the `field` ẋ = X(x); the
    `multipliers`, as many as `forces`; and `normal(x, α, params)`, the vector by which a combination α of the dφ moves a
    point onto M_f. `check(data, h, params)` refuses initial data for which this is not M_f."""

    constraints: Callable
    size: int
    field: Callable
    multipliers: Callable
    forces: int
    normal: Callable
    check: Callable | None = None
