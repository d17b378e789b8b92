"""verify on systems of which no matrix of all coordinates can be formed: right runs pass, changed numbers are found."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx
from dirax import gallery
from dirax.diagnostics import rows
from dirax.diagnostics.action import stationary_action
from dirax.diagnostics.replay_lines import replayed
from dirax.diagnostics.replay_of_many import replayed_of_many
from dirax.diagnostics.report import VIOLATED
from dirax.diagnostics.structure_lines import membership, structure_of
from dirax.diagnostics.symplecticity_of_many import symplecticity_of_many
from dirax.gallery import hanging_chain

SITES = 510  # a row has more numbers than rows.LARGE
Q = np.sin(np.pi * np.arange(1, SITES + 1) / (SITES + 1))


def chain(q, v):
    d = jnp.diff(jnp.concatenate([jnp.zeros(1), q, jnp.zeros(1)]))
    return v @ v / 2 - jnp.sum(d**2 / 2 + d**4 / 5)


@pytest.fixture(scope="module")
def sol():
    return dx.simulate(dx.LagrangeDirac(chain), dx.LagrangeDAlembert(), q=Q, v=0 * Q, step=0.05, steps=12)


SYMPLECTIC = "symplecticity of one step"
JUDGED = "steps replayed", "discrete Dirac structure", "saved p", "action sum stationary"


def verdicts(sol):
    return {line.quantity: line for line in dx.verify(sol).lines}


def test_a_right_run_passes(sol, monkeypatch):
    monkeypatch.setattr(rows, "SAMPLED_NUMBERS", 5 * 2 * SITES)
    lines = verdicts(sol)
    assert {lines[name].verdict for name in JUDGED} == {"ok"}
    assert lines["energy"].verdict == "bounded" and "6 of 12 rows" in lines["steps replayed"].explanation
    assert "5 of 11 steps" in lines["saved p"].explanation
    assert lines[SYMPLECTIC].verdict == "ok" and "2 pairs of random directions at 2 of 12 rows" in lines[SYMPLECTIC].explanation


@pytest.mark.soak
def test_nothing_of_a_machine_is_compiled(monkeypatch):
    """The derivative of a step of the bicycle has 441 numbers: XLA took half a minute for what the scalar program does in two
    seconds."""
    monkeypatch.setattr(rows, "_compiled", lambda function, *rest: pytest.fail(f"{function.func} is compiled"))
    assert dx.verify(gallery.get("bicycle").simulate(steps=20)).ok


@pytest.mark.soak
def test_changed_numbers_are_found(sol):
    q, p = sol.q.copy(), sol.p.copy()
    q[6, 293] *= 1.0 + 1e-11
    p[-1, 293] += 1e-12
    changed = sol.replace(fields={"q": q, "p": p})
    structure = structure_of(changed)
    lines = [replayed(changed, None), *membership(changed, structure, None), stationary_action(changed, structure, None)]
    assert {line.quantity: line.verdict for line in lines} == dict.fromkeys(JUDGED, VIOLATED)


@pytest.mark.soak
def test_a_step_that_changes_the_form_is_found(sol):
    equation = sol.equation
    stretched = dataclasses.replace(equation, advance=lambda *given: (1.0 + 1e-9) * equation.advance(*given))
    assert symplecticity_of_many(sol.replace(equation=stretched), SYMPLECTIC, None).verdict == VIOLATED


@pytest.mark.parametrize("save_every", [1, 3])
@pytest.mark.soak_of("1")
def test_multipliers_are_those_of_momenta_that_rows_do_not_hold(save_every):
    """Rows hold mean momenta, and multipliers belong to incoming ones: they are compared one row later."""
    knife = dx.LagrangeDirac(
        lambda q, v: v @ v / 2 - q @ q / 3, one_forms=lambda q: jnp.array([[jnp.sin(q[2]), -jnp.cos(q[2]), 0.1]])
    )
    q, v = np.array([0.2, 0.1, 0.4]), np.array([np.cos(0.4), np.sin(0.4), 0.0])
    sol = dx.simulate(knife, dx.LagrangeDAlembert(), q=q, v=v, step=0.05, steps=15, save_every=save_every)
    line = lambda sol: replayed_of_many(sol, "steps replayed", None)
    assert line(sol).verdict == "ok"
    for name in ("q", "p", "multipliers"):
        changed = np.array(sol.fields[name])
        changed[3 // save_every] *= 1.0 + 1e-9
        assert line(sol.replace(fields=sol.fields | {name: changed})).verdict == VIOLATED, name


def test_rows_with_a_projected_momentum_do_not_hold_what_the_multipliers_belong_to():
    pendulum = dx.LagrangeDirac(lambda q, v: v @ v / 2 - 9.81 * q[1], holonomic=lambda q: jnp.array([(q @ q - 1) / 2]))
    sol = dx.simulate(pendulum, dx.LagrangeDAlembert(), q=[np.sin(0.5), -np.cos(0.5)], v=[0.0, 0.0], step=0.01, steps=50)
    assert replayed_of_many(sol, "steps replayed", None).verdict == "ok"


@pytest.mark.soak
def test_a_chain_of_links_passes():
    q = hanging_chain.straight(400)
    sol = dx.simulate(hanging_chain.SYSTEM, dx.LagrangeDAlembert(), q=q, v=0 * q, step=1e-3, steps=6)
    lines = verdicts(sol)
    assert all(line.verdict != VIOLATED for line in lines.values()) and lines["steps replayed"].verdict == "ok"
