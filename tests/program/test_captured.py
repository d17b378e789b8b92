"""What user functions read from outside of their arguments: a system has the values of when it was stated, or says so."""

import collections
import functools
import pickle
import sys
import types

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import xarray as xr

import dirax as dx
from dirax.program.captured import Captured

MIDPOINT = dx.LagrangeDAlembert()
stiffness = 1.0


def end(system, **more):
    """q after a unit of time from q = 1 at rest: cos √k, up to the error of the scheme."""
    return dx.simulate(system, MIDPOINT, q=[1.0], v=[0.0], step=0.001, steps=1000, **more).q[-1, 0]


def by_global(q, v):
    return v @ v / 2 - stiffness * q @ q / 2


class Spring:
    k = 1.0

    def lagrangian(self, q, v):
        return v @ v / 2 - self.potential(q)

    def potential(self, q):
        return self.k * q @ q / 2


class Called(Spring):
    def __call__(self, q, v):
        return self.lagrangian(q, v)


def _cell():
    k = 1.0

    def lagrangian(q, v):
        return v @ v / 2 - k * q @ q / 2

    def change():
        nonlocal k
        k = 4.0

    return lagrangian, change


def _array():
    k = np.array([1.0])
    return (lambda q, v: v @ v / 2 - k @ (q * q) / 2), lambda: k.__setitem__(0, 4.0)


def _attribute(kind=Spring):
    spring = kind()
    return (spring if kind is Called else spring.lagrangian), lambda: setattr(spring, "k", 4.0)


def _dictionary():
    own = {"k": 1.0}
    return (lambda q, v: v @ v / 2 - own["k"] * q @ q / 2), lambda: own.update(k=4.0)


def _inside_another():
    own = {"k": 1.0}
    potential = lambda q: own["k"] * q @ q / 2
    return functools.partial(lambda a, q, v: a * v @ v / 2 - potential(q), 1.0), lambda: own.update(k=4.0)


def _class_attribute():
    class Constants:
        k = 1.0

    class Of(Constants):
        pass

    return (lambda q, v: v @ v / 2 - Of.k * q @ q / 2), lambda: setattr(Constants, "k", 4.0)


class Slots:
    __slots__ = ("k",)

    def __init__(self):
        self.k = 1.0


class Table(Slots):
    @property
    def stiffness(self):
        return self.k

    def __getitem__(self, name):
        return self.k


def _object(made, read=lambda o: o.k, change=lambda o: setattr(o, "k", 4.0)):
    def way():
        it = made()
        return (lambda q, v: v @ v / 2 - read(it) * q @ q / 2), lambda: change(it)

    return way


def _written():
    k, out = {"k": 1.0}, []

    def lagrangian(q, v):
        terms = {}
        terms["V"] = k["k"] * q @ q / 2  # what it changes is its own
        out.append(1)  # and this its record
        return v @ v / 2 - terms["V"]

    return lagrangian, lambda: k.update(k=4.0)


def _cached():
    k = {"k": 1.0}
    helper = functools.cache(lambda name: k[name])

    def change():
        k.update(k=4.0)
        helper.cache_clear()

    return (lambda q, v: v @ v / 2 - helper("k") * q @ q / 2), change


WAYS = {
    "space": _object(lambda: types.SimpleNamespace(k=1.0)),
    "slots": _object(Slots),
    "property": _object(Table, lambda o: o.stiffness),
    "item": _object(Table, lambda o: o["k"]),
    "longer": _object(lambda: [1.0], sum, lambda o: o.append(3.0)),
    "more keys": _object(lambda: {"a": 1.0}, lambda o: sum(o.values()), lambda o: o.update(b=3.0)),
    "set": _object(lambda: {1.0}, sum, lambda o: (o.clear(), o.add(4.0))),
    "deque": _object(lambda: collections.deque([1.0]), lambda o: o[0], lambda o: o.append(o.popleft() + 3.0)),
    "series": _object(lambda: pd.Series({"k": 1.0}), lambda o: float(o["k"]), lambda o: o.__setitem__("k", 4.0)),
    "large": _object(lambda: np.ones(200_000), lambda o: o[1000], lambda o: o.__setitem__(1000, 4.0)),
    "any entries": _object(lambda: np.array([1.0, None]), lambda o: o[0], lambda o: o.__setitem__(0, 4.0)),
    "its own changes": _written,
    "cached": _cached,
    "class": _class_attribute,
    **{"cell": _cell, "array": _array, "attribute": _attribute, "object": lambda: _attribute(Called)},
    **{"dictionary": _dictionary, "inside another": _inside_another},
}


