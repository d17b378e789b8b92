"""What axes are called: names and units from `solution.metadata`, in mathematical type."""

from typing import Any

import numpy as np


def position(sol: Any) -> np.ndarray:
    """q, or x where there is no q."""
    return np.asarray(sol.fields["q"] if "q" in sol.fields else sol.fields["x"])


def names_of(sol: Any) -> list[str]:
    """The names of the entries of q (or x), q0, q1, … where the metadata have none."""
    size = position(sol).shape[-1]
    field = "q" if "q" in sol.fields else "x"
    names = list(sol.metadata.get("coordinates", ()))
    return names if len(names) == size else [f"{field}{k}" for k in range(size)]


def units_of(sol: Any) -> list[str]:
    """Their units, "" where the metadata have none."""
    size = position(sol).shape[-1]
    units = list(sol.metadata.get("units", {}).get("q", ()))
    return units if len(units) == size else [""] * size


def state_names(sol: Any) -> list[str]:
    """The names of q (or x), and after them the momenta p_NAME."""
    return [*names_of(sol), *([f"p_{name}" for name in names_of(sol)] if "p" in sol.fields else [])]


def state_symbol(name: str) -> str:
    """The name of an entry of the state in mathematical type."""
    return symbol(*letter_and_index(name))


def letter_and_index(name: str) -> tuple[str, str]:
    """p_φ is the letter p with the index φ."""
    letter, _, index = name.partition("_")
    return letter, index


def index_of(sol: Any, which: int | str) -> int:
    """The position of an entry of q (or x), given by its index or name. Raises `ValueError` for unknown ones."""
    return entry(names_of(sol), which)


def entry(names: list[str], which: int | str) -> int:
    """The position of `which`, an index or one of `names`. Raises `ValueError` for unknown ones."""
    if which in names:
        return names.index(str(which))
    if isinstance(which, int | np.integer) and -len(names) <= which < len(names):
        return int(which) % len(names)
    if not names:
        raise ValueError(
            "this run has no coordinates, for its shape space is a point: dx.reconstruct(sol) gives the motion of the group."
        )
    raise ValueError(f"no coordinate {which!r}: give an index from 0 to {len(names) - 1} or one of {', '.join(names)}.")


def symbol(name: str, index: str = "") -> str:
    """A name in mathematical type, its digits at the end as an index: θ1 becomes θ₁."""
    letters = name.rstrip("0123456789")
    index = index or name[len(letters) :]
    return f"${letters}_{{{index}}}$" if index else f"${letters}$" if len(letters) == 1 else letters


def label(name: str, unit: str) -> str:
    """A name with its unit, where it has one."""
    return f"{name} ({unit})" if unit else name


def time_label(sol: Any) -> str:
    """The label of an axis of time."""
    return label("$t$", sol.metadata.get("units", {}).get("t", ""))
