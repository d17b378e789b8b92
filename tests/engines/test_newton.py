"""Newton's method to the roundoff floor: known roots, hard equations, linear solves, derivatives of the root."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import scipy.optimize
from hypothesis import given
from hypothesis import strategies as st

import dirax as dx
from dirax.engines.stopping import EPSILON
from dirax.engines.xla import Xla
from dirax.engines.xla.dense import Dense
from dirax.engines.xla.newton import as_function, newton_root


def root(equation, guess, args=(), **keywords):
    guess = jnp.asarray(guess)
    u, updates, converged = newton_root(equation, guess, args, 50, **keywords)
    return np.asarray(u), int(updates), bool(converged)


@pytest.mark.soak
def test_roots_against_mpmath():
    """x = cos x and y eʸ = x² from far and near: the same digits, to roundoff."""
    x = mpmath.findroot(lambda x: x - mpmath.cos(x), 0.7)
    y = mpmath.lambertw(x**2)
    equation = lambda u: jnp.stack([u[0] - jnp.cos(u[0]), u[1] * jnp.exp(u[1]) - u[0] ** 2])
    for guess in ([0.1, 0.1], [2.0, 3.0], [0.739, 0.38]):
        u, _, converged = root(equation, guess)
        assert converged
        np.testing.assert_allclose(u, [float(x), float(y)], rtol=4 * EPSILON)


def test_a_good_guess_costs_two_updates():
    """One with the Jacobian there and one that confirms it, as long as the first contracts from 1e-9 to roundoff."""
    u, updates, converged = root(lambda u: u**2 - 2.0, [2**0.5 + 1e-9])
    assert converged and updates == 2 and u[0] == pytest.approx(2**0.5, rel=EPSILON)


def test_linear_equations_are_solved_by_the_first_update():
    matrix = np.array([[2.0, 1.0, 0.0], [1.0, 3.0, 1.0], [0.0, 1.0, 4.0]])
    u, updates, converged = root(lambda u: matrix @ u - jnp.ones(3), np.zeros(3))
    assert converged and updates <= 2
    np.testing.assert_allclose(u, np.linalg.solve(matrix, np.ones(3)), rtol=1e-15)


@pytest.mark.parametrize(
    "equation, guess",
    [
        (lambda u: u**2 + 1.0, [0.7]),  # no root
        (lambda u: jnp.log(u), [-1.0]),  # outside the domain
        (lambda u: 0.0 * u + 1.0, [1.0]),  # singular Jacobian
    ],
)
def test_equations_without_a_root_are_said_not_to_converge(equation, guess):
    _, updates, converged = root(equation, guess)
    assert not converged and updates <= 50


@pytest.mark.parametrize("engine", ["native", "xla"])
@pytest.mark.soak_of("xla")
def test_an_iteration_that_comes_from_far_away_is_not_done_yet(engine):
    """A wall of exponentials that is cut off, met at full speed: the first update leads to 1e20, the next back to about zero,
    and the third is small beside it. Whoever takes that for contraction is wrong by 2 %."""
    force = lambda v: -1e3 * (np.exp(np.clip(v / 0.02, -100.0, 45.0)) - 1.0)
    traced = lambda t, q, v: -1e3 * (jnp.exp(jnp.clip(v / 0.02, -100.0, 45.0)) - 1.0)
    system, h, q, p = dx.LagrangeDirac(lambda q, v: v @ v / 2, forces=traced), 0.05, 0.0, 1.0
    sol = dx.simulate(system, dx.LagrangeDAlembert(), q=[0.0], v=[1.0], step=h, steps=4, engine=engine)
    assert sol.ok
    for found in sol.q[1:, 0]:
        velocity = scipy.optimize.brentq(lambda v, p=p: v - p - h / 2 * force(v), -1.0, 2.0, xtol=1e-18, rtol=1e-15)
        q, p = q + h * velocity, velocity + h / 2 * force(velocity)
        assert found == pytest.approx(q, rel=1e-10, abs=1e-15)


@pytest.mark.parametrize("engine", ["native", "xla"])
@pytest.mark.soak_of("xla")
def test_a_linearization_that_leads_nowhere_says_nothing_about_sizes(engine):
    """From rest, by a force that is constant at the guess and 1e22 times weaker where that leads: Newton goes to and fro."""
    force = lambda t, q, v: -1e3 * (jnp.exp(jnp.clip((v + 1.0) / 0.02, -100.0, 50.0)) - 1.0)
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2, forces=force)
    assert not dx.simulate(system, dx.LagrangeDAlembert(), q=[0.0], v=[0.0], step=0.05, steps=3, engine=engine).ok


def test_an_equation_full_of_roundoff_stops_at_its_floor():
    """x + 10⁶(1 + x − 1 − x) is x with noise of about 1e-10: found as well as it can be, in few updates."""
    noise = lambda u: 1e6 * (((1.0 + u * (1 + 1e-9)) - 1.0) - u * (1 + 1e-9))
    u, updates, converged = root(lambda u: u - 0.3 + noise(u), [0.1])
    assert converged and updates < 20 and abs(u[0] - 0.3) < 1e-9


def test_where_it_does_not_run_the_guess_comes_back():
    u, updates, _ = root(lambda u: u - 1.0, [5.0], running=jnp.array(False))
    assert u[0] == 5.0 and updates == 0


@pytest.mark.soak
def test_lanes_of_a_batch_do_not_depend_on_each_other():
    """Each lane has the bits and the number of updates that it has among others that need more."""
    one = lambda guess: newton_root(lambda u: u - jnp.cos(u) * u, guess, (), 50)[:2]
    guesses = jnp.array([[0.5], [2.0], [7.0], [0.3]])
    together, counts = jax.jit(jax.vmap(one))(guesses)
    for order in ([3, 1, 0, 2], [0, 0, 0, 0]):
        others, others_counts = jax.jit(jax.vmap(one))(guesses[jnp.array(order)])
        np.testing.assert_array_equal(others, together[jnp.array(order)])
        np.testing.assert_array_equal(others_counts, counts[jnp.array(order)])
    assert len(set(np.asarray(counts).tolist())) > 1


def test_derivatives_of_the_root_to_second_order():
    """u³ = a: u' = 1/(3u²), u'' = −2/(9u⁵), forwards and backwards."""
    equation = lambda u, a: u**3 - a
    found = lambda a: newton_root(equation, jnp.array([1.3]), (jax.lax.stop_gradient(a),), 50)[0]
    cube_root = lambda a: as_function(equation, found(a), (a,))[0]
    u = 2.0 ** (1 / 3)
    derivatives = lambda a: (jax.grad(cube_root)(a), jax.jvp(cube_root, (a,), (1.0,))[1], jax.grad(jax.grad(cube_root))(a))
    backward, forward, second = jax.jit(derivatives)(2.0)
    assert [backward, forward] == pytest.approx([1 / (3 * u**2)] * 2, rel=1e-14)
    assert second == pytest.approx(-2 / (9 * u**5), rel=1e-13)