@pytest.mark.parametrize("way", WAYS)
def test_a_changed_value_is_seen_by_a_new_system_and_said_of_the_old_one(way):
    function, change = WAYS[way]()
    system = dx.LagrangeDirac(function)
    run = dx.prepare(system, MIDPOINT, q=[1.0], v=[0.0], step=0.1, steps=2)
    assert end(system) == pytest.approx(np.cos(1.0), abs=1e-6)
    change()
    for late in (lambda: end(system), lambda: end(system, engine="xla"), run, lambda: system.energy(np.ones(1), np.ones(1))):
        is_other = r"which was .* when it was stated and is .*[42b].* now|in which there is something else than"
        with pytest.raises(ValueError, match=rf"lagrangian reads .*, ({is_other})"):
            late()
    assert end(dx.LagrangeDirac(function)) == pytest.approx(np.cos(2.0), abs=1e-6)


def test_a_value_that_comes_back_is_the_system_of_before(monkeypatch):
    system = dx.LagrangeDirac(by_global)
    before = end(system)
    monkeypatch.setitem(globals(), "stiffness", 4.0)
    other = dx.LagrangeDirac(by_global)
    assert other != system and end(other) == pytest.approx(np.cos(2.0), abs=1e-6)
    with pytest.raises(ValueError, match=r"reads stiffness, which was 1\.0 when it was stated and is 4\.0 now.*params"):
        dx.constraint_algorithm(system, {"q": [1.0], "v": [0.0]})
    monkeypatch.setitem(globals(), "stiffness", 1.0)
    assert dx.LagrangeDirac(by_global) == system and end(system) == before


def test_what_is_the_same_value_is_no_change(monkeypatch):
    calls = []

    def lagrangian(q, v):
        calls.append(1)  # a record of its own
        return v @ v / 2 - stiffness * q @ q / 2

    system = dx.LagrangeDirac(lagrangian)
    end(system)
    monkeypatch.setitem(globals(), "stiffness", float("1.0"))
    assert calls and not system.lagrangian.captured.changed()
    assert {each.words: each.before for each in pickle.loads(pickle.dumps(Captured(by_global))).watched}["stiffness"] == 1.0


@pytest.mark.parametrize("kind", [dx.Event, dx.Impact])
@pytest.mark.soak_of("Impact")
def test_events_and_walls_are_looked_at_too(kind):
    level, ball = {"w": 0.8}, dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[0])
    height = lambda q: q[0] - level["w"]
    event, fall = kind(height), {"q": [1.0], "v": [0.0], "step": 0.01, "steps": 150}
    found = lambda event: dx.simulate(ball, MIDPOINT, events=[event], **fall).events.t[0]
    assert found(event) == pytest.approx(np.sqrt(0.4), abs=1e-4)
    level["w"] = 0.5
    with pytest.raises(ValueError, match=r"reads level\['w'\], which was 0\.8 when it was stated"):
        found(event)
    assert found(kind(height)) == pytest.approx(1.0, abs=1e-4)


def test_functions_that_were_defined_anew_alike_are_the_same(monkeypatch):
    make = lambda power: lambda q: q**power
    one = make(2)
    helpers = {"V": one}
    reads = Captured(lambda q, v: helpers["V"](q))
    helpers["V"] = make(2)
    assert not reads.changed()
    helpers["V"] = make(3)
    assert reads.changed()


