"""Casimirs of the dual of a semidirect product 𝔤 ⋉ V: what every Hamiltonian on it conserves, because the bivector does."""

from typing import NamedTuple

from dirax.geometry.semidirect import SemidirectProduct


class Casimir(NamedTuple):
    """A function on the dual: the inner product of the parts `first` and `second` of x = (μ, a).

    `carried`: it is one of a alone, which the group carries along whatever acts on μ.
    """

    name: str
    first: slice
    second: slice
    carried: bool


def casimirs(space: SemidirectProduct) -> list[Casimir]:
    """The Casimirs of 𝔤 ⋉ V.

    Rotations turn, and translations leave alone, the linear momentum P of SE(2) and SE(3) and the vectors a that are
    carried along: their inner products do not change. If there is one of them alone in space, its product with the angular
    momentum does not either; without any, the square of the angular momentum does not. Every other Casimir is a function
    of these. Quantities with a representation of their own have none that are known here.
    """
    if space.advected and space.representation is not None:
        return []
    shift, d, k = space.group.translations, space.dimension, space.vector_size
    angular, count = slice(shift, d), space.advected // k
    vectors = {"P": slice(0, shift)} if shift else {}
    vectors |= {"a" if count == 1 else f"a{i + 1}": slice(d + i * k, d + (i + 1) * k) for i in range(count)}
    names, momentum = list(vectors), "Π" if shift else "μ"
    found = [
        Casimir(f"|{u}|²" if u == v else f"{u}·{v}", vectors[u], vectors[v], "P" not in (u, v))
        for i, u in enumerate(names)
        for v in names[i:]
    ]
    if not names:
        found.append(Casimir(f"|{momentum}|²", angular, angular, False))
    elif len(names) == 1 and k == 3:
        found.append(Casimir(f"{momentum}·{names[0]}", angular, vectors[names[0]], False))
    return found
