"""The sparse engine beside the dense one: rows, multipliers, derivatives, batches; what is said of large systems that fail."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp

import dirax as dx
from dirax.engines.auto import in_turn
from dirax.engines.contract import Problem
from dirax.engines.sparse.engine import Sparse
from dirax.gallery import hanging_chain
from dirax.schemes.step import Shape, make_step_equation

N = 36


def chain(q, v, k=1.0):
    d = jnp.diff(jnp.concatenate([jnp.zeros(1), q, jnp.zeros(1)]))
    return v @ v / 2 - k * jnp.sum(d**2 / 2 + d**4 / 5)


def links(q):
    d = jnp.diff(jnp.concatenate([jnp.zeros((1, 2)), q.reshape(-1, 2)]), axis=0)
    return (jnp.sum(d * d, axis=1) - (2 / N) ** 2) / 2


def lattice(q, v):
    u = jnp.pad(q.reshape(6, 6), 1)
    return v @ v / 2 - jnp.sum(jnp.diff(u, axis=0) ** 2) / 2 - jnp.sum(1 - jnp.cos(jnp.diff(u, axis=1))) - jnp.sum(q**4)


FPUT = dx.LagrangeDirac(chain)
LATTICE = dx.LagrangeDirac(lattice)
STIFF = dx.LagrangeDirac(lambda q, v, params: chain(q, v, params))
LINKS = dx.LagrangeDirac(lambda q, v: v @ v / N - 9.81 * jnp.sum(q[1::2]) * 2 / N, holonomic=links)
DRIVEN = dx.LagrangeDirac(chain, forces=lambda t, q, v: jnp.sin(t) - v / 10)
SKEW = np.eye(N, k=1) - np.eye(N, k=-1)
PORTS = dx.PortHamiltonian(lambda x: x @ x / 2 + jnp.sum(x**4) / 10, SKEW, None, np.eye(N) / 10)
WAVE = np.sin(np.pi * np.arange(1, N + 1) / (N + 1))
STRAIGHT = np.stack([np.arange(1, N // 2 + 1) * 2 / N, np.zeros(N // 2)], axis=1).ravel()

RUNS = {
    "midpoint": (FPUT, dx.LagrangeDAlembert(), {"q": WAVE, "v": 0 * WAVE}),
    "start from p": (DRIVEN, dx.PlusLagrangeDirac(), {"q": WAVE, "p": WAVE}),
    "two points": (FPUT, dx.LagrangeDAlembert(), {"q0": WAVE, "q1": 0.99 * WAVE}),
    "composition": (FPUT, dx.Composition(dx.LagrangeDAlembert(), "yoshida4"), {"q": WAVE, "v": 0 * WAVE}),
    "collocation": (FPUT, dx.Collocation(stages=2), {"q": WAVE, "v": 0 * WAVE}),
    "lattice": (LATTICE, dx.LagrangeDAlembert(), {"q": WAVE, "v": WAVE[::-1]}),
    "Method 2": (FPUT, dx.DiscreteDirac(constraints="resolve"), {"q": WAVE, "v": 0 * WAVE}),
    "port-Hamiltonian": (PORTS, dx.DiscreteDirac(), {"x": WAVE}),
    "links": (LINKS, dx.LagrangeDAlembert(), {"q": STRAIGHT, "v": 0 * STRAIGHT}),
    "links, Method 1": (LINKS, dx.DiscreteDirac(), {"q": STRAIGHT, "v": 0 * STRAIGHT}),
}


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.soak] if n == "links, Method 1" else []) for n in RUNS])
@pytest.mark.soak_of(but=["two points"])
def test_equals_the_dense_engine(name):
    system, scheme, initial = RUNS[name]
    step = 1e-3 if system is LINKS else 0.05
    ours, theirs = (dx.simulate(system, scheme, **initial, step=step, steps=12, engine=e) for e in ("sparse", "xla"))
    assert ours.ok and theirs.ok and ours.stats["engine"] == "sparse" and theirs.stats["engine"] == "xla"
    for field in theirs.fields:
        size = 1 + np.max(np.abs(theirs.fields[field]))
        np.testing.assert_allclose(ours.fields[field], theirs.fields[field], rtol=0, atol=1e-12 * size, err_msg=field)
    assert ours.stats["solver"] in ("tridiagonal", "band")
    assert ours.stats["by_sites"] or "different expressions" in ours.stats["not_by_sites"]
    assert ours.stats["by_sites"] or system is LINKS


def resolved(scheme, engine):
    q = hanging_chain.straight(4, 1.0)
    return dx.simulate(hanging_chain.SYSTEM, scheme, q=q, v=0 * q, step=1e-3, steps=6, engine=engine)


def test_constraints_that_are_resolved_need_rows_exchanged():
    """Their multipliers are no saddle point: pivots that the pattern alone chooses are zero."""
    ours, near = resolved(dx.DiscreteDirac(constraints="resolve"), "sparse"), resolved(dx.LagrangeDAlembert(), "auto")
    assert ours.ok and ours.stats["solver"] == "exchanged rows"
    assert 1e-12 < np.max(np.abs(ours.q - near.q)) < 1e-6  # of second order both
    assert np.max(np.abs(ours.constraint_residual())) < 1e-13


@pytest.mark.soak
@pytest.mark.parametrize("scheme", [dx.DiscreteDirac(constraints="resolve"), dx.Collocation(nodes="lobatto")])
def test_constraints_that_are_resolved_are_those_of_the_native_engine(scheme):
    ours, theirs = (resolved(scheme, engine) for engine in ("sparse", "native"))
    for field in ("q", "p", "multipliers"):
        np.testing.assert_allclose(ours.fields[field], theirs.fields[field], rtol=0, atol=1e-13, err_msg=field)


def discrete_gradient(x, after):
    """Gonzalez (1996) (9), of the chain below in the Euclidean metric."""
    energy, slope = (lambda x: x @ x / 2 + np.sum(x**4) / 10), (lambda x: x + 0.4 * x**3)
    change, middle = after - x, (x + after) / 2
    return slope(middle) + (energy(after) - energy(x) - slope(middle) @ change) / (change @ change) * change


def test_discrete_gradients_of_many_coordinates_have_a_border():
    size, h = 200, 0.1
    skew = sp.csr_matrix(sp.diags([np.ones(size - 1), -np.ones(size - 1)], [1, -1]))
    ports = dx.PortHamiltonian(lambda x: x @ x / 2 + jnp.sum(x**4) / 10, skew, None, sp.csr_matrix(sp.identity(size) / 10))
    x = 2 * np.sin(np.arange(size))
    sol = dx.simulate(ports, dx.DiscreteGradient(), x=x, step=h, steps=5)
    assert sol.ok and sol.stats["engine"] == "sparse" and sol.stats["border"] == 1 and sol.stats["solver"] == "tridiagonal"
    assert sol.stats["by_sites"]
    for before, after, (stored, _, lost) in zip(sol.x[:-1], sol.x[1:], sol.power, strict=True):
        gradient = discrete_gradient(before, after)
        np.testing.assert_allclose((after - before) / h, skew @ gradient - gradient / 10, rtol=0, atol=1e-12)
        np.testing.assert_allclose([stored, lost], [-gradient @ gradient / 10, gradient @ gradient / 10], rtol=1e-12)


@pytest.mark.soak
def test_derivatives_of_discrete_gradients_are_those_of_the_dense_engine():
    size = 130
    skew = np.eye(size, k=1) - np.eye(size, k=-1)
    ports = dx.PortHamiltonian(lambda x: x @ x / 2 + jnp.sum(x**4) / 10, skew, None, np.eye(size) / 10)

    def end(x, engine):
        return jnp.sum(dx.simulate(ports, dx.DiscreteGradient(), x=x, step=0.1, steps=3, engine=engine).x[-1] ** 3)

    x = 2 * np.sin(np.arange(size))
    ours, theirs = (jax.grad(end)(x, engine) for engine in ("sparse", "xla"))
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-11)


def test_auto_takes_it_where_it_is_quicker(monkeypatch):
    run = {"step": 0.05, "steps": 3}
    wave = np.sin(np.arange(1, 129) / 40)
    sol = dx.simulate(FPUT, dx.LagrangeDAlembert(), q=wave, v=0 * wave, **run)
    assert sol.stats["engine"] == "sparse" and sol.stats["bandwidth"] == [1, 1] and sol.stats["colours"] == 3
    parts = sol.stats["evaluation_seconds"], sol.stats["solution_seconds"]
    assert min(parts) > 0 and abs(sum(parts) - sol.stats["run_seconds"]) < 1e-9
    coupled = dx.LagrangeDirac(lambda q, v: v @ v / 2 - jnp.sum(jnp.cos(q[:, None] - q[None, :])))
    run |= {"q": WAVE, "v": 0 * WAVE}
    monkeypatch.setattr("dirax.engines.policy.MOST_NOT_SPARSE", 1000)
    with monkeypatch.context() as patch, pytest.raises(ValueError, match="a step of 36 unknowns that is not sparse"):
        patch.setattr("dirax.engines.policy.LARGEST_DENSE", 35)
        dx.simulate(coupled, dx.LagrangeDAlembert(), **run)
    sol = dx.simulate(coupled, dx.LagrangeDAlembert(), **run)
    assert sol.stats["engine"] == "xla" and "36 equations" in sol.stats["not_sparse"]


def test_a_batch_keeps_its_bits():
    run = {"step": 0.05, "steps": 5, "engine": "sparse"}
    q = np.stack([WAVE, 0.5 * WAVE, -WAVE])
    k = np.array([1.0, 2.0, 0.5])
    both = dx.simulate(STIFF, dx.LagrangeDAlembert(), q=q, v=0 * q, params=k, batch_params=True, **run)
    alone = dx.simulate(STIFF, dx.LagrangeDAlembert(), q=q[1], v=0 * WAVE, params=k[1], **run)
    assert both.q[1].tobytes() == alone.q.tobytes()


@pytest.mark.parametrize("system", [STIFF, pytest.param(LINKS, marks=pytest.mark.soak)], ids=["chain", "links"])
@pytest.mark.soak
def test_derivatives_are_those_of_the_dense_engine(system):
    start = WAVE if system is STIFF else STRAIGHT

    def end(z, engine):
        params = {"params": z[-1]} if system is STIFF else {}
        sol = dx.simulate(system, dx.LagrangeDAlembert(), q=start, v=z[:-1], **params, step=1e-3, steps=4, engine=engine)
        return jnp.sum(sol.q[-1] ** 2) + jnp.sum(sol.p[-1] ** 3)

    z = np.append(0.0 * start, 1.3)
    ours, theirs = jax.jit(lambda z: [jax.grad(end)(z, engine) for engine in ("sparse", "xla")])(z)
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-11)


@pytest.mark.soak
def test_a_thousand_links_start_and_conserve_their_energy():
    count = 1000

    def lengths(q):
        d = jnp.diff(jnp.concatenate([jnp.zeros((1, 2)), q.reshape(-1, 2)]), axis=0)
        return (jnp.sum(d * d, axis=1) - 1 / count**2) / 2

    system = dx.LagrangeDirac(lambda q, v: (v @ v / 2 - 9.81 * jnp.sum(q[1::2])) / count, holonomic=lengths)
    q = np.stack([np.arange(1.0, count + 1) / count, np.zeros(count)], axis=1).ravel()
    sol = dx.simulate(system, dx.LagrangeDAlembert(), q=q, v=0 * q, step=1e-4, steps=10, save_every=5)
    assert sol.ok and sol.stats["engine"] == "sparse" and sol.stats["unknowns"] == 6 * count
    assert np.max(np.abs(sol.constraint_residual())) < 1e-12
    assert np.ptp(sol.energy()) < 1e-9


@pytest.mark.soak
def test_links_in_other_units():
    """A bent chain of nanometres was refused as singular, and one of small masses was off by 4e-10 after twice the updates."""
    count = 30

    def lengths(q, p):
        d = jnp.diff(jnp.concatenate([jnp.zeros((1, 2)), q.reshape(-1, 2)]), axis=0)
        return (jnp.sum(d * d, axis=1) - p["l"] ** 2) / 2

    system = dx.LagrangeDirac(lambda q, v, p: p["m"] * (v @ v / 2 - p["g"] * jnp.sum(q[1::2])), holonomic=lengths)
    angles, found = 0.05 * np.arange(count), []
    for length, mass, time in ((1.0, 1.0, 1.0), (2.0**-30, 2.0**-86, 2.0**-20), (1.0, 2.0**-87, 2.0**-41)):
        q = np.cumsum(np.stack([np.cos(angles), np.sin(angles)], axis=1), axis=0).ravel() * length
        given = {"l": length, "m": 1.3 * mass, "g": 9.81 * length / time**2}
        run = {"q": q, "v": 0 * q, "step": 2e-3 * time, "steps": 20, "params": given, "engine": "sparse"}
        sol = dx.simulate(system, dx.LagrangeDAlembert(), **run)
        assert sol.ok and sol.stats["solver"] == "band"
        found.append((sol.q / length, sol.p * time / length / mass, sol.stats["newton_iterations"]))
    (q, p, updates), *others = found
    for scaled_q, scaled_p, scaled_updates in others:
        np.testing.assert_allclose(scaled_q, q, rtol=0, atol=1e-13 * np.max(np.abs(q)))
        np.testing.assert_allclose(scaled_p, p, rtol=0, atol=1e-12 * np.max(np.abs(p)))
        assert abs(scaled_updates - updates) <= 0.1 * updates


def test_failures_name_the_equation():
    def well(q, v):  # the root of a negative number at the site 100
        return v @ v / 2 - jnp.sum(jnp.diff(q) ** 2) / 2 + jnp.sqrt(q[100])

    q = np.ones(200)
    v = np.zeros(200)
    v[100] = -50.0
    sol = dx.simulate(dx.LagrangeDirac(well), dx.LagrangeDAlembert(), q=q, v=v, step=0.01, steps=10, engine="sparse")
    assert not sol.ok and "equation 100" in sol.message and "not finite" in sol.message


def test_singular_first_steps_are_named():
    def missing(q, v):  # nothing is said of the coordinate 77
        return jnp.sum(v[:77] ** 2) / 2 + jnp.sum(v[78:] ** 2) / 2 - jnp.sum(q[:77] ** 2) - jnp.sum(q[78:] ** 2)

    def tied(q, v):  # one equation for the coordinates 76 and 77 together
        w = v.at[76].add(v[77]).at[77].set(0.0)
        return w @ w / 2

    run = {"q": np.ones(300), "v": np.zeros(300), "step": 0.1, "steps": 2}
    with pytest.raises(ValueError, match=r"the unknowns .*76, 77"):
        dx.simulate(dx.LagrangeDirac(tied), dx.LagrangeDAlembert(), **run)
    with pytest.raises(ValueError, match=r"whatever the initial data: the equations .* equation 77 have too few unknowns"):
        dx.simulate(dx.LagrangeDirac(missing), dx.LagrangeDAlembert(), **run)


@pytest.mark.parametrize("wrong", ["residual", "Jacobian"])
@pytest.mark.soak_of("residual")
def test_wrong_sites_are_refused(monkeypatch, wrong):
    from dirax.engines.sparse import by_sites, plan
    from dirax.program.sites.jacobian import entries_of_jacobian

    def without_one(sites):
        (result,) = sites.results
        kept = [p for p in result if 150 in p.entries]
        assert len(result) == 3 and len(kept) == 1
        if wrong == "residual":
            e = sites.expressions
            sites.results[0][:] = [
                p._replace(node=e.graph.mul(e.graph.constant(1.01), p.node)) if p in kept else p for p in result
            ]
        entries, rows, columns = entries_of_jacobian(sites)
        zero = sites.expressions.graph.zero
        entries = [p._replace(node=zero) if wrong == "Jacobian" and p.entries[0] == 0 else p for p in entries]
        return entries, rows, columns

    monkeypatch.setattr(by_sites, "entries_of_jacobian", without_one)
    plan._plans.clear()
    q = np.sin(np.arange(200.0))
    with pytest.raises(AssertionError, match=f"{wrong} of the step is wrong"):
        dx.simulate(dx.LagrangeDirac(chain), dx.LagrangeDAlembert(), q=q, v=0 * q, step=0.1, steps=2, engine="sparse")
    plan._plans.clear()


def test_a_wrong_pattern_is_refused(monkeypatch):
    """Of a step that is not taken as sites."""
    from dirax.engines.sparse import plan
    from dirax.program import sparse_equations
    from dirax.program.sparsity import pattern_of

    def without_one(*given):
        pattern = pattern_of(*given).tolil()
        pattern[150, 151] = False
        return pattern.tocsr()

    monkeypatch.setattr(plan, "by_sites", lambda *given: "it is not")
    monkeypatch.setattr(sparse_equations, "pattern_of", without_one)
    plan._plans.clear()
    q = np.sin(np.arange(200.0))
    with pytest.raises(AssertionError, match="equation 150"):
        dx.simulate(dx.LagrangeDirac(chain), dx.LagrangeDAlembert(), q=q, v=0 * q, step=0.1, steps=2, engine="sparse")
    plan._plans.clear()


def test_it_says_why_it_does_not_take_a_step():
    size = 3000
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - jnp.sum(q) ** 2)
    equation = make_step_equation(dx.LagrangeDAlembert(), system, Shape(size))
    state = np.zeros(2 * size)
    problem = Problem(equation, state, (state[:size],), 0.1, 0.0, 2)
    assert "depend on too many unknowns" in (Sparse().supports(problem) or "")
    notes: dict[str, str] = {}
    assert [engine.name for engine in in_turn(problem, notes)] == ["xla"] and "depend on too many" in notes["not_sparse"]


@pytest.mark.soak
def test_indices_that_depend_on_values_are_left_to_dense_steps():
    """Each site is drawn to one that its own place chooses: which, no pattern says."""

    def drawn(q, v):
        near = jnp.clip(jnp.round(q).astype(int), 0, 99)
        return v @ v / 2 - jnp.sum((q - q[near]) ** 2) / 2

    q = np.arange(100) + 0.1 * np.sin(np.arange(100))
    sol = dx.simulate(dx.LagrangeDirac(drawn), dx.LagrangeDAlembert(), q=q, v=0 * q, step=0.01, steps=2)
    assert sol.ok and sol.stats["engine"] == "xla" and "indices that depend on values" in sol.stats["not_sparse"]


def test_machines_of_many_bodies_are_run_by_the_levels_of_their_program(monkeypatch):
    """Against the nodes one by one in NumPy: residual and Jacobian of a row of windows, whatever their number as many levels.
    The step of a short row is taken as sites, which is forbidden here."""
    from dirax.engines.sparse import plan as plans
    from dirax.engines.sparse.plan import sparse_plan
    from dirax.engines.step_program import step_program
    from dirax.gallery import n_four_bar

    system, windows = n_four_bar.model(2).system, 2
    n, c = 2 * windows + 1, 2 * windows
    equation = make_step_equation(dx.LagrangeDAlembert(), system, Shape(n, c=c))
    monkeypatch.setattr(plans, "by_sites", lambda *given: "it is not")
    plan = sparse_plan(equation, {}, False)
    program, (stage, _) = step_program(equation, {}, False), plan.equation.stages[0]
    u, state = np.random.default_rng(4).normal(size=(2, max(equation.unknowns, equation.state_size)))
    given = u[: equation.unknowns], state[: equation.state_size], 0.3, 0.01
    residual, slopes = program.linearized({}, False, *(np.asarray(x)[None] for x in given))
    assert plan.not_by_sites and stage.residual is not equation.residual
    np.testing.assert_allclose(stage.residual(*given, {}), residual[0], rtol=1e-11, atol=1e-11)
    solver = plan.solvers[0]
    matrix = solver.equations.matrix(np.asarray(solver.jacobian_of(stage.residual)(*given, {})))
    np.testing.assert_allclose(matrix.toarray(), slopes[0], rtol=1e-11, atol=1e-11)


@pytest.mark.soak
def test_levels_of_a_program_with_choices():
    from dirax.program.evaluation.in_levels import in_levels
    from dirax.program.graph import Graph

    g = Graph()
    a, b, c = map(g.input, "abc")
    less = g.make("and", g.make("lt", a, b), g.make("lt", b, g.constant(2.0)))
    outputs = [g.select(less, g.make("sin", c), g.mul(a, c)), g.add(g.make("cos", b), g.constant(1.0)), c, g.one]
    f = in_levels(g, [a, b, c], outputs)
    for values in ([0.3, 0.7, 0.9], [0.9, 0.7, 0.4], [0.3, 2.5, 0.1]):
        expected = g.evaluate(outputs, dict(zip("abc", values, strict=True)))
        np.testing.assert_allclose(f(np.array(values)), np.array(expected, float), rtol=1e-15)
    slope = jax.jacfwd(f)(np.array([0.3, 0.7, 0.9]))
    np.testing.assert_allclose(slope[0], [0.0, 0.0, np.cos(0.9)], atol=1e-15)


def test_canonical_dirac_systems_make_no_matrices():
    """ẋ ⊕ dH ∈ D of 3000 sites, whose two-form has 36 million entries."""
    n = 3000
    H = lambda x: jnp.sum(x[n:] ** 2) / 2 + jnp.sum(1 - jnp.cos(jnp.diff(x[:n])))
    q = np.sin(np.arange(n) / 200)
    run = {"step": 0.05, "steps": 3}
    sol = dx.simulate(dx.DiracSystem(dx.induced_dirac(None, n), H), dx.DiscreteDirac(), x=np.r_[q, 0 * q], **run)
    assert sol.stats["by_sites"] and sol.stats["bandwidth"][0] < 10
    chain = dx.HamiltonDirac(lambda q, p: H(jnp.concatenate([q, p])))
    np.testing.assert_allclose(sol.x[:, :n], dx.simulate(chain, dx.DiscreteDirac(), q=q, p=0 * q, **run).x[:, :n], atol=1e-13)
    with pytest.raises(ValueError, match="dimension 6000, but x has 6 entries"):
        dx.simulate(dx.DiracSystem(dx.induced_dirac(None, n), lambda x: x @ x), dx.DiscreteDirac(), x=np.zeros(6), **run)
