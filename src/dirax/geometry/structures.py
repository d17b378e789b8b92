"""A Dirac structure on a manifold: a linear one at every point, smooth in the point.

Integrability is never required, only measured: nonholonomic constraints give structures that are not integrable.
"""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dirax.geometry.linear import COMMON, LinearDirac
from dirax.geometry.representations import KERNEL_PAIRS, KernelPair
from dirax.geometry.scattering import block_diagonal, scattering_matrix
from dirax.geometry.subspaces import AnyArray, known
from dirax.numerics.arrays import is_whole
from dirax.program.compiled import compiled
from dirax.program.user_functions import UserFunction, constant_entries, is_traced
from dirax.text.representation import value_text

Matrices = tuple[Float[AnyArray, "rows columns"], ...]


class DiracStructure(eqx.Module):
    """A Dirac structure D ⊂ TM ⊕ T*M in coordinates x (n,), integrable or not ([BLM] §2.2).

    The constructors take functions of a point, `f(x[, params])`, with the matrices of the `LinearDirac` constructor of
    the same name. Give `n` where the dimension must be known before a point is (`product`, `compose`). With `ports` > 0
    the fibre has so many more coordinates, after those of TM, for the ports of an open system.

        so3 = DiracStructure.from_bivector(lambda x: jnp.cross(x, jnp.eye(3), axisb=0, axisc=0))  # Λ(x)α = x × α
        so3.at(jnp.array([0.0, 0.0, 1.0])).contains([0.0, 1.0, 0.0], [1.0, 0.0, 5.0])  # True
    """

    evaluate: Callable[[Float[Array, " n"], Any], Matrices]
    representation: str = eqx.field(static=True)
    n: int | None = eqx.field(static=True)
    ports: int = eqx.field(static=True)

    def __init__(
        self,
        evaluate: Callable[[Float[Array, " n"], Any], Matrices],
        representation: str,
        n: int | None = None,
        ports: int = 0,
    ):
        """Called by the constructors: `evaluate(x, params)` gives the matrices of `representation`, see KERNEL_PAIRS."""
        self.evaluate, self.representation, self.n, self.ports = evaluate, representation, n, ports

    def __repr__(self) -> str:
        more = {"n": self.n, "ports": self.ports or None}
        said = [
            getattr(self.evaluate, "text", "") or value_text(self.evaluate),
            *(f"{name}={value}" for name, value in more.items() if value is not None),
        ]
        return f"DiracStructure({', '.join(said)})"

    # Constructors

    @classmethod
    def from_two_form(cls, two_form: Callable, *, n: int | None = None, ports: int = 0) -> "DiracStructure":
        """Graph of ω♭: `two_form(x[, params])` (n, n) skew, ω[i, j] = ω(e_i, e_j) ([BLM] Theorem 2.4 with F = TM)."""
        return cls(_functions(two_form=two_form), "two_form", n, ports)

    @classmethod
    def from_bivector(cls, bivector: Callable, *, n: int | None = None, ports: int = 0) -> "DiracStructure":
        """Graph of Λ♯: `bivector(x[, params])` (n, n) skew, Poisson or not ([BLM] Theorem 2.5 with F* = T*M)."""
        return cls(_functions(bivector=bivector), "bivector", n, ports)

    @classmethod
    def from_subspace(cls, basis: Callable, *, n: int | None = None, ports: int = 0) -> "DiracStructure":
        """F ⊕ F° for the regular distribution F spanned by the columns of `basis(x[, params])` (n, k)."""
        return cls(_functions(basis=basis), "subspace", n, ports)

    @classmethod
    def from_subspace_and_form(
        cls, basis: Callable, two_form: Callable, *, n: int | None = None, ports: int = 0
    ) -> "DiracStructure":
        """D_{F,ω}: `basis(x[, params])` (n, k) by columns, `two_form(x[, params])` (n, n) skew ([BLM] Theorem 2.4)."""
        return cls(_functions(basis=basis, two_form=two_form), "subspace_and_form", n, ports)

    @classmethod
    def from_annihilator(
        cls, one_forms: Callable, two_form: Callable | None = None, *, n: int | None = None, ports: int = 0
    ) -> "DiracStructure":
        """D_{Δ,ω} for Δ = ker W, W = `one_forms(x[, params])` (m, n) by rows; ω is zero by default."""
        given = {"one_forms": one_forms} | ({} if two_form is None else {"two_form": two_form})
        return cls(_functions(**given), "annihilator", n, ports)

    @classmethod
    def from_codistribution_and_bivector(
        cls, basis: Callable, bivector: Callable, *, n: int | None = None, ports: int = 0
    ) -> "DiracStructure":
        """D_{Λ,F*}: `basis(x[, params])` (n, k) by columns, `bivector(x[, params])` (n, n) skew ([BLM] Theorem 2.5)."""
        return cls(_functions(basis=basis, bivector=bivector), "codistribution_and_bivector", n, ports)

    @classmethod
    def from_kernel(cls, F: Callable, E: Callable, *, n: int | None = None, ports: int = 0) -> "DiracStructure":
        """{(v, α) : F(x) v + E(x) α = 0}, `F(x[, params])` and `E(x[, params])` (n, n)."""
        return cls(_functions(F=F, E=E), "kernel", n, ports)

    @classmethod
    def from_image(cls, A: Callable, B: Callable, *, n: int | None = None, ports: int = 0) -> "DiracStructure":
        """{(A(x) s, B(x) s) : s ∈ R^n}, `A(x[, params])` and `B(x[, params])` (n, n)."""
        return cls(_functions(A=A, B=B), "image", n, ports)

    # At a point

    def at(self, x: Float[Array, " n"], params: Any = None) -> LinearDirac:
        """The linear Dirac structure at x (n,).

        Raises as the `LinearDirac` constructor does where the matrices at x are bad; for a batch of points use vmap.
        """
        F, E = self.kernel(x, params)
        if is_traced(F, E):  # numbers all the same, where they depend on nothing
            entries = constant_entries(lambda x, params: jnp.stack(self.kernel(x, params)), x, params)
            F, E = (F, E) if entries is None or np.any(np.isnan(entries)) else entries
        F, E = known(F), known(E)
        with _in_numbers(F, E):
            return LinearDirac(scattering_matrix((F, E)))

    def kernel(self, x: Float[Array, " n"], params: Any = None) -> KernelPair:
        """(F, E), smooth in x, with D(x) = {(v, α) : F v + E α = 0}: (ωᵀ, −I) for a two-form, (I, −Λ) for a bivector.

        With constraints it is (I − P + P ωᵀ, −P), P the orthogonal projector onto the distribution. Raises as `at`.
        """
        x = jnp.asarray(x, dtype=float)
        if x.ndim != 1 or (self.n is not None and x.shape[0] != self.n):
            raise ValueError(f"x has shape {x.shape}; one point, ({self.n or 'n'},), was expected. Use jax.vmap for a batch.")
        F, E = KERNEL_PAIRS[self.representation](*self.evaluate(x, params))
        if F.shape[-1] != x.shape[0] + self.ports:
            raise ValueError(
                f"The Dirac structure's {self.representation} matrices are for dimension {F.shape[-1]}, but x has "
                f"{x.shape[0]} coordinates and there are {self.ports} ports."
            )
        return jnp.asarray(F), jnp.asarray(E)

    # Integrability

    def courant_tensor(self, x: Float[Array, " n"], params: Any = None) -> Float[Array, "n n n"]:
        """T_ijk = ⟨L_{X_i}α_j, X_k⟩ + cyclic in the orthonormal frame (X_i, α_i) = `at(x).image()` of D ([BLM] §2.2).

        A tensor on D, although made of derivatives (by automatic differentiation); totally skew.
        """
        if self.ports:
            raise ValueError("Integrability is a property of structures on TM ⊕ T*M; this one has ports.")

        x = jnp.asarray(x, dtype=float)
        self.kernel(x, params)  # checks, which are skipped in the compiled function
        return _courant_tensor(self, x, params)

    def integrability_defect(self, x: Float[Array, " n"], params: Any = None) -> Float[Array, ""]:
        """Length of the Courant tensor at x: 0 iff D is integrable there ([BLM] §2.2), whatever the frame.

        Zero for closed two-forms, Poisson bivectors and holonomic constraints; positive for nonholonomic ones.
        """
        return jnp.sqrt(jnp.sum(self.courant_tensor(x, params) ** 2))

    # New structures from old ones

    def pull_back(self, point_map: Callable, *, n: int | None = None) -> "DiracStructure":
        """φ*D at y, for a smooth `point_map(y[, params])` ↦ x: (w, (Dφ)ᵀβ) with (Dφ w, β) ∈ D(φ(y)).

        A structure with ports keeps them. Smooth where its rank does not jump.
        """
        function = UserFunction(point_map, "point_map", ("y",))
        representation = "two_form" if self.representation == "two_form" else "kernel"
        return DiracStructure(_PullBack(self, function), representation, n, self.ports)

    def product(self, other: "DiracStructure") -> "DiracStructure":
        """D × D' on M × M', coordinates (x, x'); ports of D, then of D'. Needs `n` of both."""
        return self.compose(other, [], [])

    def compose(
        self,
        other: "DiracStructure",
        ports: Sequence[int] | None = None,
        other_ports: Sequence[int] | None = None,
        common: Literal["covectors", "vectors"] = "covectors",
    ) -> "DiracStructure":
        """Interconnection over shared ports, on M × M' with coordinates (x, x'); see `LinearDirac.compose`.

        `ports` and `other_ports` count the ports of each from 0 and are all of them by default. Needs `n` of both.
        """
        if not isinstance(other, DiracStructure):
            raise TypeError(f"a dx.DiracStructure is composed with another one, but a {type(other).__name__} was given.")
        if common not in COMMON:
            raise ValueError(f"common is {common!r}; 'covectors' or 'vectors' was expected.")
        if self.n is None or other.n is None:
            raise ValueError("A product needs the dimensions of both structures: give n=… to their constructors.")
        ports = range(self.ports) if ports is None else ports
        other_ports = range(other.ports) if other_ports is None else other_ports
        for name, chosen, count in (("ports", ports, self.ports), ("other_ports", other_ports, other.ports)):
            if not (isinstance(chosen, Sequence | np.ndarray) and all(map(is_whole, chosen))):
                raise TypeError(f"{name} must be a list of whole numbers, like [0, 1], but {chosen!r:.100} was given.")
            if len(set(chosen)) != len(chosen) or any(not 0 <= port < count for port in chosen):
                raise ValueError(f"{name} is {chosen}; distinct numbers of the {count} ports, from 0, were expected.")
        if len(ports) != len(other_ports):
            raise ValueError(f"{len(ports)} ports cannot be joined to {len(other_ports)} other_ports.")
        joined = _Composition(self, other, tuple(map(int, ports)), tuple(map(int, other_ports)), common)
        left = self.ports - len(ports) + other.ports - len(other_ports)
        return DiracStructure(joined, "kernel", self.n + other.n, left)


