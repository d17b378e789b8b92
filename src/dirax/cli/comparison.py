"""What `dirax compare` compares: the schemes that the user names, or those that suit the system."""

from collections.abc import Sequence
from typing import Any

from dirax.cli.schemes import SHORT_NAMES, scheme_from_text
from dirax.diagnostics.compare import Comparison, compare
from dirax.gallery.example import Example
from dirax.schemes.step import AbstractScheme


def compare_schemes(example: Example, chosen: Sequence[str], options: dict[str, Any]) -> Comparison:
    """`dx.compare` on the example, with its exact solution as reference where there is one."""
    schemes = {text: scheme_from_text(text) for text in chosen} or suitable(example, options)
    params = {} if example.params is None else {"params": example.params}
    exact = example.exact
    reference = None if exact is None else lambda t: exact(t, params=example.params, **example.initial)
    return compare(
        example.system,
        schemes,
        step=example.step,
        steps=example.steps,
        reference=reference,
        **example.initial,
        **params,
        **options,
    )


def suitable(example: Example, options: dict[str, Any]) -> dict[str, AbstractScheme]:
    """The short names that can take a step of the example, after its own scheme if that is another one."""
    schemes: dict[str, AbstractScheme] = {}
    for name, scheme in SHORT_NAMES.items():
        try:
            example.simulate(scheme, **{**options, "steps": 1})
        except (TypeError, ValueError):
            continue
        schemes[name] = scheme
    if example.scheme not in schemes.values():
        schemes = {type(example.scheme).__name__: example.scheme, **schemes}
    return schemes