def test_forces_and_schemes_are_looked_at_too():
    own = {"c": 0.1}
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2, forces=lambda t, q, v: -own["c"] * v)
    end(system)
    own["c"] = 0.2
    with pytest.raises(ValueError, match="forces reads own"):
        end(system)


def test_discrete_lagrangians_of_schemes_are_looked_at_too():
    own = {"c": 1.0}
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2)
    scheme = dx.LagrangeDAlembert(lambda q0, q1, h: own["c"] * (q1 - q0) @ (q1 - q0) / (2 * h))
    run = lambda: dx.simulate(system, scheme, q=[1.0], v=[0.0], step=0.1, steps=2)
    assert run().ok
    own["c"] = 2.0
    with pytest.raises(ValueError, match="reads own"):
        run()


def test_runs_with_walls_are_looked_at_too():
    own = {"g": 1.0}
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 - own["g"] * q[0])
    wall = dx.Impact(lambda t, q: q[0])
    run = lambda: dx.simulate(system, MIDPOINT, q=[1.0], v=[0.0], step=0.1, steps=5, events=[wall])
    assert run().ok
    own["g"] = 2.0
    with pytest.raises(ValueError, match="reads own"):
        run()


NOTHING = jnp.zeros(0)


class Falling(dx.AbstractSystem):
    """ẋ = −k x."""

    def relation_form(self, shape):
        return dx.RelationForm(lambda x, rate, multipliers, t, params: rate + self.rate() * x)

    def rate(self):
        return stiffness

    def sizes(self, data, params):
        return 1, 0

    def complete(self, data, params, project):
        return {"x": data["x"], "velocity": 0.0 * data["x"], "t": data["t"]}

    def initial_defect(self, data, params):
        return NOTHING

    def energy_at(self, row, params):
        return row["x"][0]

    def constraint_at(self, row, params):
        return NOTHING


class Step(dx.AbstractScheme):
    """x′ = x − h k x of q."""

    def step_equation(self, system, shape):
        return dx.StepEquation(
            start=lambda data, h, params: (jnp.concatenate([data["q"], data["p"]]), NOTHING),
            residual=lambda u, x, t, h, params: NOTHING,
            advance=lambda u, x, t, h, params: x - h * stiffness * x,
            unpack=lambda x, u, t, h, params: {"q": x[:1], "p": x[1:]},
            state_layout=dx.Layout(q=1, p=1),
            unknowns=0,
            fields={"q": dx.Field((1,)), "p": dx.Field((1,))},
        )


FREE = dx.LagrangeDirac(lambda q, v: v @ v / 2)
OWN = {
    "system": lambda: dx.simulate(Falling(), dx.DiscreteDirac(), x=[1.0], step=0.1, steps=1).x[-1, 0],
    "scheme": lambda: dx.simulate(FREE, Step(), q=[1.0], v=[0.0], step=0.1, steps=1).q[-1, 0],
}


@pytest.mark.parametrize(("kind", "known"), [("system", 0.95 / 1.05), ("scheme", 0.9)])
def test_methods_of_own_classes_are_looked_at_too(kind, known, monkeypatch):
    assert OWN[kind]() == pytest.approx(known)
    monkeypatch.setitem(globals(), "stiffness", 4.0)
    with pytest.raises(ValueError, match=r"reads stiffness, which was 1\.0 .* and is 4\.0 now"):
        OWN[kind]()
    monkeypatch.undo()
    assert OWN[kind]() == pytest.approx(known)


def test_code_of_a_module_without_a_name_is_the_users():
    space = {"dx": dx, "k": 1.0}  # as exec() of a cell has it
    exec("class Of:\n    k = 1.0\nsystem = dx.LagrangeDirac(lambda q, v: v @ v / 2 - k * Of.k * q @ q / 2)", space)
    assert end(space["system"]) == pytest.approx(np.cos(1.0), abs=1e-6)
    space["Of"].k = 4.0
    with pytest.raises(ValueError, match=r"reads Of\.k"):
        end(space["system"])