def _in_numbers(*known_or_traced: Any) -> AbstractContextManager:
    """Where what is known is computed at once, also while JAX traces other things."""
    return nullcontext() if is_traced(known_or_traced) else jax.ensure_compile_time_eval()


def induced_dirac(one_forms: Callable | None, n: int) -> DiracStructure:
    """The Dirac structure on T*Q induced by Δ_Q = ker W, W = `one_forms(q[, params])` (m, n) ([PY] (24), (25)).

    In coordinates x = (q, p), (q̇, ṗ; η, ξ) ∈ D iff W q̇ = 0, ξ = q̇ and η + ṗ ∈ image Wᵀ. Without one-forms (None) it is
    the canonical symplectic structure.
    """
    function = None if one_forms is None else UserFunction(one_forms, "one_forms", ("q",))
    return DiracStructure(Induced(function, n), "two_form" if function is None else "annihilator", 2 * n)


@partial(compiled, seldom=True)
def _courant_tensor(structure: DiracStructure, x: Float[Array, " n"], params: Any) -> Float[Array, "n n n"]:
    def scattering(x):
        return scattering_matrix(structure.kernel(x, params))

    X, alpha = LinearDirac(scattering(x)).image()
    derivative = jax.jacfwd(scattering)(x) / 2  # ∂_l of X[a, i] and of α[a, i] alike, indexed [a, i, l]
    # ⟨L_X α, Y⟩ = X^l ∂_l α_a Y^a + α_l ∂_a X^l Y^a
    lie = jnp.einsum("li,ajl,ak->ijk", X, derivative, X) + jnp.einsum("lj,lia,ak->ijk", alpha, derivative, X)
    return lie + jnp.transpose(lie, (2, 0, 1)) + jnp.transpose(lie, (1, 2, 0))


