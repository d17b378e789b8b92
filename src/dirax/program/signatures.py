"""Signatures of user functions: whether they take the time and params, and whether their names stand where they are given."""

import functools
import inspect
from collections.abc import Callable, Sequence

POSITIONAL = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)

WORDS = {"t", "params", "multipliers"}
"""Names that mean one thing in every function; others do in functions that have an argument of that name."""

RIVALS = {"v": "p", "p": "v"}
"""Of the two a function has one, and may be taken for one of the other."""


def parameters_of(function: Callable) -> tuple[str, ...]:
    """The names of all arguments; none where the signature is not known."""
    return tuple(p.name for p in _parameters(function) or ())


def signature(function: Callable, arguments: Sequence[str]) -> str:
    """The function's own name with these arguments, e.g. `pendulum(q, v)`."""
    own = getattr(function, "__name__", type(function).__name__).replace("<lambda>", "lambda")
    return f"{own}({', '.join(arguments)})"


def takes_time(function: Callable, count: int) -> bool:
    """Whether the first argument is called `t` and `count` others follow."""
    positional = _positional(function)
    return len(positional) > count and positional[0] == "t"


def takes_params(function: Callable, name: str, expected: str, count: int) -> bool:
    """Whether params follow the `count` arguments. Raises `TypeError` for another number of arguments."""
    parameters = _parameters(function)
    if parameters is None or any(p.kind is p.VAR_POSITIONAL for p in parameters):
        return False
    positional = [p for p in parameters if p.kind in POSITIONAL]
    keywords = [p for p in parameters if p.kind is p.KEYWORD_ONLY and p.default is p.empty]
    required = [p for p in positional if p.default is p.empty] + keywords
    if not keywords:
        if len(required) == count + 1:
            return True
        if len(required) <= count <= len(positional):
            return len(positional) > count and positional[count].name == "params"
    alone = " and ".join(p.name for p in keywords)
    raise TypeError(
        f"{name} must have the signature {expected}, but {getattr(function, '__name__', 'it')} takes "
        f"{len(required)} argument{'s' if len(required) != 1 else ''}"
        f" ({', '.join(p.name for p in required) or 'none'})"
        f"{alone and f', {alone} by keyword alone: all are given by place, so take the * before {alone} away'}."
    )


def refuse_other_places(function: Callable, name: str, expected: str, arguments: Sequence[str]) -> None:
    """Raise `TypeError` where an argument has the name of one that is given in another place: `(v, q)` for `(q, v)`.

    Other names are free, and what stands for params may have any that is not one of the arguments."""
    words, given = WORDS.union(arguments), _positional(function)
    bound = function.keywords if isinstance(function, functools.partial) else {}
    for parameter in _parameters(function) or ():
        if parameter.kind is parameter.KEYWORD_ONLY and parameter.name in words and parameter.name not in bound:
            raise TypeError(
                f"{name} must have the signature {expected}, whose arguments are given by place, but "
                f"{getattr(function, '__name__', 'it')} takes {parameter.name} by keyword alone, so that it would never be "
                "given: take the * before it away."
            )
    for wanted, word in zip((*arguments, "params"), given, strict=False):
        if word != wanted and (word in words or RIVALS.get(word) == wanted):
            raise TypeError(
                f"{name} must have the signature {expected}, whose arguments are given by place, but "
                f"{getattr(function, '__name__', 'it')} takes ({', '.join(given)}), where {word} stands in the place of "
                f"{wanted}: put the arguments in that order, also those that are not used, or give what is not {word} another "
                "name."
            )


def _parameters(function: Callable) -> list[inspect.Parameter] | None:
    try:
        return list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):
        return None


def _positional(function: Callable) -> list[str]:
    return [p.name for p in _parameters(function) or () if p.kind in POSITIONAL]
