"""A scheme is one class outside the package: engines, batches, gradients, compositions and verdicts take it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dirax as dx


class SymplecticEuler(dx.AbstractScheme):
    """p_k = −D1 L_d, p_{k+1} = D2 L_d of L_d = h L at the left or at the right point, for Lagrangians without constraints."""

    side: str = "left"

    def step_equation(self, system, shape):
        n, (first, last) = shape.n, (1.0, 0.0) if self.side == "left" else (0.0, 1.0)  # where the impulse ∂L/∂q acts
        state, unknowns = dx.Layout(q=n, p=n), dx.Layout(v=n)

        def slopes(u, x, h, params):
            q = state.split(x).q + last * h * u
            return jax.grad(system.lagrangian, argnums=(0, 1))(q, u, params)

        def residual(u, x, t, h, params):
            dq, dv = slopes(u, x, h, params)
            return dv - first * h * dq - state.split(x).p

        def advance(u, x, t, h, params):
            dq, dv = slopes(u, x, h, params)
            return state.join(q=state.split(x).q + h * u, p=dv + last * h * dq)

        def check(data, h, params):
            if np.linalg.norm(h * data["v"]) > 1.0:
                raise ValueError("SymplecticEuler begins with a step of length 1 at most.")

        return dx.StepEquation(
            start=lambda data, h, params: (state.join(q=data["q"], p=data["p"]), unknowns.join(v=data["v"])),
            residual=residual,
            advance=advance,
            unpack=lambda x, u, t, h, params: state.split(x)._asdict(),
            state_layout=state,
            unknown_layout=unknowns,
            fields={"q": dx.Field((n,)), "p": dx.Field((n,))},
            labels=tuple(f"momentum {i} of symplectic Euler" for i in range(n)),
            canonical=True,
            check=check,
        )

    def adjoint(self, system):
        return SymplecticEuler("right" if self.side == "left" else "left")


class WithoutAdjoint(dx.AbstractScheme):
    """The same scheme, which does not say what its adjoint is."""

    scheme: dx.AbstractScheme = SymplecticEuler()

    def step_equation(self, system, shape):
        return self.scheme.step_equation(system, shape)


SYSTEM = dx.LagrangeDirac(lambda q, v, params: (1 + params * q[1] ** 2) * v @ v / 2 - q @ q / 2 - q[0] ** 2 * q[1])
START = {"q": [0.3, -0.2], "v": [0.1, 0.4], "params": 0.3}


def run(scheme=SymplecticEuler(), **changes):
    return dx.simulate(SYSTEM, scheme, **{**START, "step": 0.05, "steps": 100, **changes})


def test_both_engines_agree():
    native, xla = run(engine="native"), run(engine="xla")
    assert native.ok and xla.ok and native.stats["engine"] == "native" and xla.stats["engine"] == "xla"
    np.testing.assert_allclose(native.q, xla.q, rtol=0, atol=1e-13)
    np.testing.assert_allclose(native.p, xla.p, rtol=0, atol=1e-13)


def test_a_lane_of_a_batch_is_the_run_alone():
    q = np.array([[0.3, -0.2], [0.1, 0.2], [-0.4, 0.0]])
    batch = run(q=q, v=np.tile([0.1, 0.4], (3, 1)))
    assert batch.ok.all()
    np.testing.assert_array_equal(batch.q[1], run(q=q[1]).q)


@pytest.mark.parametrize("engine", ["native", pytest.param("xla", marks=pytest.mark.soak)])
def test_gradients(engine):
    end = lambda params: run(params=params, engine=engine).q[-1, 0]
    difference = (end(0.3 + 1e-6) - end(0.3 - 1e-6)) / 2e-6
    assert float(jax.jit(jax.grad(end))(0.3)) == pytest.approx(float(difference), abs=1e-8)


def test_verdict_and_order():
    report = dx.verify(run())
    assert report.ok and report["symplecticity of one step"].value < 1e-13
    order = dx.convergence(SYSTEM, SymplecticEuler(), **START, step_sizes=[0.02, 0.01, 0.005, 0.0025], time=1.0)
    assert order.order == pytest.approx(1.0, abs=0.05)


def test_compositions_use_its_own_adjoint():
    symmetric = dx.SymmetricComposition(SymplecticEuler())
    assert [stage.unknowns for stage, _ in run(symmetric).equation.stages] == [2, 2]
    order = dx.convergence(SYSTEM, symmetric, **START, step_sizes=[0.1, 0.05, 0.025, 0.0125], time=1.0)
    assert order.order == pytest.approx(2.0, abs=0.05)
    fourth = dx.Composition(symmetric, "suzuki4")
    order = dx.convergence(SYSTEM, fourth, **START, step_sizes=[0.2, 0.1, 0.05, 0.025], time=1.0)
    assert order.order == pytest.approx(4.0, abs=0.15)


def test_without_an_adjoint_of_its_own_the_step_back_is_inverted():
    own, inverted = run(dx.SymmetricComposition(SymplecticEuler())), run(dx.SymmetricComposition(WithoutAdjoint()))
    assert [stage.unknowns for stage, _ in inverted.equation.stages] == [6, 2]
    np.testing.assert_allclose(own.q, inverted.q, rtol=0, atol=1e-12)
    np.testing.assert_allclose(own.p, inverted.p, rtol=0, atol=1e-12)


def test_its_premise_and_its_labels_are_in_messages():
    with pytest.raises(ValueError, match="SymplecticEuler begins with a step of length 1 at most"):
        run(v=[30.0, 0.0])
    valley = dx.LagrangeDirac(lambda q, v: v @ v / 2 + jnp.sqrt(1.0 - q @ q))  # no derivative outside the unit circle
    sol = dx.simulate(valley, SymplecticEuler("left"), q=[0.9, 0.0], v=[3.0, 0.0], step=0.1, steps=10)
    assert not sol.ok and "momentum 0 of symplectic Euler is not finite" in sol.message


def test_equal_schemes_share_their_equation():
    assert run().equation is run(SymplecticEuler("left")).equation
    assert jnp.all(run().q == run(SymplecticEuler("left")).q)


class OfPositions(SymplecticEuler):
    """The same scheme, which saves q alone."""

    def step_equation(self, system, shape):
        whole = super().step_equation(system, shape)
        alone = lambda x, u, t, h, params: {"q": whole.state_layout.split(x).q}
        return dataclasses.replace(whole, fields={"q": whole.fields["q"]}, unpack=alone)


def test_what_was_not_saved_is_named():
    sol = run(OfPositions())
    np.testing.assert_array_equal(sol.q, run().q)
    with pytest.raises(ValueError, match="needs p, but the rows hold q alone"):
        sol.energy()
    report = dx.verify(sol)
    for line in ("energy", "symplecticity of one step", "steps replayed"):
        assert report[line].verdict == "not checked" and "needs p, but the rows hold q alone" in report[line].explanation
    order = dx.convergence(SYSTEM, OfPositions(), **START, step_sizes=[0.02, 0.01, 0.005], time=1.0)
    assert order.order == pytest.approx(1.0, abs=0.05)


class Rattle(dx.AbstractScheme):
    """Ryckaert, Ciccotti and Berendsen's method with Andersen's velocities, of unit masses: symplectic on {g = 0, ġ = 0}."""

    def step_equation(self, system, shape):
        n, c = shape.n, shape.c
        state, unknowns = dx.Layout(q=n, p=n), dx.Layout(v=n, first=c, last=c)
        force = lambda q: jax.grad(lambda q: system.lagrangian(q, jnp.zeros(n), None))(q)
        slope = jax.jacfwd(lambda q: system.holonomic(q, None))

        def end(u, x, h):
            u, q = unknowns.split(u), state.split(x).q + h * unknowns.split(u).v
            return q, u.v + h / 2 * force(q) - h / 2 * slope(q).T @ u.last

        def residual(u, x, t, h, params):
            (q1, p1), (q, p), u = end(u, x, h), state.split(x), unknowns.split(u)
            begun = u.v - p - h / 2 * force(q) + h / 2 * slope(q).T @ u.first
            return jnp.concatenate([begun, system.holonomic(q1, None) / h, slope(q1) @ p1])

        return dx.StepEquation(
            start=lambda data, h, params: (
                jnp.concatenate([data["q"], data["p"]]),
                jnp.concatenate([data["p"], jnp.zeros(2 * c)]),
            ),
            residual=residual,
            advance=lambda u, x, t, h, params: jnp.concatenate(end(u, x, h)),
            unpack=lambda x, u, t, h, params: state.split(x)._asdict(),
            state_layout=state,
            unknown_layout=unknowns,
            fields={"q": dx.Field((n,)), "p": dx.Field((n,))},
            canonical=True,
        )


def test_a_scheme_that_is_symplectic_under_constraints_is_not_called_otherwise():
    """On all of T*Q its step is not, and verify said VIOLATED; its rows hold no multipliers, by which the manifold is known."""
    pendulum = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[1] - q[0] ** 4, holonomic=lambda q: jnp.array([q @ q - 1.0]))
    run = {"q": [0.6, -0.8], "v": [0.4, 0.3], "step": 0.05, "steps": 40}
    sol, other = (dx.simulate(pendulum, scheme, **run) for scheme in (Rattle(), dx.LagrangeDAlembert("trapezoidal")))
    np.testing.assert_allclose(sol.q, other.q, atol=1e-13)
    report = dx.verify(sol)
    assert report.ok and report["symplecticity of one step"].verdict == "not checked"
