"""Schemes by what a user types: a short name, or a class of dirax with plain arguments. Nothing is evaluated."""

import ast
import contextlib
import difflib
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

import dirax
from dirax.schemes.discrete_dirac import DiscreteDirac
from dirax.schemes.discrete_gradient import DiscreteGradient
from dirax.schemes.euler_poincare import DiscreteEulerPoincare
from dirax.schemes.lagrange_dirac import LagrangeDAlembert, MinusLagrangeDirac, PlusLagrangeDirac
from dirax.schemes.step import AbstractScheme, Shape, make_step_equation
from dirax.systems.system import AbstractSystem
from dirax.text.representation import shortened

SHORT_NAMES: dict[str, AbstractScheme] = {
    "plus": PlusLagrangeDirac(),
    "minus": MinusLagrangeDirac(),
    "midpoint": LagrangeDAlembert("midpoint", "midpoint"),
    "trapezoidal": LagrangeDAlembert("trapezoidal", "midpoint"),
    "method1": DiscreteDirac(constraints="discretize"),
    "method2": DiscreteDirac(constraints="resolve"),
    "gradient": DiscreteGradient(),
    "poincare": DiscreteEulerPoincare(),
}
"""The general schemes, from the simplest on."""

FIRST = "midpoint", "gradient", "method1", "poincare"
"""Those of which a system takes the first one that suits it where none is named."""

ROOMS = (
    "dirax.schemes.",
    "dirax.geometry.maps",
    "dirax.geometry.projected_map",
    "dirax.geometry.spaces",
    "dirax.geometry.lie_groups",
    "dirax.geometry.cotangent",
)


def first_scheme(system: AbstractSystem, initial: Mapping[str, Any], params: Any) -> AbstractScheme:
    """The scheme of a system for which none is named; the very first, which says what it takes, where none suits it."""
    data: dict[str, Any] = {name: np.asarray(value, float) for name, value in initial.items()}
    data = {name: a[0] if a.ndim == 2 and len(a) else a for name, a in data.items()}  # of the first of several trajectories
    shape = Shape(*system.sizes(data, params))
    for name in FIRST:
        with contextlib.suppress(TypeError):
            make_step_equation(SHORT_NAMES[name], system, shape)
            return SHORT_NAMES[name]
    return SHORT_NAMES[FIRST[0]]


def scheme_from_text(text: str) -> AbstractScheme:
    """The scheme that `text` names: "plus", or `Composition(LagrangeDAlembert(), "suzuki4")` in Python's notation.

    Arguments are literals, or schemes and maps written in the same way. Raises `ValueError` with the nearest name for an
    unknown one, and what the class raises for arguments that it refuses.
    """
    if text in SHORT_NAMES:
        return SHORT_NAMES[text]
    try:
        tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise ValueError(f"cannot read the scheme {shortened(text)}: {_choices()}") from None
    scheme = _value(tree, text)
    if not isinstance(scheme, AbstractScheme):
        raise ValueError(f"{shortened(text)} is not a scheme: {_choices()}")
    return scheme


def _value(node: ast.expr, text: str) -> Any:
    if isinstance(node, ast.Name) and node.id in SHORT_NAMES:
        return SHORT_NAMES[node.id]
    if isinstance(node, ast.Name):
        return _maker(node.id)()
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        if any(keyword.arg is None for keyword in node.keywords):
            raise ValueError(f"cannot read {shortened(text)}: write every argument out, without **.")
        maker = _maker(node.func.id)
        named = {str(keyword.arg): _value(keyword.value, text) for keyword in node.keywords}
        return maker(*(_value(argument, text) for argument in node.args), **named)
    try:
        return ast.literal_eval(node)
    except ValueError:
        raise ValueError(
            f"cannot read {shortened(ast.unparse(node))} in a scheme: arguments are numbers, strings, lists, or schemes and "
            "maps of dirax."
        ) from None


def _maker(name: str) -> Any:
    makers = _makers()
    if name in makers:
        return makers[name]
    near = difflib.get_close_matches(name, [*SHORT_NAMES, *makers], n=1)
    raise ValueError(f"no scheme {shortened(name)}: {f'did you mean {near[0]!r}?' if near else _choices()}")


@cache
def _makers() -> dict[str, Any]:
    """What may be called: public schemes, and the maps and manifolds that some of them take."""
    public = {name: getattr(dirax, name) for name in dirax.__all__ if not name.startswith("Abstract")}
    return {name: thing for name, thing in public.items() if callable(thing) and thing.__module__.startswith(ROOMS)}


def _choices() -> str:
    return f"choose {', '.join(SHORT_NAMES)}, or write a class such as LagrangeDAlembert('midpoint', constraint='left')."
