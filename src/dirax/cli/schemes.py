"""Schemes by what a user types: a short name, or a class of dirax with plain arguments. Nothing is evaluated."""

import ast
import difflib
from typing import Any

import dirax
from dirax.geometry.maps import AbstractDiscretizationMap
from dirax.schemes.lagrange_dirac import LagrangeDAlembert, MinusLagrangeDirac, PlusLagrangeDirac
from dirax.schemes.step import AbstractScheme

SHORT_NAMES = {
    "plus": PlusLagrangeDirac(),
    "minus": MinusLagrangeDirac(),
    "midpoint": LagrangeDAlembert("midpoint", "midpoint"),
    "trapezoidal": LagrangeDAlembert("trapezoidal", "midpoint"),
}
CLASSES = {
    name: thing
    for name in dirax.__all__
    if isinstance(thing := getattr(dirax, name), type)
    and issubclass(thing, AbstractScheme | AbstractDiscretizationMap)
    and not name.startswith("Abstract")
}
"""The classes that may be written: schemes, and the discretization maps that some of them take."""


def scheme_from_text(text: str) -> AbstractScheme:
    """The scheme that `text` names: "plus", or `Composition(LagrangeDAlembert(), "suzuki4")` in Python's notation.

    Arguments are literals, or schemes and maps written in the same way. Raises `ValueError` with the nearest name for an
    unknown one, and what the class raises for arguments that it refuses.
    """
    if text in SHORT_NAMES:
        return SHORT_NAMES[text]
    try:
        tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError):
        raise ValueError(f"cannot read the scheme {text!r}: {_choices()}") from None
    scheme = _value(tree, text)
    if not isinstance(scheme, AbstractScheme):
        raise ValueError(f"{text!r} is not a scheme: {_choices()}")
    return scheme


def _value(node: ast.expr, text: str) -> Any:
    if isinstance(node, ast.Name) and node.id in SHORT_NAMES:
        return SHORT_NAMES[node.id]
    if isinstance(node, ast.Name) or (isinstance(node, ast.Call) and isinstance(node.func, ast.Name)):
        name = node.id if isinstance(node, ast.Name) else node.func.id  # pyright: ignore[reportAttributeAccessIssue]
        if name not in CLASSES:
            near = difflib.get_close_matches(name, [*SHORT_NAMES, *CLASSES], n=1)
            raise ValueError(f"no scheme {name!r}: {f'did you mean {near[0]}?' if near else _choices()}")
        arguments = node.args if isinstance(node, ast.Call) else []
        keywords = node.keywords if isinstance(node, ast.Call) else []
        if any(keyword.arg is None for keyword in keywords):
            raise ValueError(f"cannot read {text!r}: write every argument out, without **.")
        named = {str(keyword.arg): _value(keyword.value, text) for keyword in keywords}
        return CLASSES[name](*(_value(argument, text) for argument in arguments), **named)
    try:
        return ast.literal_eval(node)
    except ValueError:
        raise ValueError(
            f"cannot read {ast.unparse(node)!r} in the scheme {text!r}: arguments are numbers, strings, lists or classes."
        ) from None


def _choices() -> str:
    return f"choose {', '.join(SHORT_NAMES)}, or write a class such as LagrangeDAlembert('midpoint', constraint='left')."
