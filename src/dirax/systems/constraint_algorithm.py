"""The constraint algorithm: M_k = τ(S_k), S_{k+1} = S_k ∩ TM_k, until it repeats or nothing is left ([BLM] §3).

S_0 is A_0(x)(ẋ, u) = b_0(x). A left null vector of A_0 gives a condition on x; all of them, M_0. The derivatives of these
conditions are appended as rows, which gives A_1, and so on. Rows that restrict no rate on M_k leave nothing but their
conditions, and are not asked again.
"""

from typing import Any

from dirax.program.captured import functions_in, refuse_changed
from dirax.program.user_functions import check_finite, is_traced
from dirax.systems.constraint_chain import IRREGULAR, ConstraintChain
from dirax.systems.constraint_search import Search
from dirax.systems.system import AbstractSystem


def constraint_algorithm(system: AbstractSystem, near: Any, params: Any = None, radius: float = 0.02) -> ConstraintChain:
    """The chain of constraint manifolds of an implicit system around the point `near`.

    `near`: a point x (N,), not necessarily on the constraints, which is (q, p) for a Lagrangian system with momenta that are
    affine in v, and (q, v, p) for another one; or initial data {"q": …, "v": …} of a Lagrangian system, with
    "t" where it depends on time: t is then the last coordinate of the chain, with ṫ = 1, and no projection moves it;
    `radius`: size of the neighbourhood in which ranks are checked to be constant, relative to 1 + |x| in the chain's `units`.

        chain = dx.constraint_algorithm(system, near=x)
        print(chain)

    Raises `ValueError` and `TypeError` as `system.implicit_form` does; what the algorithm finds is never an exception but the
    `verdict` and `explanation` of the chain: an inconsistent system ends empty, one whose rank changes ends irregular.
    """
    if is_traced(near, params):
        raise TypeError("constraint_algorithm inspects values: call it outside jax.jit, and use the chain's functions inside.")
    if not 0 < radius < 1:
        raise ValueError(f"radius must lie between 0 and 1, but {radius!r} was given.")
    if not isinstance(system, AbstractSystem):
        raise TypeError(f"system must be a dirax system, but {system!r:.80} was given: state it as dx.ImplicitSystem(E, f, B).")
    check_finite("near", near)
    refuse_changed(functions_in(system))
    return Search(system.implicit_form(near, params), params, radius).run()


def final_manifold_needed(system: AbstractSystem, near: Any, params: Any) -> str:
    """What a scheme says that refuses these data since it needs a final manifold: how to come to it, or why there is none."""
    try:
        chain = constraint_algorithm(system, near, params)
    except (TypeError, ValueError):
        chain = None
    if chain is not None and chain.verdict == IRREGULAR:
        return f"needs its final manifold, which is not found here: {chain.explanation[:-1]}"
    point = ", ".join(f'"{name}": …' for name in near if name != "t") if isinstance(near, dict) else ""
    return (
        f"needs its final manifold: simulate dx.constraint_algorithm(system, near={f'{{{point}}}' if point else 'x'})"
        ".resolved() instead of the system, from x=chain.point, with dx.DiscreteDirac()"
    )