def canonical_two_form(n: int) -> Float[Array, "2*{n} 2*{n}"]:
    """ω = [[0, I], [−I, 0]] on R^{2n}: ω♭(q̇, ṗ) = (−ṗ, q̇)."""
    zero, identity = np.zeros((n, n)), np.eye(n)
    return jnp.asarray(np.block([[zero, identity], [-identity, zero]]))


class _Functions(eqx.Module):
    functions: tuple[UserFunction, ...]

    @property
    def text(self) -> str:
        """The functions by their names."""
        return ", ".join(f"{function.name}={value_text(function)}" for function in self.functions)

    def __call__(self, x, params):
        return tuple(_value(function, x, params) for function in self.functions)


def _value(function: UserFunction, x: Float[Array, " n"], params: Any) -> Float[Array, "rows columns"]:
    try:
        return jnp.asarray(function(x, params), dtype=float)
    except Exception:
        function.shape(x, params)  # says which function failed, on what shapes
        raise


def _functions(**functions: Callable) -> _Functions:
    return _Functions(tuple(UserFunction(function, name, ("x",)) for name, function in functions.items()))


class Induced(eqx.Module):
    """The matrices of the structure on T*Q that W induces, by which such a structure is known."""

    one_forms: UserFunction | None
    n: int = eqx.field(static=True)

    @property
    def text(self) -> str:
        """The one-forms."""
        return "canonical" if self.one_forms is None else f"induced by one_forms={value_text(self.one_forms)}"

    def __call__(self, x, params):
        form = canonical_two_form(self.n)
        if self.one_forms is None:
            return (form,)
        W = _value(self.one_forms, x[: self.n], params)
        if W.ndim != 2 or W.shape[1] != self.n:
            raise ValueError(f"one_forms returned shape {W.shape}; (m, {self.n}), one one-form a row, was expected.")
        return jnp.concatenate([W, jnp.zeros_like(W)], axis=1), form


