"""System types written outside the package against dx.AbstractSystem alone run, resolve and are verified."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dirax as dx


class Jointed(dx.AbstractSystem):
    """q̇ = v, v̇ = b(t) × v − ∇V(q) + aλ with a·v = 0 in R³, as a relation of x = (q, v) with one multiplier."""

    potential: object = eqx.field(static=True)
    joint: tuple[float, ...] = eqx.field(static=True)

    def force(self, t, q, v):
        return jnp.cross(jnp.stack([0.0 * t, jnp.sin(t), 1.0]), v) - jax.grad(self.potential)(q)

    def sizes(self, data, params):
        if "x" not in data or data["x"].shape != (6,):
            raise ValueError("a Jointed system starts from x= (q, v) of shape (6,).")
        return 6, 1

    def relation_form(self, shape):
        a = jnp.asarray(self.joint)

        def residual(x, rate, multipliers, t, params):
            balance = rate[3:] - self.force(t, x[:3], x[3:]) - a * multipliers[0]
            return jnp.concatenate([rate[:3] - x[3:], balance, (a @ x[3:])[None]])

        return dx.RelationForm(residual, 1, ("joint",), 1)

    def final_manifold(self, shape):
        """M_f = {a·v = 0}, where λ = −a·force/|a|², for a force that does not take the time."""
        a = jnp.asarray(self.joint)
        multiplier = lambda x, params: -(a @ self.force(jnp.zeros(()), x[:3], x[3:]))[None] / (a @ a)

        def field(x, params):
            return jnp.concatenate([x[3:], self.force(jnp.zeros(()), x[:3], x[3:]) + a * multiplier(x, params)[0]])

        constraint = lambda x, params: (a @ x[3:])[None]
        return dx.FinalManifold(constraint, 1, field, multiplier, 1, lambda x, covector, params: covector)

    def complete(self, data, params, project):
        x = data["x"]
        return {"x": x, "velocity": jnp.concatenate([x[3:], self.force(data["t"], x[:3], x[3:])])}

    def initial_defect(self, data, params):
        return (jnp.asarray(self.joint) @ data["x"][3:])[None]

    def energy_at(self, row, params):
        return row["x"][3:] @ row["x"][3:] / 2 + self.potential(row["x"][:3])

    def constraint_at(self, row, params):
        return self.initial_defect(row, params)


class Still(Jointed):
    """The same in a field that does not turn."""

    def force(self, t, q, v):
        return jnp.cross(jnp.array([0.0, 0.3, 1.0]), v) - jax.grad(self.potential)(q)


JOINT = (0.5, 1.0, -0.3)
START = np.array([0.3, -0.2, 0.5, *np.cross(JOINT, [1.0, 0.2, 0.4])])


def valley(q):
    return q @ q / 2 + q[0] * q[1] ** 2 / 3


def exact(turning, time):
    """The end by DOP853: λ eliminated by a·v̇ = 0 in NumPy."""
    a = np.array(JOINT)

    def field(t, x):
        q, v = x[:3], x[3:]
        slope = q + np.array([q[1] ** 2 / 3, 2 * q[0] * q[1] / 3, 0.0])
        force = np.cross([0.0, np.sin(t), 1.0] if turning else [0.0, 0.3, 1.0], v) - slope
        return np.concatenate([v, force - a * (a @ force) / (a @ a)])

    return solve_ivp(field, (0, time), START, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]


@pytest.mark.parametrize("system, method", [(Jointed, "discretize"), (Still, "discretize"), (Still, "resolve")])
def test_both_methods_are_of_second_order(system, method):
    known, errors = exact(system is Jointed, 1.0), []
    for steps in (20, 40, 80):
        scheme = dx.DiscreteDirac(constraints=method)
        sol = dx.simulate(system(valley, JOINT), scheme, x=START, step=1 / steps, steps=steps)
        assert sol.ok and sol.multipliers.shape == (steps, 1)
        errors.append(np.abs(sol.x[-1] - known).max())
        assert np.abs(sol.constraint_residual()).max() < (1e-14 if method == "resolve" else 1.0)
    assert np.log2(np.array(errors)[:-1] / np.array(errors)[1:]) == pytest.approx(2.0, abs=0.1)


def test_the_constraint_algorithm_finds_its_final_manifold_from_the_relation():
    """M_0 = M_f = {a·v = 0}, with the field and λ that the class states by hand; the time is a coordinate where it is used."""
    still = Still(valley, JOINT)
    chain = dx.constraint_algorithm(still, near=START)
    assert chain.verdict == "determined" and chain.dimension == 5
    by_hand = still.final_manifold(dx.Shape(6, 1))
    assert np.asarray(chain.field(START)) == pytest.approx(np.asarray(by_hand.field(START, None)), abs=1e-12)
    assert np.asarray(chain.multipliers(START)) == pytest.approx(np.asarray(by_hand.multipliers(START, None)), abs=1e-12)
    turning = dx.constraint_algorithm(Jointed(valley, JOINT), near={"x": START, "t": 0.2})
    assert turning.clock and turning.dimension == 6
    sol = dx.simulate(turning.resolved(), dx.DiscreteDirac(), x=np.append(START, 0.0), step=0.01, steps=100)
    assert sol.x[-1, :6] == pytest.approx(exact(True, 1.0), abs=2e-4)


def test_verify_engines_and_bad_data():
    still = Still(valley, JOINT)
    runs = [dx.simulate(still, dx.DiscreteDirac(), x=START, step=0.05, steps=20, engine=e) for e in ("native", "xla")]
    assert np.abs(runs[0].x - runs[1].x).max() < 1e-13
    resolved = dx.simulate(still, dx.DiscreteDirac(constraints="resolve"), x=START, step=0.05, steps=200)
    report = dx.verify(resolved)
    assert report.ok and "constraint" in str(report) and "energy" in str(report)
    with pytest.raises(ValueError, match="off the constraint"):
        dx.simulate(still, dx.DiscreteDirac(), x=START + 0.1, step=0.05, steps=2)
    with pytest.raises(TypeError, match="inputs= drives an open"):
        dx.simulate(still, dx.DiscreteDirac(), x=START, step=0.05, steps=2, inputs=lambda t, x: x)
    with pytest.raises(TypeError, match=r"dx\.DiscreteGradient takes"):
        dx.simulate(still, dx.DiscreteGradient(), x=START, step=0.05, steps=2)


class Springs(dx.AbstractSystem):
    """Unit masses on a line joined by springs of given stiffness: a Lagrangian system by its Lagrangian form alone."""

    stiffness: tuple[float, ...] = eqx.field(static=True)

    def lagrangian_form(self):
        stretch = lambda q: jnp.diff(q, prepend=0.0)
        return dx.LagrangeDirac(lambda q, v: v @ v / 2 - jnp.array(self.stiffness) @ stretch(q) ** 2 / 2)

    def sizes(self, data, params):
        return self.lagrangian_form().sizes(data, params)

    def complete(self, data, params, project):
        return self.lagrangian_form().complete(data, params, project)

    def initial_defect(self, data, params):
        return jnp.zeros(0)

    def energy_at(self, row, params):
        return self.lagrangian_form().energy_at(row, params)

    def constraint_at(self, row, params):
        return jnp.zeros(0)


@pytest.mark.parametrize("method", ["discretize", "resolve"])
def test_a_lagrangian_form_is_enough(method):
    run = {"q": [0.3, -0.1, 0.2], "v": [0.0, 0.5, 0.0], "step": 0.1, "steps": 50}
    springs = Springs((1.0, 2.0, 0.5))
    own = dx.simulate(springs, dx.DiscreteDirac(constraints=method), **run)
    known = dx.simulate(springs.lagrangian_form(), dx.DiscreteDirac(), **run)
    assert np.array_equal(own.q, known.q) and np.array_equal(own.p, known.p)
    assert dx.verify(own).ok


@pytest.mark.parametrize(
    ("method", "wrong", "said"),
    [
        ("sizes", lambda self, data, params: 1, "sizes of .* must return .n, m. or .n, m, c., .* not 1"),
        (
            "complete",
            lambda self, data, params, project: {"x": data["x"]},
            "must return a dict with x, velocity, but it returned x",
        ),
        ("complete", lambda self, data, params, project: data["y"], r"complete of .* could not be traced by JAX: KeyError: 'y'"),
        ("relation_form", lambda self, shape: dx.RelationForm(lambda x, v, u, t, params: v[:1]), r"6 numbers .* of shape \(1,\)"),
        (
            "relation_form",
            lambda self, shape: dx.RelationForm(lambda x, v, u, t, params: [v, x]),
            r"6 numbers .* it returned a list",
        ),
        ("energy_at", lambda self, row, params: row["x"], r"energy_at of Wrong must return one number, .* of shape \(6,\)"),
    ],
)
def test_methods_that_return_something_else_are_named(method, wrong, said):
    kind = type("Wrong", (Still,), {method: wrong, "__module__": __name__})
    with pytest.raises((TypeError, ValueError), match=said):
        dx.simulate(kind(valley, JOINT), dx.DiscreteDirac(), x=START, step=0.1, steps=1)
