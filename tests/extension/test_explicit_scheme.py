"""A scheme with nothing to solve, with a sum of its own in the state: derivatives, first uses under JAX, resumed steps, walls."""

import dataclasses
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx


class Euler(dx.AbstractScheme):
    """Symplectic Euler, with the sum of h|p|² as a field "work_done" of its nodes, and a zero that JAX makes."""

    resumes: bool = True

    def step_equation(self, system, shape):
        n, state, rest = shape.n, dx.Layout(q=shape.n, p=shape.n, s=1), jnp.zeros(shape.n)

        def advance(u, x, t, h, params):
            q, p, s = state.split(x)
            p = p + h * jax.grad(system.lagrangian)(q, rest, params)
            return state.join(q=q + h * p, p=p, s=s + h * (p @ p))

        def unpack(x, u, t, h, params):
            q, p, s = state.split(x)
            return {"q": q, "p": p, "work_done": s}

        def begin(data, sum_before):
            return state.join(q=data["q"], p=data["p"], s=sum_before), jnp.zeros(0)

        equation = dx.StepEquation(
            start=lambda data, h, params: begin(data, jnp.zeros(1)),
            residual=lambda u, x, t, h, params: jnp.zeros(0),
            advance=advance,
            unpack=unpack,
            state_layout=state,
            unknowns=0,
            fields={"q": dx.Field((n,)), "p": dx.Field((n,)), "work_done": dx.Field((1,))},
        )
        resume = lambda data, h, params: begin(data, data["work_done"])
        return dataclasses.replace(equation, resume=resume) if self.resumes else equation


SYSTEM = dx.LagrangeDirac(lambda q, v, params: v @ v / 2 - params * (q @ q) ** 2 / 4)
GIVEN = {"q": [1.0, 0.3], "v": [0.2, 0.5], "step": 0.02}


def end(k, steps=60, **more):
    return dx.simulate(SYSTEM, Euler(), **GIVEN, params=k, steps=steps, **more).q[-1, 0]


def test_the_first_use_may_be_a_traced_one():
    """What a scheme makes of JAX's arrays is kept with its equation, and is no value of that trace."""
    dx.clear_caches()
    slope = jax.jit(jax.grad(end))(1.3)
    np.testing.assert_allclose(slope, (end(1.3 + 1e-6) - end(1.3 - 1e-6)) / 2e-6, rtol=1e-8)
    np.testing.assert_allclose(end(1.3, engine="xla"), end(1.3), rtol=1e-13)


@pytest.mark.parametrize("twice", [jax.hessian, lambda f: jax.jacrev(jax.jacrev(f)), lambda f: jax.jacfwd(jax.jacfwd(f))])
def test_second_derivatives(twice):
    slope = jax.jit(jax.grad(end))
    np.testing.assert_allclose(twice(end)(1.3), (slope(1.3 + 1e-5) - slope(1.3 - 1e-5)) / 2e-5, rtol=1e-8)


def test_steps_from_rows_go_on_with_the_sum():
    """Between rows, at events, behind walls: what is saved there lies between its neighbours."""
    sol = dx.simulate(SYSTEM, Euler(), **GIVEN, params=1.3, steps=200)
    inside = sol.at(1.21).work_done[0]
    assert sol.work_done[60, 0] < inside < sol.work_done[61, 0]
    event = dx.Event(lambda q: q[1])
    found = dx.simulate(SYSTEM, Euler(), **GIVEN, params=1.3, steps=200, events=[event]).events
    rows = np.searchsorted(sol.t, found.t) - 1
    assert len(rows) and np.all((found.work_done >= sol.work_done[rows]) & (found.work_done <= sol.work_done[rows + 1]))
    hit = dx.simulate(SYSTEM, Euler(), **GIVEN, params=1.3, steps=200, events=[dx.Impact(lambda q: q[0] + 0.2)])
    assert len(hit.events) and np.all(np.diff(hit.work_done[:, 0]) > 0)
    assert abs(hit.work_done[-1, 0] - np.trapezoid(np.sum(hit.p**2, axis=1), hit.t)) < 0.02
    assert dx.verify(hit)["run once more"].verdict == "ok"


def test_one_that_does_not_say_how_it_goes_on_is_refused():
    with pytest.raises(ValueError, match="resume"):
        dx.simulate(SYSTEM, Euler(False), **GIVEN, params=1.3, steps=200).at(1.21)
    for event in (dx.Event(lambda q: q[1]), dx.Impact(lambda q: q[0] + 0.2)):
        with pytest.raises(ValueError, match="resume"):
            dx.simulate(SYSTEM, Euler(False), **GIVEN, params=1.3, steps=200, events=[event])


def test_python_that_leaves_out_assertions():
    """Nothing may be done by a line that is not there with `python -O`."""
    code = "import dirax as dx; s = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2); " + (
        "print(dx.simulate(s, dx.LagrangeDAlembert(), q=[[1.0], [0.5]], v=[[0.0], [0.1]], step=0.1, steps=9000).ok.all())"
    )
    done = subprocess.run([sys.executable, "-OO", "-c", code], capture_output=True, text=True, timeout=120)
    assert done.stdout.split() == ["True"], done.stderr


def test_a_place_that_there_is_not():
    with pytest.raises(ValueError, match="'node' or 'step', but 'nodes'"):
        dx.Field((2,), place="nodes")