def test_a_change_that_a_function_in_a_function_sees_is_told_as_its_own():
    scope = {"jnp": jnp, "J": jnp.array([1.0, 2.0, 3.0])}
    body = dx.EulerPoincare(dx.SO3(), eval("lambda xi: xi @ (J * xi) / 2 + (xi @ xi) ** 2 / 10", scope))
    run = lambda: dx.simulate(body.lie_poisson(), dx.Collocation(1), x=[0.1, 0.5, 0.3], step=0.05, steps=2)
    run()
    scope["J"] = jnp.array([3.0, 2.0, 1.0])
    with pytest.raises(ValueError, match=r"^lagrangian reads J, which was"):
        run()


WRAPPED = {
    "jit": jax.jit,
    "grad": jax.grad,
    "jit of hessian": lambda f: jax.jit(jax.hessian(f)),
    "checkpoint": jax.checkpoint,
    "custom_jvp": jax.custom_jvp,
    "equinox": eqx.filter_grad,
    "vectorize": jnp.vectorize,
}


@pytest.mark.parametrize("wrapped", WRAPPED.values(), ids=WRAPPED)
def test_functions_that_a_library_wraps_are_looked_into(wrapped):
    own = {"k": 1.0}
    potential = wrapped(lambda q: own["k"] * q @ q / 2)
    captured = Captured(lambda q, v: v @ v / 2 - potential(q))
    assert not captured.changed()
    own["k"] = 4.0
    assert captured.changed() == "own['k'], which was 1.0 when it was stated and is 4.0 now"


def exact(k):
    """The end of that motion by the midpoint rule."""
    return np.cos(2000 * np.arctan(np.sqrt(k) / 2000))


def wrapped_anew(wrapped):
    def of(k):
        globals()["helper"] = wrapped(lambda q: k * q * q / 2)
        return dx.LagrangeDirac(lambda q, v: v @ v / 2 - jnp.sum(helper(q)))

    return of


def by_default(k):
    globals()["helper"] = lambda q, k=k: k * q @ q / 2
    return dx.LagrangeDirac(lambda q, v: v @ v / 2 - helper(q))


def by_keyword(k):
    globals()["helper"] = lambda q, *, k=k: k * q @ q / 2
    return dx.LagrangeDirac(lambda q, v: v @ v / 2 - helper(q))


def by_code(k):
    """As modules that are loaded again put it there."""
    helper = globals().setdefault("reloaded", lambda q: q @ q / 2)
    helper.__code__ = (lambda q: q @ q / 2).__code__ if k == 1.0 else (lambda q: 4.0 * q @ q / 2).__code__
    return dx.LagrangeDirac(lambda q, v: v @ v / 2 - reloaded(q))


ANEW = {
    "vmap": wrapped_anew(jax.vmap),
    "jit": wrapped_anew(jax.jit),
    "default": by_default,
    "keyword": by_keyword,
    "code": by_code,
}


@pytest.mark.parametrize("stated", ANEW.values(), ids=ANEW)
def test_a_helper_that_is_another_one_is_another_system(stated):
    """The functions of both systems have the same code."""
    first = stated(1.0)
    assert end(first) == pytest.approx(exact(1.0), abs=1e-12)
    assert end(stated(4.0)) == pytest.approx(exact(4.0), abs=1e-12)
    with pytest.raises(ValueError, match=r"lagrangian reads .*helper|lagrangian reads reloaded, whose code is not what it was"):
        end(first)


@pytest.mark.parametrize("made", [jax.jit, jax.checkpoint, eqx.filter_jit])
def test_functions_of_which_jax_keeps_what_it_traced_are_made_anew(made):
    own = {"k": 1.0}
    anew = lambda: lambda q: own["k"] * q @ q / 2
    stated = lambda potential: dx.LagrangeDirac(lambda q, v: v @ v / 2 - potential(q))
    function = anew()
    potential = made(function)
    assert end(stated(potential)) == pytest.approx(exact(1.0), abs=1e-12)
    own["k"] = 4.0
    for late in (potential, made(function)):
        with pytest.raises(ValueError, match=r"reads own\['k'\], which was 1.0 .* JAX keeps what it traced .* the function anew"):
            end(stated(late))
    assert end(stated(made(anew()))) == pytest.approx(exact(4.0), abs=1e-12)
    own["k"] = 1.0
    assert end(stated(potential)) == pytest.approx(exact(1.0), abs=1e-12)


