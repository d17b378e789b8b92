"""Pieces of formulas as text and as MathML: letters with their indices, numbers, signs and products."""

import html
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

SPACE = '<mspace width="0.17em"></mspace>'

GREEK = {
    **{"alpha": "α", "beta": "β", "gamma": "γ", "delta": "δ", "epsilon": "ε", "zeta": "ζ", "eta": "η", "theta": "θ"},
    **{"kappa": "κ", "lambda": "λ", "mu": "μ", "nu": "ν", "xi": "ξ", "rho": "ρ", "sigma": "σ", "tau": "τ", "phi": "φ"},
    **{"chi": "χ", "psi": "ψ", "omega": "ω", "Gamma": "Γ", "Delta": "Δ", "Theta": "Θ", "Lambda": "Λ", "Pi": "Π"},
    **{"Sigma": "Σ", "Phi": "Φ", "Psi": "Ψ", "Omega": "Ω"},
}


@dataclass(frozen=True)
class Written:
    """A piece of a formula as text and as MathML; `tight`: whether it can be a factor, or the base of a power, as it is."""

    text: str
    mathml: str
    tight: bool = True
    indexed: tuple[str, str] | None = None
    """Of a letter with an index, both in MathML, so that a power can stand above the index."""

    def grouped(self) -> "Written":
        """With parentheses where it needs them."""
        if self.tight:
            return self
        return Written(f"({self.text})", f"<mrow><mo>(</mo>{self.mathml}<mo>)</mo></mrow>")


def symbol(name: str, dotted: bool = False) -> Written:
    """A name as a letter with an index: θ1, m_2, omega; dotted for a velocity."""
    base, index = name, ""
    if found := re.fullmatch(r"([^\W\d_]+?)_?(\d+(?:,\d+)*)", name) or re.fullmatch(r"([^\W_]+)_(\w+)", name):
        base, index = found.groups()
    base, index = GREEK.get(base, base), GREEK.get(index, index)
    letter = f"<mi>{html.escape(base)}</mi>"
    if dotted:
        letter = f'<mover accent="true">{letter}<mo>˙</mo></mover>'
    text = base[:1] + "\u0307" * dotted + base[1:] + index
    if not index:
        return Written(text, letter)
    below = f"<mi>{html.escape(index)}</mi>"
    return Written(text, f"<msub>{letter}{below}</msub>", indexed=(letter, below))


def symbols(names: Sequence[str], dotted: bool = False) -> np.ndarray:
    """One symbol a name."""
    found = np.empty(len(names), dtype=object)
    found[:] = [symbol(name, dotted) for name in names]
    return found


def of_params(params: Any) -> Any:
    """The symbols of parameters: of numbers by their names, of arrays with an index an entry."""

    def named(path: Any, leaf: Any) -> np.ndarray:
        name = "_".join(str(getattr(key, "key", getattr(key, "name", getattr(key, "idx", key)))) for key in path) or "params"
        shape = np.shape(leaf)
        entries = np.empty(shape, dtype=object)
        for at in np.ndindex(shape):
            index = ",".join(str(i + 1) for i in at)
            entries[at] = symbol(f"{name}_{index}" if index else name)
        return entries

    return jax.tree_util.tree_map_with_path(named, params)


def joined(pieces: Sequence[Written]) -> Written:
    """Pieces as one formula."""
    return Written("".join(one.text for one in pieces), "".join(one.mathml for one in pieces), tight=len(pieces) < 2)


def signed(place: int, factor: float, body: Written) -> Written:
    """A term of a sum with its sign."""
    minus, plus = ("−", "") if place == 0 else (" − ", " + ")
    sign = minus if factor < 0 else plus
    mark = f'<mo form="{"prefix" if place == 0 else "infix"}">{sign.strip()}</mo>' if sign else ""
    return Written(sign + body.text, mark + body.mathml, tight=place == 0 and factor > 0 and body.tight)


def raised_text(n: int) -> str:
    return f"^{n}" if n > 9 else "⁰¹²³⁴⁵⁶⁷⁸⁹"[n]


def texts(terms: Sequence[Written]) -> tuple[str, str]:
    whole = joined(terms)
    return whole.text, f"<mrow>{whole.mathml}</mrow>"


def alone(parts: list[Written]) -> Written:
    """Factors under or over a line of their own, where a single sum needs no parentheses."""
    return parts[0] if len(parts) == 1 else beside(parts)


def beside(parts: list[Written]) -> Written:
    grouped = [part.grouped() for part in parts]
    texts = " ".join(part.text for part in grouped)
    return Written(texts, f"<mrow>{SPACE.join(part.mathml for part in grouped)}</mrow>")


def number_of(value: float | int) -> Written:
    text = f"{value:.6g}"
    if "e" in text:
        mantissa, exponent = text.split("e")
        power = str(int(exponent)).replace("-", "−")
        return Written(
            f"{mantissa}·10^{power}", f"<mn>{mantissa}</mn><mo>·</mo><msup><mn>10</mn><mn>{power}</mn></msup>", tight=False
        )
    return Written(text, f"<mn>{text}</mn>")