class _PullBack(eqx.Module):
    structure: DiracStructure
    point_map: UserFunction

    @property
    def text(self) -> str:
        """The structure and the map."""
        return f"pull-back of {self.structure!r} by {value_text(self.point_map)}"

    def __call__(self, y, params):
        def position(y):
            return _value(self.point_map, y, params)

        x = position(y)
        jacobian = block_diagonal(jax.jacfwd(position)(y), np.eye(self.structure.ports))
        if self.structure.representation == "two_form":
            (form,) = self.structure.evaluate(x, params)
            return (jacobian.T @ form @ jacobian,)
        return self.structure.at(x, params).pull_back(jacobian).kernel()


class _Composition(eqx.Module):
    first: DiracStructure
    second: DiracStructure
    ports: tuple[int, ...] = eqx.field(static=True)
    other_ports: tuple[int, ...] = eqx.field(static=True)
    common: Literal["covectors", "vectors"] = eqx.field(static=True)

    @property
    def text(self) -> str:
        """The two, and the ports that they share."""
        shared = f" over ports {list(self.ports)} and {list(self.other_ports)}" if self.ports else ""
        return f"{self.first!r} and {self.second!r}{shared}"

    def __call__(self, x, params):
        n, m = self.first.n or 0, self.second.n or 0
        if self.ports:
            first, second = self.first.at(x[:n], params), self.second.at(x[n:], params)
            ports = [n + port for port in self.ports], [m + port for port in self.other_ports]
            with _in_numbers(first, second):
                F, E = map(known, first.compose(second, *ports, self.common).kernel())
        else:
            pairs = zip(self.first.kernel(x[:n], params), self.second.kernel(x[n:], params), strict=True)
            F, E = (block_diagonal(own, other) for own, other in pairs)
        free = self.first.ports - len(self.ports)  # (x, ports, x', ports') → (x, x', ports, ports')
        order = np.concatenate([np.arange(n), n + free + np.arange(m), n + np.arange(free), np.arange(n + m + free, F.shape[-1])])
        return F[:, order], E[:, order]
