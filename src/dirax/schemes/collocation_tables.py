"""Nodes, weights and matrices of collocation methods, to the last bit of double precision, for any number of stages.

Everything is computed in decimal arithmetic when it is first asked for: the nodes as roots of polynomials by Newton's method,
the rest by exact integrals of Lagrange polynomials.
"""

from dataclasses import dataclass
from decimal import Decimal, localcontext
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np

DIGITS = 80
"""Decimal digits of the computation: 16 stages lose about 30 of them in the coefficients of their polynomials."""

MOST_STAGES = 16

Polynomial = list[Decimal]
"""Coefficients, the constant first."""


@dataclass(frozen=True, eq=False)
class Tableau:
    """A collocation method on [0, 1]: `nodes` c (s,), `weights` b (s,), `matrix` A (s, s) with A_ij = ∫_0^{c_i} ℓ_j.

    `conjugate` is Â with b_i Â_ij + b_j A_ji = b_i b_j, which makes the pair (A, Â) symplectic: A itself for Gauss nodes, the
    matrix of Lobatto IIIB for those of Lobatto (IIIA). `extrapolation` (s, s) takes the values of a polynomial of degree
    s − 1 at the nodes to those at 1 + c_i, the nodes of the next step. `second` is A·A, rounded once. `shares` are
    μ_ij = A_ij/b_j, rounded so that μ_ij + μ_ji = 1 holds exactly for a symplectic A: a_i = a_0 + Σ_j μ_ij (h b_j ȧ_j) keeps
    quadratic invariants then whatever b was rounded to (Antoñana, Makazaga, Murua 2017).
    """

    nodes: np.ndarray
    weights: np.ndarray
    matrix: np.ndarray
    conjugate: np.ndarray
    extrapolation: np.ndarray
    second: np.ndarray
    shares: np.ndarray

    @property
    def stages(self) -> int:
        """Their number s."""
        return len(self.nodes)

    @cached_property
    def modes(self) -> list[list[float]]:
        """(s, s): ℓ_j = Σ_k modes_jk P_k with the Legendre polynomials P_k of [0, 1]."""
        values = np.polynomial.legendre.legvander(2.0 * self.nodes - 1.0, self.stages - 1)
        return np.linalg.inv(values).T.tolist()

    @cached_property
    def eigenbasis(self) -> "Eigenbasis":
        """That of A."""
        found: Any = np.linalg.eig(self.matrix)
        values, vectors = found
        inverse: Any = np.linalg.inv(vectors)
        upper = sorted(np.flatnonzero(values.imag >= 0.0), key=lambda k: -values[k].imag)  # a real one is the last
        rows, columns = [], []
        for k in upper:
            pair = values[k].imag > 0.0
            rows += [inverse[k].real, inverse[k].imag][: 1 + pair]
            columns += [2.0 * vectors[:, k].real, -2.0 * vectors[:, k].imag] if pair else [vectors[:, k].real]
        return Eigenbasis(values[upper], np.array(rows), np.array(columns).T)

    def integrals(self, theta: Any) -> list[Any]:
        """∫_0^θ ℓ_j for every j: A of the node θ. `theta` a number or an array."""
        x = 2.0 * theta - 1.0
        p = [1.0 + 0.0 * x, x]
        for k in range(1, self.stages):
            p.append(((2 * k + 1) * x * p[k] - k * p[k - 1]) / (k + 1))
        moments = [theta, *((p[k + 1] - p[k - 1]) / (4 * k + 2) for k in range(1, self.stages))]
        return [sum((m * c for m, c in zip(moments[1:], row[1:], strict=True)), moments[0] * row[0]) for row in self.modes]


class Eigenbasis(NamedTuple):
    """The eigenvalues `values` of A, of every pair one, and a real one at the end if s is odd. `into` (s, s) takes vectors of
    the stages into the basis of eigenvectors, real and imaginary parts one after the other; `back` (s, s) the solutions back."""

    values: np.ndarray
    into: np.ndarray
    back: np.ndarray


@cache
def gauss(stages: int) -> Tableau:
    """The Gauss method of s stages: order 2s, symplectic, self-adjoint (Hairer, Lubich, Wanner, II.1.3)."""
    with localcontext() as context:
        context.prec = DIGITS
        return _tableau(_roots(_legendre(stages), stages))


@cache
def lobatto(stages: int) -> Tableau:
    """The Lobatto IIIA method of s ≥ 2 stages, with IIIB as its conjugate: order 2s − 2, self-adjoint, c_1 = 0 and c_s = 1."""
    with localcontext() as context:
        context.prec = DIGITS
        inner = _roots(_derivative(_legendre(stages - 1)), stages - 2)
        return _tableau([Decimal(0), *inner, Decimal(1)])


@dataclass(frozen=True, eq=False)
class Quadrature:
    """Gauss quadrature with r points τ_k over a step of a Gauss method of s stages, of functions times the ℓ_i of its nodes.

    `points` τ (r,); `matrix` (r, s), ∫_0^{τ_k} ℓ_j, takes rates at the nodes to points; `values` (r, s), ℓ_j(τ_k), to rates at
    the points; `means` (s, r) takes values g_k at the points to (1/b_i) Σ_k w_k ℓ_i(τ_k) g_k; `end` (s,), ℓ_j(1), takes rates to
    the one at the end.
    """

    points: np.ndarray
    matrix: np.ndarray
    values: np.ndarray
    means: np.ndarray
    end: np.ndarray


