"""What the command line accepts: `--set k=v`, `--scheme …`, and a user's own file."""

import ast
import difflib
import runpy
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import dirax
from dirax import gallery
from dirax.gallery import Example
from dirax.schemes.composition import COEFFICIENTS
from dirax.schemes.step import AbstractScheme

SHORT_SCHEMES: dict[str, Callable[[], AbstractScheme]] = {
    "plus": dirax.PlusLagrangeDirac,
    "minus": dirax.MinusLagrangeDirac,
    "midpoint": dirax.LagrangeDAlembert,
    "trapezoidal": lambda: dirax.LagrangeDAlembert("trapezoidal"),
    "method1": dirax.DiscreteDirac,
    "method2": lambda: dirax.DiscreteDirac(constraints="resolve"),
}
"""Scheme names of the command line."""

INITIAL = ("q", "v", "p", "q0", "q1", "x")
SETTINGS = ("step", "steps", "save_every", "project", "check_initial")


class InputError(ValueError):
    """A mistake on the command line, to be shown as one or two sentences."""


def parse_scheme(text: str) -> AbstractScheme:
    """A short name ("plus", "minus", "midpoint", "trapezoidal", "method1", "method2"), or a call of a dirax class with literal
    arguments and maps or schemes, such as `DiscreteDirac(map=Theta(0.5), constraints="resolve")` or
    `Composition(LagrangeDAlembert(), "suzuki4")`. Nothing is evaluated but these. Raises `InputError` otherwise."""
    if text in SHORT_SCHEMES:
        return SHORT_SCHEMES[text]()
    if text.isidentifier() and text not in dirax.__all__:
        near = difflib.get_close_matches(text, SHORT_SCHEMES, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(SHORT_SCHEMES)}."
        raise InputError(f"no scheme {text!r}: {hint}")
    try:
        scheme = _built(ast.parse(text, mode="eval").body)
    except (SyntaxError, TypeError, ValueError) as error:
        names = ", ".join(SHORT_SCHEMES)
        raise InputError(
            f"--scheme {text!r} is not one of {names}, nor a call like LagrangeDAlembert('midpoint'): {error}"
        ) from error
    if not isinstance(scheme, AbstractScheme):
        raise InputError(
            f"--scheme {text!r} makes a {type(scheme).__name__}, which is no scheme: try {', '.join(SHORT_SCHEMES)}."
        )
    return scheme


def _built(node: ast.expr) -> Any:
    """The value of a literal, or of a call of a public dirax class whose arguments are such values."""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        maker = getattr(dirax, node.func.id, None) if node.func.id in dirax.__all__ else None
        if not isinstance(maker, type) and maker is not dirax.Midpoint and maker is not dirax.cotangent_lift:
            near = difflib.get_close_matches(node.func.id, dirax.__all__, n=1)
            raise ValueError(f"dirax has no class {node.func.id!r}" + (f", did you mean {near[0]!r}?" if near else "."))
        if any(keyword.arg is None for keyword in node.keywords):
            raise ValueError("** is not accepted.")
        return maker(*map(_built, node.args), **{str(k.arg): _built(k.value) for k in node.keywords})
    return ast.literal_eval(node)


def parse_settings(pairs: Sequence[str]) -> dict[str, Any]:
    """`["steps=100", "q=[0, 1]", "m=2"]` as a dict; values are Python literals, other text stays text."""
    settings = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not equals or not name.strip().isidentifier():
            raise InputError(f"--set takes name=value, such as --set steps=1000, but {pair!r} was given.")
        try:
            settings[name.strip()] = ast.literal_eval(text)
        except (SyntaxError, ValueError) as error:
            raise InputError(f"the value of --set {pair!r} must be a number, a list or a quoted string.") from error
    return settings


def changed(example: Example, settings: dict[str, Any]) -> dict[str, Any]:
    """The keywords for `example.simulate`: settings of the run, initial data (over the example's), and the rest as params."""
    params = dict(example.params or {})
    keywords: dict[str, Any] = {}
    initial = dict(example.initial)
    for name, value in settings.items():
        if name in SETTINGS:
            keywords[name] = value
        elif name in INITIAL:
            initial[name] = np.asarray(value, dtype=float)
            keywords.update(initial)
        elif name in params:
            number = isinstance(params[name], float) and isinstance(value, int)  # --set k=1 of a parameter that is 4.0
            keywords.setdefault("params", {})[name] = float(value) if number else value
        else:
            known = [*SETTINGS, *INITIAL, *params]
            near = difflib.get_close_matches(name, known, n=1)
            raise InputError(
                f"--set {name}=… : no such setting; {f'did you mean {near[0]!r}?' if near else 'there are ' + ', '.join(known)}"
            )
    for pair in (("q", "v", "p"), ("q0", "q1")):
        if any(name in settings for name in pair) and not set(pair) & set(example.initial):
            for other in example.initial:
                keywords.pop(other, None)
    if "p" in settings:
        keywords.pop("v", None)
    if "v" in settings:
        keywords.pop("p", None)
    return keywords


def find_example(target: str) -> Example:
    """The gallery's example of that name, or the one that a .py file defines by `system` and `initial`.

    The file may also define `scheme`, `step` (.01), `steps` (1000), `params` and `title`. Raises `InputError`.
    """
    if not target.endswith(".py"):
        try:
            return gallery.get(target)
        except ValueError as error:
            raise InputError(str(error)) from error
    path = Path(target)
    if not path.is_file():
        raise InputError(f"there is no file {target!r}.")
    try:
        names = runpy.run_path(str(path))
    except Exception as error:
        raise InputError(f"{target} could not be run: {type(error).__name__}: {error}") from error
    for needed in ("system", "initial"):
        if needed not in names:
            raise InputError(
                f"{target} must define `system` (a dirax system) and `initial` (a dict such as dict(q=…, v=…)), "
                f"but it has no `{needed}`."
            )
    initial = {name: np.asarray(value, dtype=float) for name, value in dict(names["initial"]).items()}
    optional = {"scheme": names["scheme"]} if "scheme" in names else {}
    size = len(next(iter(initial.values())))
    return Example(
        name=path.stem,
        title=str(names.get("title", path.stem)),
        source=target,
        system=names["system"],
        initial=initial,
        step=names.get("step", 0.01),
        steps=names.get("steps", 1000),
        params=names.get("params"),
        coordinates=tuple(gallery.Coordinate(f"{'x' if 'x' in initial else 'q'}{i}") for i in range(size)),
        **optional,
    )


def scheme_names() -> str:
    """The scheme names, for the help page."""
    return (
        f"{', '.join(SHORT_SCHEMES)}, or a call such as Composition(LagrangeDAlembert(), 'suzuki4') ({', '.join(COEFFICIENTS)})"
    )
