"""The sets of a port-Hamiltonian system in TM ⊕ T*M: coisotropic with open ports, Dirac with closed ones ([BLM] §7)."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from dirax.geometry.linear import LinearDirac
from dirax.geometry.structures import DiracStructure
from dirax.geometry.subspaces import AnyArray, PontryaginSubspace, known, namespace, pseudo_inverse


def structure_at(J: Any, closed: Any, unclosed: Any) -> LinearDirac | PontryaginSubspace:
    """{(v, α) : v ∈ Jα + im B, B_cᵀα = 0} of J (N, N), the closed columns B_c of B and the open ones."""
    onto = _onto_kernel(closed)
    if unclosed.shape[1] == 0:
        return LinearDirac.from_kernel(*_kernel(J, onto))
    xp = namespace(J, closed, unclosed)
    ports = xp.concatenate([closed, unclosed], axis=1)
    vectors, covectors = [J @ onto, ports], [onto, xp.zeros(ports.shape)]
    return PontryaginSubspace.from_image(xp.concatenate(vectors, axis=1), xp.concatenate(covectors, axis=1))


def _onto_kernel(closed: AnyArray) -> AnyArray:
    """The orthogonal projector of covectors onto those with B_cᵀα = 0."""
    whole = np.eye(closed.shape[0])
    return whole if not closed.shape[1] else whole - closed @ pseudo_inverse(closed)


def _kernel(J: AnyArray, onto: AnyArray) -> tuple[AnyArray, AnyArray]:
    """(F, E) with F v + E α = 0 iff B_cᵀα = 0 and v − Jα ∈ im B_c."""
    return onto, np.eye(onto.shape[0]) - onto - onto @ J


def closed_structure(system: Any) -> DiracStructure:
    """The Dirac structure of a system without open ports on M."""
    parts = lambda x, params: (jnp.asarray(system.J(x, params)), jnp.asarray(system.closed_matrix(x, params)))

    def side(index: int):
        def matrix(x, params):
            J, closed = parts(x, params)
            return _kernel(J, _onto_kernel(closed))[index]

        return matrix

    return DiracStructure.from_kernel(side(0), side(1))


def structure_of(system: Any, x: Any, params: Any) -> LinearDirac | PontryaginSubspace:
    """`PortHamiltonian.dirac_structure(x, params)` of a point at which the system was checked."""
    J, closed, unclosed = system.J(x, params), system.closed_matrix(x, params), system.open_matrix(x, params)
    return structure_at(*(known(jnp.asarray(a)) for a in (J, closed, unclosed)))
