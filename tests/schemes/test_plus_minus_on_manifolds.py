"""(±) and Lagrange–d'Alembert equations on manifolds, in charts, beside equations in R^N that know no chart."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

import dirax as dx
from dirax.diagnostics.structure_lines import membership, structure_of

H = 0.1
SPHERE, SO3 = dx.Sphere(3), dx.SO3()
SPACE = dx.Product(SPHERE, dx.Circle())
ROW = lambda q: jnp.array([-q[1], q[0], 0.3, 1.0])  # a one-form on the sphere alone would vanish somewhere
POTENTIAL = lambda q: 3 * q[2]
L = lambda q, v: v @ v / 2 - POTENTIAL(q)
FREE, TIED = dx.ManifoldLagrangian(L, SPHERE), dx.ManifoldLagrangian(L, SPACE, lambda q: ROW(q)[None])
Q0, V0 = np.array([0.6, 0.0, 0.8]), np.array([0.8, 0.3, -0.6])
TIED_Q0 = np.append(Q0, 0.0)
TIED_V0 = np.append(V0, -np.asarray(ROW(TIED_Q0))[:3] @ V0)
FROM = {"free": {"q": Q0, "v": V0}, "tied": {"q": TIED_Q0, "v": TIED_V0}}
SCHEMES = {"right": dx.PlusLagrangeDirac, "left": dx.MinusLagrangeDirac}


def chord(q0, q1, h):
    """L_d of the chord, and the weight at both ends."""
    return (q1 - q0) @ (q1 - q0) / (2 * h) - h * (POTENTIAL(q0) + POTENTIAL(q1)) / 2


def of_middle(q0, q1, h):
    """w_d in the middle of the chord."""
    return (ROW((q0 + q1) / 2) @ (q1 - q0))[None] / h


@pytest.mark.parametrize(
    ("name", "engine"), [("free", "native"), ("tied", "native"), pytest.param("tied", "xla", marks=pytest.mark.soak)]
)
@pytest.mark.soak_of("tied-native")
def test_a_users_discrete_lagrangian_beside_the_form_constrained_in_flat_space(name, engine):
    """D2 L_d + D1 L_d + λ q + μ W = 0 with |q| = 1 in R^N are the same equations."""
    tied = name == "tied"
    scheme = dx.LagrangeDAlembert(chord, of_middle if tied else "midpoint", "incoming")
    flat = dx.LagrangeDirac(L, TIED.one_forms.function if tied else None, holonomic=lambda q: jnp.array([q[:3] @ q[:3] - 1]) / 2)
    run = {"q": FROM[name]["q"], "p": FROM[name]["v"], "step": H, "steps": 25}
    sol, known = dx.simulate(TIED if tied else FREE, scheme, **run, engine=engine), dx.simulate(flat, scheme, **run)
    assert sol.ok and known.ok and len(np.unique(sol.chart[:, 0])) > 1
    np.testing.assert_allclose(sol.q, known.q, atol=1e-12)
    normal = known.q * np.array([1.0, 1.0, 1.0, 0.0])[: known.q.shape[1]]
    np.testing.assert_allclose(sol.p, known.p - normal * np.sum(normal * known.p, axis=1, keepdims=True), atol=1e-11)


@pytest.mark.parametrize("constraint", ["right", "left"])
@pytest.mark.soak_of("right")
def test_the_plus_and_minus_equations_without_charts(constraint):
    """W at one end on the velocity that the retraction gives there, and h L of that velocity at the first point."""
    sol = dx.simulate(TIED, SCHEMES[constraint](), **FROM["tied"], step=H, steps=20)
    assert sol.ok and len(np.unique(sol.chart[:, 0])) > 1
    normal = lambda q: np.append(q[:3], 0.0)
    project = lambda q, v: v - normal(q) * (normal(q) @ v)
    weight = np.array([0, 0, 3.0, 0])

    def away(q0, q1):
        """R⁻¹_{q0}(q1) = (q1/⟨q0, q1⟩ − q0, Δθ)."""
        return np.append(q1[:3] / (q0[:3] @ q1[:3]) - q0[:3], q1[3] - q0[3])

    def slots(q0, q1):
        """(D1, D2) of h L at q0, whose kinetic part is (1/⟨q0, q1⟩² − 1 + Δθ²)/2h."""
        slope, turn = -((q0[:3] @ q1[:3]) ** -3) / H, np.append(np.zeros(3), (q1[3] - q0[3]) / H)
        return project(q0, slope * normal(q1) - turn - H * weight), project(q1, slope * normal(q0) + turn)

    def missed(z, q0, q1):
        q2, c, mu = z[:4], z[4], z[5]
        balance = slots(q0, q1)[1] + slots(q1, q2)[0] - mu * project(q1, np.asarray(ROW(q1))) + c * normal(q1)
        at, other = (q2, q1) if constraint == "right" else (q1, q2)
        return np.concatenate([balance, [q2[:3] @ q2[:3] - 1, np.asarray(ROW(at)) @ away(at, other)]])

    for k in (0, 9, 17):
        q0, q1 = sol.q[k], sol.q[k + 1]
        guess = np.concatenate([2 * q1 - q0, [0.0, 0.0]])
        expected = fsolve(missed, guess, args=(q0, q1), xtol=1e-13)
        np.testing.assert_allclose(sol.q[k + 2], expected[:4], atol=1e-11)
        assert sol.multipliers[k + 1, 0] == pytest.approx(expected[5], abs=1e-10)
        np.testing.assert_allclose(sol.p[k + 1], slots(q0, q1)[1], atol=1e-12)  # the incoming p


@pytest.mark.parametrize(
    ("name", "scheme", "engine"),
    [
        ("free", SCHEMES["right"], "native"),
        ("tied", SCHEMES["right"], "native"),
        ("free", SCHEMES["left"], "xla"),
        ("tied", SCHEMES["left"], "native"),
    ],
)
@pytest.mark.soak
def test_what_verify_measures(name, scheme, engine):
    sol = dx.simulate(FREE if name == "free" else TIED, scheme(), **FROM[name], step=H, steps=20, engine=engine)
    report = dx.verify(sol)
    structure = report["(+)-discrete Dirac structure" if scheme is dx.PlusLagrangeDirac else "(−)-discrete Dirac structure"]
    assert structure.verdict == "ok" and structure.value < 1e-15, structure
    form = report["symplecticity of one step" if name == "free" else "structural relation φ*Ω = Ω + dβ"]
    assert form.verdict == "ok" and form.value < 1e-14, form
    moved = dx.action_variation(sol, np.sin(3 * sol.q))
    assert abs(moved.value) < 1e-13 * moved.size


def test_action_sums_and_energies_by_hand():
    """L_d and its slots in ambient coordinates, and R⁻¹ in the place of Δq."""
    sol = dx.simulate(FREE, dx.PlusLagrangeDirac(), **FROM["free"], step=H, steps=20)
    cosine = np.sum(sol.q[1:] * sol.q[:-1], axis=1)
    lagrangians = (cosine**-2 - 1) / (2 * H) - 3 * H * sol.q[:-1, 2]
    assert dx.action_sum(sol) == pytest.approx(lagrangians.sum(), abs=1e-12)
    back = -(sol.q[:-1] / cosine[:, None] - sol.q[1:])
    np.testing.assert_allclose(dx.discrete_energy(sol), np.sum(sol.p[1:] * back, axis=1) - lagrangians, atol=1e-12)


def test_damage_is_seen():
    """A point that is off by 1e-9."""
    sol = dx.simulate(TIED, dx.PlusLagrangeDirac(), **FROM["tied"], step=H, steps=20)
    moved = sol.q[7] + 1e-9 * np.append(np.cross(sol.q[7, :3], [1.0, 2.0, 3.0]), 1.0)
    sol.fields["q"] = np.concatenate([sol.q[:7], [SPACE.nearest(jnp.asarray(moved))], sol.q[8:]])
    structure = structure_of(sol)
    verdicts = {line.quantity: line.verdict for line in membership(sol, structure, None)}
    assert verdicts["(+)-discrete Dirac structure"] == "VIOLATED"
    assert abs(dx.action_variation(sol, np.sin(3 * sol.q)).value) > 1e-11


def exact(t, q, v, friction=0.0):
    """The spherical pendulum, q̈ = −∇V − friction q̇ + c q."""
    force = np.array([0.0, 0.0, -3.0])
    right = lambda t, z: np.concatenate([z[3:], force - friction * z[3:] - z[:3] * (z[:3] @ force + z[3:] @ z[3:])])
    return solve_ivp(right, (0, t), np.concatenate([q, v]), rtol=1e-12, atol=1e-13, method="DOP853").y[:3, -1]


@pytest.mark.parametrize(
    ("scheme", "order"),
    [(dx.PlusLagrangeDirac(), 1), (dx.MinusLagrangeDirac("right"), 1), (dx.LagrangeDAlembert(), 2)],
    ids=["(+) left", "(−) right", "midpoint"],
)
@pytest.mark.soak_of("midpoint")
def test_orders_and_the_momentum_map(scheme, order):
    errors = []
    for steps in (400, 800, 1600):
        sol = dx.simulate(FREE, scheme, q=Q0, v=V0, step=1.0 / steps, steps=steps)
        errors.append(np.linalg.norm(sol.q[-1] - exact(1.0, Q0, V0)))
        vertical = np.cross(sol.q, sol.p)[:, 2]
        assert np.ptp(vertical) < 5e-15 * steps  # roundoff of a step, ε/h
    assert -np.diff(np.log2(errors)) == pytest.approx([order] * 2, abs=0.1)


INERTIA = np.array([1.0, 2.0, 3.0])
BODY = dx.ManifoldLagrangian(lambda g, v: SO3.to_algebra(g, v) @ (INERTIA * SO3.to_algebra(g, v)) / 2, SO3)
SUSLOV = dx.ManifoldLagrangian(
    lambda g, v: SO3.to_algebra(g, v) @ (INERTIA * SO3.to_algebra(g, v)) / 2,
    SO3,
    lambda g: (SO3.left_translate(g, jnp.array([0.3, -0.2, 1.0])) / jnp.sum(SO3.left_translate(g, jnp.eye(3)[0]) ** 2))[None],
)


@pytest.mark.parametrize(
    ("system", "scheme"),
    [
        (BODY, dx.PlusLagrangeDirac()),
        pytest.param(SUSLOV, dx.PlusLagrangeDirac(), marks=pytest.mark.soak),
        (SUSLOV, dx.MinusLagrangeDirac("right")),
    ],
    ids=["free body (+)", "Suslov (+)", "Suslov (−)"],
)
@pytest.mark.soak
def test_on_a_group_left_invariant_systems_are_reduced_to_its_algebra(system, scheme):
    """L(g, gξ) = l(ξ) makes l_d(ζ) = h l(ζ/h) with ζ = log(g0⁻¹ g1) of every rule, and A ζ = 0 of every constraint."""
    xi = np.array([0.5, 1.0, -0.3])
    if system is SUSLOV:
        row = np.array([0.3, -0.2, 1.0])
        xi = xi - (INERTIA**-1 * row) * (row @ xi) / (row @ (row / INERTIA))
    g = SO3.group_exp(jnp.array([0.2, -0.4, 0.1]))
    run = {"q": g, "v": SO3.left_translate(g, jnp.asarray(xi)), "step": 0.05, "steps": 100}
    whole = dx.simulate(system, scheme, **run)
    reduced = dx.reconstruct(dx.simulate(dx.reduce(system, SO3), dx.DiscreteEulerPoincare(), **run))
    assert whole.ok and len(np.unique(whole.chart, axis=0)) > 1
    np.testing.assert_allclose(whole.q, reduced.q, atol=1e-11)
    if system is BODY:  # the momentum map of left translations
        turned = lambda q, p: SO3.matrix(q) @ SO3.body_momentum(q, p)
        spatial = np.array([turned(q, p) for q, p in zip(jnp.asarray(whole.q[::10]), jnp.asarray(whole.p[::10]), strict=True)])
        assert np.ptp(spatial, axis=0).max() < 3e-13  # roundoff of a step is ε/h of them


@pytest.mark.soak
def test_the_midpoint_equations_are_those_of_the_geodesic_map_in_another_atlas():
    run = FROM["tied"] | {"step": H, "steps": 20}
    known = dx.simulate(TIED, dx.LagrangeDAlembert(), **run)
    atlas = dx.Atlas(SPACE, exponential=True, leave_at=0.15)
    sol = dx.simulate(TIED, dx.InCharts(dx.RiemannianExp(SPACE), atlas), **run)
    np.testing.assert_allclose(sol.q, known.q, atol=1e-12)
    np.testing.assert_allclose(sol.p, known.p, atol=1e-11)
    assert len(np.unique(sol.chart, axis=0)) != len(np.unique(known.chart, axis=0))  # other charts
    verdicts = {line.quantity: line.verdict for line in membership(sol, structure_of(sol), None)}
    assert verdicts["discrete Dirac structure"] == "ok"


@pytest.mark.parametrize(
    ("system", "scheme"),
    [("tied", dx.PlusLagrangeDirac()), ("free", dx.LagrangeDAlembert()), ("free", dx.DiscreteDirac(dx.SphereProjection()))],
)
@pytest.mark.soak_of("tied-scheme0")
def test_starts_from_two_points(system, scheme):
    """Those of a run that starts from q and v give its other rows."""
    stated = TIED if system == "tied" else FREE
    known = dx.simulate(stated, scheme, **FROM[system], step=H, steps=15)
    sol = dx.simulate(stated, scheme, q0=known.q[0], q1=known.q[1], step=H, steps=15)
    np.testing.assert_allclose(sol.q, known.q, atol=1e-13)
    np.testing.assert_allclose(sol.p[1:], known.p[1:], atol=1e-13)


@pytest.mark.parametrize("scheme", [dx.PlusLagrangeDirac, pytest.param(dx.MinusLagrangeDirac, marks=pytest.mark.soak)])
def test_reduction_by_the_rotation_about_the_vertical(scheme):
    """L_d and w_d are functions on Q × Q: in the angles (φ, ϑ, θ), where the rotation is a translation, the same equations."""
    point = lambda y: jnp.stack([jnp.sin(y[0]) * jnp.cos(y[1]), jnp.sin(y[0]) * jnp.sin(y[1]), jnp.cos(y[0]), y[2]])
    one_sided = {dx.PlusLagrangeDirac: lambda q0, q1: ROW(q1), dx.MinusLagrangeDirac: lambda q0, q1: ROW(q0)}[scheme]
    wd = lambda q0, q1, h: (one_sided(q0, q1) @ (q1 - q0))[None] / h
    inward = lambda f: lambda y0, y1, h: f(point(y0), point(y1), h)
    of_manifold, of_angles = (dx.LagrangeDAlembert(a, b, "incoming") for a, b in ((chord, wd), (inward(chord), inward(wd))))
    angles = dx.in_coordinates(TIED, point)
    y = jnp.array([np.arccos(0.8), 0.0, 0.0])
    rate = np.linalg.lstsq(np.asarray(jax.jacfwd(point)(y)), TIED_V0, rcond=None)[0]
    run = {"step": H, "steps": 12}  # the motion passes the pole later, where angles end
    whole = dx.simulate(TIED, of_manifold, **FROM["tied"], **run)
    reduced = dx.simulate(dx.reduce(angles, dx.LinearConnection(fibre=[1, 2])), of_angles, q=y, v=rate, **run)
    assert whole.ok and reduced.ok
    back = dx.reconstruct(reduced)
    np.testing.assert_allclose(jax.vmap(point)(jnp.asarray(back.q)), whole.q, atol=1e-11)


def test_on_a_flat_manifold_a_connection_reduces_at_once():
    space = dx.Product(dx.Euclidean(1), dx.Torus(2))
    free = lambda q, v: v @ v / 2 + 0.3 * jnp.cos(q[1]) * v[2] - q[0] ** 2 / 2 - jnp.sin(q[1])
    whole, fibre = dx.ManifoldLagrangian(free, space), dx.LinearConnection(fibre=[2])
    run = {"q": [0.3, 0.2, 0.1], "v": [0.1, 0.4, 0.5], "step": H, "steps": 30}
    sol, reduced = (
        dx.simulate(whole, dx.PlusLagrangeDirac(), **run),
        dx.simulate(dx.reduce(whole, fibre), dx.PlusLagrangeDirac(), **run),
    )
    np.testing.assert_allclose(dx.reconstruct(reduced).q, sol.q, atol=1e-12)
    assert np.ptp(reduced.mu) == 0.0


@pytest.mark.soak
def test_forces_and_their_work():
    """A damped pendulum: the energy lost is the work of the forces, to the second order of the midpoint rule."""
    damped = dx.ManifoldLagrangian(L, SPHERE, forces=lambda t, q, v: -0.5 * v)
    ends, lost = [], []
    for steps in (20, 40, 80):
        run = {"q": Q0, "v": V0, "step": 2.0 / steps, "steps": steps}
        sol = dx.simulate(damped, dx.LagrangeDAlembert(), **run)
        energy = sol.energy()
        assert energy[-1] < energy[0] - 0.5
        ends.append(sol.q[-1])
        lost.append(energy[-1] - energy[0] - sol.work[-1])
    errors = [np.linalg.norm(q - exact(2.0, Q0, V0, friction=0.5)) for q in ends]
    assert -np.diff(np.log2(errors)) == pytest.approx([2, 2], abs=0.15)
    assert abs(lost[2]) < 0.3 * abs(lost[1]) < 0.1 * abs(lost[0])
    assert dx.verify(sol)["discrete Dirac structure"].verdict == "ok"


def test_a_composition_has_its_order_in_q_and_p():
    scheme = dx.Composition(dx.LagrangeDAlembert(momentum="incoming"), "suzuki4")
    rows = [dx.simulate(TIED, scheme, **FROM["tied"], step=1.0 / n, steps=n) for n in (8, 16, 32, 64)]
    for name in ("q", "p"):
        ends = [getattr(sol, name)[-1] for sol in rows]
        changes = [np.linalg.norm(b - a) for a, b in itertools.pairwise(ends)]
        assert np.log2(changes[-2] / changes[-1]) == pytest.approx(4, abs=0.3), name


def test_what_is_refused():
    run = {"q": Q0, "v": V0, "step": H, "steps": 2}
    cylinder = dx.Submanifold(lambda x: jnp.concatenate([x[:2] / jnp.linalg.norm(x[:2]), x[2:]]), 3)
    with pytest.raises(TypeError, match="need one with a retraction"):
        dx.simulate(dx.ManifoldLagrangian(L, cylinder), dx.PlusLagrangeDirac(), q=[1.0, 0, 0], v=[0.0, 1, 1], step=H, steps=2)
    with pytest.raises(ValueError, match="q is not on"):
        dx.simulate(FREE, dx.PlusLagrangeDirac(), **run | {"q": 2 * Q0})
    with pytest.raises(TypeError, match="discrete_lagrangian"):
        dx.PlusLagrangeDirac(lambda q: q @ q)
    with pytest.raises(ValueError, match="shape"):
        dx.simulate(FREE, dx.PlusLagrangeDirac(lambda q0, q1, h: q1 - q0), **run)
    with pytest.raises(ValueError, match="no one_forms, whose forces would impose it"):
        dx.simulate(FREE, dx.LagrangeDAlembert(chord, of_middle), **run)
    for pair, message in (
        ({"q0": Q0, "q1": 2 * Q0}, "q1 is not on Sphere"),
        ({"q0": 2 * Q0, "q1": Q0}, "q0 is not on Sphere"),
        ({"q0": Q0, "q1": -Q0}, "q1 must be near q0, in the domain of the inverse retraction of Sphere"),
        ({"x": Q0}, "starts from q=, v= · q=, p= · q0=, q1=, but x= was given"),
    ):
        with pytest.raises(ValueError, match=message):
            dx.simulate(FREE, dx.PlusLagrangeDirac(), **pair, step=H, steps=2)
    with pytest.raises(TypeError, match="action sums are of schemes with a discrete Lagrangian"):
        dx.action_sum(dx.simulate(FREE, dx.DiscreteDirac(dx.SphereProjection()), **run))


def test_a_point_off_the_manifold_is_refused_however_often_a_run_is_repeated():
    run = {"v": V0, "step": H, "steps": 2}
    for _ in range(3):
        assert dx.simulate(FREE, dx.PlusLagrangeDirac(), q=Q0, **run).ok
    with pytest.raises(ValueError, match="q is not on"):
        dx.simulate(FREE, dx.PlusLagrangeDirac(), q=2 * Q0, **run)