class InParts(dx.AbstractScheme):
    """What a scheme of one's own may return by mistake."""

    fractions: tuple[float, ...] = ()

    def step_equation(self, system, shape):
        whole = Euler().step_equation(system, shape)
        return dx.StepSequence(tuple((whole, fraction) for fraction in self.fractions)) if self.fractions else None


def test_what_is_no_whole_step_is_refused():
    """A run of steps of .9 h had the times of steps of h, and every line of verify was ok."""
    run = lambda scheme: dx.simulate(SYSTEM, scheme, **GIVEN, params=1.3, steps=3)
    with pytest.raises(ValueError, match=r"must sum up to 1, a whole step, but their sum is 0\.9"):
        run(InParts((0.5, 0.4)))
    with pytest.raises(TypeError, match="but it returned NoneType"):
        run(InParts())
    assert run(InParts((0.3, 0.3, 0.4))).ok


def test_a_state_of_q_and_p_that_is_not_called_canonical():
    class Plain(dx.AbstractScheme):
        def step_equation(self, system, shape):
            equation = dx.make_step_equation(dx.DiscreteDirac(), system, shape)
            return dataclasses.replace(equation, canonical=False)

    free = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2)
    report = dx.verify(dx.simulate(free, Plain(), q=[0.3], v=[0.1], step=0.1, steps=20))
    assert "canonical=True" in report["symplecticity of one step"].explanation


class WithSpeed(dx.AbstractScheme):
    """A scheme of dirax that saves another quantity of nodes."""

    scheme: dx.AbstractScheme

    def step_equation(self, system, shape):
        inner = dx.make_step_equation(self.scheme, system, shape)
        unpack = lambda x, u, t, h, params: (row := inner.unpack(x, u, t, h, params)) | {"square": row["p"] @ row["p"]}
        return dataclasses.replace(inner, unpack=unpack, fields=inner.fields | {"square": dx.Field((), "node", ())})


@pytest.mark.parametrize("scheme", [dx.LagrangeDAlembert(), dx.Collocation(2)], ids=lambda s: type(s).__name__)
def test_what_a_polynomial_says_nothing_of_is_made_by_a_part_of_the_step(scheme):
    """It was that of the row before, all along the step."""
    given = {"q": [1.0, 0.3], "v": [0.2, 0.5], "params": 1.3, "step": 0.02, "steps": 60}
    sol = dx.simulate(SYSTEM, WithSpeed(scheme), **given, events=[dx.Event(lambda q: q[0] - 0.8)])
    for t in (0.70001, 0.71, 0.7199, 0.72):
        moment = sol.at(t)
        np.testing.assert_allclose(moment.square, moment.p @ moment.p, rtol=1e-3)
    np.testing.assert_allclose(sol.events.square, np.sum(sol.events.p**2, axis=1), rtol=1e-3)


class Positions(dx.AbstractScheme):
    """Symplectic Euler in (q, v), which saves q, and v where it `says` it."""

    says: tuple[str, ...] = ("q", "v")

    def step_equation(self, system, shape):
        n, state = shape.n, dx.Layout(q=shape.n, v=shape.n)

        def advance(u, x, t, h, params):
            q, v = state.split(x)
            v = v - h * q
            return state.join(q=q + h * v, v=v)

        return dx.StepEquation(
            start=lambda data, h, params: (state.join(q=data["q"], v=data["v"]), jnp.zeros(0)),
            residual=lambda u, x, t, h, params: jnp.zeros(0),
            advance=advance,
            unpack=lambda x, u, t, h, params: {name: getattr(state.split(x), name) for name in self.says},
            state_layout=state,
            unknowns=0,
            fields={name: dx.Field((n,)) for name in self.says},
        )


@pytest.mark.parametrize("says", [("q", "v"), ("q",)], ids="-".join)
def test_rows_without_momenta_are_saved_and_compared(says, tmp_path):
    free, given = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2), {"q": [1.0, 0.0], "v": [0.0, 1.0], "step": 0.05}
    sol = dx.simulate(free, Positions(says), **given, steps=40)
    sol.save(tmp_path / "run.nc")
    assert np.array_equal(dx.load(tmp_path / "run.nc").q, sol.q)
    assert ("energy" in sol.to_dataframe().columns) == ("energy" in sol.to_xarray()) == ("v" in says)
    compared = dx.compare(free, {"own": Positions(says), "midpoint": dx.LagrangeDAlembert()}, **given, steps=200)
    own = compared["own"]
    assert round(own.order) == 1 and (own.energy_band is None) == ("v" not in says)
    if "v" in says:
        np.testing.assert_allclose(sol.energy(), (np.sum(sol.q**2, axis=1) + np.sum(sol.v**2, axis=1)) / 2, rtol=1e-13)
        np.testing.assert_allclose(sol.at(0.51).q, sol.q[10] + 0.2 * (sol.q[11] - sol.q[10]), rtol=1e-3)
    else:
        for read in (sol.energy, lambda: sol.at(0.51)):
            with pytest.raises(ValueError, match="needs p, but the rows hold q alone"):
                read()


def test_an_energy_that_forces_change_is_not_called_bounded():
    """By a scheme that does not see the forces, it was."""
    damped = dx.LagrangeDirac(lambda q, v, params: v @ v / 2 - params * q @ q, forces=lambda t, q, v, params: -0.1 * v)
    line = dx.verify(dx.simulate(damped, Euler(), **GIVEN, params=1.3, steps=200))["energy"]
    assert line.verdict == "not checked" and "has forces, whose work this scheme does not save" in line.explanation