@cache
def quadrature(stages: int, points: int) -> Quadrature:
    """Gauss quadrature with so many points over a step of the Gauss method of so many stages."""
    with localcontext() as context:
        context.prec = DIGITS
        nodes, inner = _roots(_legendre(stages), stages), _roots(_legendre(points), points)
        basis, weights = [_lagrange(nodes, j) for j in range(stages)], _weights(inner)
        integrals, shares = [_integral(polynomial) for polynomial in basis], _weights(nodes)
        return _rounded(
            Quadrature,
            inner,
            [[_value(integral, x) for integral in integrals] for x in inner],
            [[_value(polynomial, x) for polynomial in basis] for x in inner],
            [[w * _value(basis[i], x) / shares[i] for x, w in zip(inner, weights, strict=True)] for i in range(stages)],
            [_value(polynomial, Decimal(1)) for polynomial in basis],
        )


def _weights(nodes: list[Decimal]) -> list[Decimal]:
    """∫_0^1 ℓ_j."""
    return [_value(_integral(_lagrange(nodes, j)), Decimal(1)) for j in range(len(nodes))]


def _rounded(kind: Any, *tables: Any) -> Any:
    """A record of tables in double precision, which nobody changes."""
    arrays = [np.array([[float(x) for x in row] if isinstance(row, list) else float(row) for row in table]) for table in tables]
    for array in arrays:
        array.flags.writeable = False
    return kind(*arrays)


def _tableau(nodes: list[Decimal]) -> Tableau:
    s = len(nodes)
    basis = [_lagrange(nodes, j) for j in range(s)]
    integrals = [_integral(polynomial) for polynomial in basis]
    weights = [_value(integral, Decimal(1)) for integral in integrals]
    matrix = [[_value(integral, c) for integral in integrals] for c in nodes]
    conjugate = [[weights[j] - weights[j] * matrix[j][i] / weights[i] for j in range(s)] for i in range(s)]
    extrapolation = [[_value(polynomial, 1 + c) for polynomial in basis] for c in nodes]
    second = [[sum((matrix[i][k] * matrix[k][j] for k in range(s)), Decimal(0)) for j in range(s)] for i in range(s)]
    rounded = lambda values: np.array([[float(x) for x in row] for row in values])
    vector = lambda values: np.array([float(x) for x in values])
    shares = rounded([[matrix[i][j] / weights[j] for j in range(s)] for i in range(s)])
    symplectic = max(abs(conjugate[i][j] - matrix[i][j]) for i in range(s) for j in range(s)) < Decimal(10) ** (30 - DIGITS)
    for i, j in zip(*np.nonzero(shares >= 0.5), strict=True) if symplectic else ():
        shares[j, i] = 1.0 - shares[i, j]  # exact from ½ to 2
    arrays = [vector(nodes), vector(weights), *map(rounded, (matrix, conjugate, extrapolation, second)), shares]
    made = Tableau(*arrays)
    for array in vars(made).values():
        array.flags.writeable = False
    return made


def _legendre(degree: int) -> Polynomial:
    """The Legendre polynomial of this degree on [0, 1]: (k + 1) P_{k+1} = (2k + 1)(2x − 1) P_k − k P_{k−1}."""
    before, now = [Decimal(0)], [Decimal(1)]
    for k in range(degree):
        shifted = [2 * (now[i - 1] if i else Decimal(0)) - (now[i] if i < len(now) else Decimal(0)) for i in range(len(now) + 1)]
        padded = [*before, *[Decimal(0)] * (len(shifted) - len(before))]
        before, now = now, [((2 * k + 1) * a - k * b) / (k + 1) for a, b in zip(shifted, padded, strict=True)]
    return now


def _roots(polynomial: Polynomial, count: int) -> list[Decimal]:
    """The roots of a polynomial all of whose roots lie in ]0, 1[, in order: Newton's method, each root found divided out of the
    correction (Maehly)."""
    slope, found = _derivative(polynomial), []
    start = np.sort((1 - np.cos(np.pi * (np.arange(count) + 0.75) / (count + 0.5))) / 2)
    for guess in start:
        x = Decimal(float(guess))
        for _ in range(100):
            value = _value(polynomial, x)
            away = sum((1 / (x - root) for root in found), Decimal(0))
            change = value / (_value(slope, x) - value * away)
            x -= change
            if abs(change) < Decimal(10) ** (20 - DIGITS):
                break
        found.append(x)
    return sorted(found)


def _lagrange(nodes: list[Decimal], j: int) -> Polynomial:
    """ℓ_j: one at node j, zero at the others."""
    polynomial = [Decimal(1)]
    for i, node in enumerate(nodes):
        if i != j:
            gap = nodes[j] - node
            times_x, constant = [Decimal(0), *polynomial], [*polynomial, Decimal(0)]
            polynomial = [(a - node * b) / gap for a, b in zip(times_x, constant, strict=True)]
    return polynomial


def _value(polynomial: Polynomial, x: Decimal) -> Decimal:
    total = Decimal(0)
    for coefficient in reversed(polynomial):
        total = total * x + coefficient
    return total


def _derivative(polynomial: Polynomial) -> Polynomial:
    return [k * coefficient for k, coefficient in enumerate(polynomial)][1:]


def _integral(polynomial: Polynomial) -> Polynomial:
    return [Decimal(0), *(coefficient / (k + 1) for k, coefficient in enumerate(polynomial))]
