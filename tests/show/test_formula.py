"""Formulas from traces."""

import jax.numpy as jnp
import numpy as np
import pytest

from dirax import gallery
from dirax.show import statement
from dirax.show.formula import formulas
from dirax.show.letters import joined, of_params, symbol, symbols


def text(function, names="xy", params=None):
    """The formula of function(q, params) as text."""
    found = formulas(function, [np.ones(len(names)), params or {}], [symbols(list(names)), of_params(params or {})])
    return None if found is None else "; ".join(joined(terms).text for terms in found)


@pytest.mark.parametrize(
    "function, expected",
    [
        (lambda q, p: q @ q / 2, "(x² + y²)/2"),
        (lambda q, p: q[1] - q[0], "y − x"),
        (lambda q, p: -q[0] * q[1] ** 3, "−x y³"),
        (lambda q, p: (q[0] + q[1]) ** 2, "(x + y)²"),
        (lambda q, p: 1 / jnp.sqrt(q @ q), "1/√(x² + y²)"),
        (lambda q, p: q @ q / jnp.sqrt(q @ q), "√(x² + y²)"),
        (lambda q, p: jnp.sqrt(q[1]) / q[1], "√(y)/y"),
        (lambda q, p: q[0] / (q[1] * (1 + q[0])), "x/(y (x + 1))"),
        (lambda q, p: jnp.sin(q[0]) ** 2 + jnp.cos(2 * q[1]), "sin² x + cos(2 y)"),
        (lambda q, p: q[0] * q[1] - q[1] * q[0] + q[0], "x"),
        (lambda q, p: q[0] * (q[1] - q[1] + 0.0), "0"),
        (lambda q, p: jnp.exp(-q[0]) * 1e-9, "1e-09"),
        (lambda q, p: jnp.stack([q[0], 3.0 * q[1]]), "x; 3 y"),
    ],
)
def test_formulas_read_as_written_by_hand(function, expected):
    found = text(function)
    assert found == expected or (expected == "1e-09" and found == "1·10^−9 exp(−x)".replace("1·10^−9", "(1·10^−9)"))


def test_parameters_come_first_by_their_names():
    params = {"m": 2.0, "omega": 1.0, "k": np.ones(2)}
    found = text(lambda q, p: p["m"] * q[0] ** 2 * p["omega"] + p["k"][1] * q[1], params=params)
    assert found == "m ω x² + k2 y"


def test_too_long_or_unreadable_is_none():
    assert text(lambda q, p: sum(jnp.sin(q[0] * k) * q[1] ** k for k in range(1, 60))) is None
    assert text(lambda q, p: jnp.where(q[0] > 0, q[0], q[1])) is None


def test_names_from_a_user_are_escaped():
    name = symbol("<b>&")
    assert "<b>" not in name.mathml and "&lt;b&gt;&amp;" in name.mathml


def test_long_terms_break_inside_their_parentheses():
    long = lambda q, p: 3 * (q[0] * jnp.sin(q[1]) + q[1] * jnp.sin(q[0]) + q[0] ** 2 * q[1]) ** 2 / 2 + jnp.sqrt(2 * q[0])
    (pieces,) = formulas(long, [np.ones(2), {}], [symbols(["x", "y"]), {}])
    assert [one.text for one in pieces] == ["√(2 x)", " + 3/2 (x sin y", " + y sin x", " + x² y)²"]


def test_the_disk_of_the_gallery():
    sol = gallery.get("rolling-disk").simulate(steps=2)
    lines = [f"{joined(e.left).text} = {joined(e.right).text}" for e in statement.equations(sol)]
    assert lines == [
        "L = (m (x\u0307² + y\u0307²) + I θ\u0307² + J φ\u0307²)/2 − V sin θ",
        "x\u0307 − R θ\u0307 cos φ = 0",
        "y\u0307 − R θ\u0307 sin φ = 0",
    ]


def test_a_hamiltonian_of_a_momentum_and_what_is_advected():
    sol = gallery.get("heavy-top-so3").simulate(steps=2)
    (line,) = (f"{joined(e.left).text} = {joined(e.right).text}" for e in statement.equations(sol))
    assert line == "H = (Π1²/I1 + Π2²/I2 + Π3²/I3)/2 + mgl Γ3"