def test_rules_of_derivatives_are_looked_into():
    own = {"k": 1.0}
    potential = jax.custom_jvp(lambda q: q @ q / 2)
    potential.defjvp(lambda primals, tangents: (potential(*primals), own["k"] * primals[0] @ tangents[0]))
    captured = Captured(lambda q, v: v @ v / 2 - potential(q))
    own["k"] = 4.0
    assert captured.changed().startswith("own['k'], which was 1.0")


class Lazy:
    """Its masses are found when they are first asked for."""

    def __init__(self, array):
        self.array = array

    @functools.cached_property
    def mass(self):
        return self.array([1.0, 2.0])

    @functools.cached_property
    def never(self):
        raise RuntimeError("nothing asks for it")

    def lagrangian(self, q, v):
        return self.mass[1] * v @ v / 2 - q @ q


@pytest.mark.parametrize("array", [np.array, jnp.array], ids=["numpy", "jax"])
def test_what_an_object_keeps_from_the_first_time_on_has_not_changed(array):
    model = Lazy(array)
    system = dx.LagrangeDirac(model.lagrangian)
    assert [end(system), end(system, engine="xla")] == pytest.approx([np.cos(1.0)] * 2, abs=1e-6)
    model.__dict__["mass"] = array([1.0, 3.0])
    with pytest.raises(ValueError, match=r"self\.mass.* which was"):
        end(system)


class Spring:
    def __init__(self, k):
        self.k = k

    def lagrangian(self, q, v):
        return v @ v / 2 - jnp.sum(self.k * q * q) / 2


@pytest.mark.parametrize("jitted", [False, True])
@pytest.mark.parametrize("first", ["native", "xla"])
def test_an_array_that_is_changed_after_a_run_is_in_no_other_system(first, jitted):
    """What says the same is traced once: by the numbers of then."""
    of = lambda k: dx.LagrangeDirac(jax.jit(Spring(k).lagrangian) if jitted else Spring(k).lagrangian)
    k = np.array([1.0]) if jitted else np.array(1.0)
    assert end(of(k), engine=first) == pytest.approx(np.cos(1.0), abs=1e-6)
    k[...] = 4.0
    assert end(of(np.ones_like(k)), engine="xla") == pytest.approx(np.cos(1.0), abs=1e-6)
    assert end(of(k), engine="xla") == pytest.approx(np.cos(2.0), abs=1e-5)


def by_own_attribute(q, v):
    return v @ v / 2 - by_own_attribute.k * q @ q / 2


def by_import(q, v):
    from a_module_of_numbers import k

    return v @ v / 2 - k * q @ q / 2


def by_what_is_defined_later(q, v):
    return v @ v / 2 - defined_later * q @ q / 2


class Box:
    """A configuration that answers for its attributes."""

    def __init__(self, **entries):
        self.entries = entries

    def __getattr__(self, name):
        return self.__dict__["entries"][name]


number, box = types.SimpleNamespace(k=1.0), Box(k=1.0)
FORCES = {"spring": lambda holder, q: holder.k * q @ q / 2}


def set_to(k):
    by_own_attribute.k = number.k = box.entries["k"] = k
    module = sys.modules.setdefault("a_module_of_numbers", types.ModuleType("a_module_of_numbers"))
    module.k = globals()["defined_later"] = k