@jax.custom_vjp
def cubed(u):
    return u**3


cubed.defvjp(lambda u: (cubed(u), u), lambda u, flow: (3 * u**2 * flow,))


def test_a_derivative_of_the_users_own_in_reverse_mode_alone():
    equation = lambda u, a: cubed(u) - cubed(a)
    found = lambda a: newton_root(equation, jnp.array([1.3]), (jax.lax.stop_gradient(a),), 50)[0]
    root, slope = jax.jit(jax.value_and_grad(lambda a: as_function(equation, found(a), (a,))[0]))(2.0)
    assert [root, slope] == pytest.approx([2.0, 1.0], rel=1e-14)


SOLVED = jax.jit(lambda a, b: Dense().solve(Dense().factorise(a), b))


@given(st.sampled_from([1, 2, 3, 5, 9]), st.integers(0, 2**32 - 1))
@pytest.mark.soak
def test_linear_solves_with_zero_pivots(k, seed):
    """Backward error at roundoff for all three ways, for saddle-point matrices, whose corner is zero."""
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(k, k)), rng.normal(size=k)
    a[k // 2 + 1 :, k // 2 + 1 :] = 0.0
    a[0, 0] *= k == 1
    condition = np.linalg.cond(a)
    x = np.asarray(SOLVED(a, b))
    exact = np.linalg.solve(a, b)
    assert np.max(np.abs(x - exact)) <= 100 * EPSILON * condition * max(np.max(np.abs(exact)), EPSILON)


class QR(dx.AbstractLinearSolver):
    """By orthogonal factors."""

    def factorise(self, matrix):
        return jnp.linalg.qr(matrix)

    def solve(self, factors, right):
        q, r = factors
        return jax.scipy.linalg.solve_triangular(r, q.T @ right)


class Richardson(dx.AbstractLinearSolver):
    """Iterations x ← x + D⁻¹(b − A x), for matrices with a large diagonal; a loop, which JAX does not transpose."""

    most: int = 200

    def factorise(self, matrix):
        return matrix

    def solve(self, factors, right):
        diagonal = jnp.diagonal(factors)
        going = lambda carry: (carry[1] < self.most) & (jnp.max(jnp.abs(factors @ carry[0] - right)) > 0)
        more = lambda carry: (carry[0] + (right - factors @ carry[0]) / diagonal, carry[1] + 1)
        return jax.lax.while_loop(going, more, (right / diagonal, 0))[0]

    def solve_transposed(self, factors, right):
        return self.solve(factors.T, right)


@pytest.mark.parametrize("solver", [QR(), pytest.param(Richardson(), marks=pytest.mark.soak)])
@pytest.mark.soak
def test_a_linear_solver_is_one_class(solver):
    """Values and derivatives of a run of five coupled pendulums, against the native engine."""
    system = dx.LagrangeDirac(lambda q, v, k: v @ v / 2 + jnp.sum(jnp.cos(q)) - k * jnp.sum(jnp.diff(q) ** 2) / 2)
    run = {"q": np.linspace(0.1, 1.0, 5), "step": 0.1, "steps": 8}

    def end(engine, v, k):
        sol = dx.simulate(system, dx.LagrangeDAlembert(), v=v, params=k, engine=engine, **run)
        return jnp.sum(jnp.sin(sol.q[-1] + sol.p[-1])), sol.q

    def simulated(engine, v):
        return dx.simulate(system, dx.LagrangeDAlembert(), v=v, params=0.3, engine=engine, **run).q

    v, ours, theirs = np.linspace(0.0, 1.0, 5), Xla(linear_solver=solver), "native"
    q = simulated(ours, v)
    np.testing.assert_allclose(q, simulated(theirs, v), rtol=1e-12, atol=1e-13)

    @jax.jit
    def derivatives(v, k):
        slopes = [jax.grad(lambda v, k, e=e: end(e, v, k), (0, 1), has_aux=True)(v, k) for e in (ours, theirs)]
        return slopes, jax.jvp(lambda k: end(ours, v, k)[0], (k,), (1.0,))[1]

    ((mine, traced), (others, _)), forward = derivatives(v, 0.3)
    np.testing.assert_allclose(traced, q, rtol=1e-12, atol=1e-13)
    for one, other in zip(mine, others, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(forward, others[1], rtol=1e-11)