@pytest.mark.parametrize(
    "lagrangian",
    [
        by_own_attribute,
        by_import,
        by_what_is_defined_later,
        lambda q, v: v @ v / 2 - FORCES["spring"](number, q),
        lambda q, v: v @ v / 2 - getattr(number, "k") * q @ q / 2,  # noqa: B009
        lambda q, v: v @ v / 2 - vars(number)["k"] * q @ q / 2,
        lambda q, v: v @ v / 2 - box.k * q @ q / 2,
    ],
    ids=["its own attribute", "an import", "defined later", "by a function in a table", "getattr", "vars", "a box"],
)
def test_ways_to_read_a_number(lagrangian):
    globals().pop("defined_later", None)
    early, later = dx.LagrangeDirac(lagrangian), lagrangian is by_what_is_defined_later
    set_to(1.0)
    systems = [dx.LagrangeDirac(lagrangian), *[early] * later]
    assert list(map(end, systems)) == pytest.approx([np.cos(1.0)] * len(systems), abs=1e-6)
    set_to(4.0)
    for old in systems:
        with pytest.raises(ValueError, match=r"reads .*(k|defined_later).*, which was 1\.0 .* and is 4\.0 now"):
            end(old)
    assert end(dx.LagrangeDirac(lagrangian)) == pytest.approx(np.cos(2.0), abs=1e-5)


def test_datasets_make_new_arrays_of_the_same_numbers():
    data = xr.Dataset({"k": ("x", [1.0, 2.0])})
    lagrangian = lambda q, v: v @ v / 2 - data.k.values[0] * q @ q / 2
    system = dx.LagrangeDirac(lagrangian)
    assert [end(system), end(system)] == pytest.approx([np.cos(1.0)] * 2, abs=1e-6)
    data.k.values[0] = 4.0
    with pytest.raises(ValueError, match=r"lagrangian reads .*k"):
        end(system)
    assert end(dx.LagrangeDirac(lagrangian)) == pytest.approx(np.cos(2.0), abs=1e-5)


class Body:
    def __init__(self, k, parts=()):
        self.k, self.parts = k, list(parts)

    def total(self):
        return self.k + sum(part.total() for part in self.parts)


class Law:
    def potential(self, body, q):
        return body.k * q @ q / 2


def deep(levels):
    leaf = root = Body(0.25)
    for _ in range(levels):
        root = Body(0.0, [root])
    return leaf, root


LEAF, TREE = deep(3)
FAR_LEAF, TALL_TREE = deep(20)
MANY_BODIES, LAW, BODY, NUMBERS = [Body(0.25 / 512) for _ in range(512)], Law(), Body(0.25), [0.25 / 512] * 512
HANDED = functools.partial(lambda body, q: body.k * q @ q / 2, BODY)


@pytest.mark.parametrize(
    "lagrangian",
    [
        lambda q, v: v @ v / 2 - (0.75 + TREE.total()) * q @ q / 2,
        lambda q, v: v @ v / 2 - (0.75 + TALL_TREE.total()) * q @ q / 2,
        lambda q, v: v @ v / 2 - (0.75 + sum(body.k for body in MANY_BODIES)) * q @ q / 2,
        lambda q, v: v @ v / 2 - (0.75 + sum(NUMBERS)) * q @ q / 2,
        lambda q, v: v @ v / 2 - 0.75 * q @ q / 2 - LAW.potential(BODY, q),
        lambda q, v: v @ v / 2 - 0.75 * q @ q / 2 - HANDED(q),
    ],
    ids=["a tree", "a tall tree", "many", "many numbers", "a method of another object", "partial"],
)
def test_a_system_that_is_stated_anew_has_the_numbers_of_now(lagrangian):
    """Also where there is too much, or too deep in other objects, to be watched."""
    before = [(holder, holder.k) for holder in (LEAF, FAR_LEAF, MANY_BODIES[-1], BODY)]
    assert end(dx.LagrangeDirac(lagrangian)) == pytest.approx(np.cos(1.0), abs=1e-6)
    try:
        for holder, k in before:
            holder.k = k + 3.0
        NUMBERS[-1] += 3.0
        assert end(dx.LagrangeDirac(lagrangian)) == pytest.approx(np.cos(2.0), abs=1e-5)
    finally:
        for holder, k in before:
            holder.k = k
        NUMBERS[-1] = NUMBERS[0]
