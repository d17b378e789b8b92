"""Newton's iteration in IR: that of `engines/xla/newton.py` written out, lanes that are done frozen.

A Jacobian serves several updates while they contract quickly: a first kind of update computes residual, Jacobian and
factors together, a second kind the residual alone. Where a pivot was too small the correction comes from partial
pivoting, and the factors are not used again. Where a block of unknowns has several parts, an update changes one after the
other, each by its equations with the new values of those before it (Gauss, Seidel). The next one begins with the residual of the
first part where this one ends: it is found together with that of the last part, with which it has all in common that does
not depend on the unknowns of the last. Of linear equations whose pivots need no watching, an update of each kind is a round
without a question in between.
"""

from collections.abc import Sequence

from dirax.engines.native.ir.emitter import Body, Emitter
from dirax.engines.native.ir.lower import Region
from dirax.engines.native.loops.dense import DENSE_NAME
from dirax.engines.native.loops.plan import frontier
from dirax.engines.newton_step import Correction
from dirax.engines.stopping import CONTRACTING, FLOOR, NEAR, NEGLIGIBLE, OWN, STALLED


class NewtonLoop:
    """The iteration for one block of unknowns, from the guess to the root; `unknowns` and `sizes` are pointers to all unknowns of
    the equation.

    After `emit`, `converged` and `count` are, by lane, whether the floor was reached and the number of updates.
    """

    def __init__(self, parts: list[Correction], around: Region, unknowns: list[str], sizes: list[str]):
        self.parts, self.around = parts, around
        self.unknowns = {node: unknowns[i] for one in parts for node, i in zip(one.unknowns, one.places, strict=True)}
        self.sizes = {node: sizes[i] for one in parts for node, i in zip(one.unknowns, one.places, strict=True)}
        self.e: Emitter = around.emitter
        self.body: Body = self.e.body
        self.converged = self.count = ""
        self._linear = len(parts) == 1 and parts[0].linear
        self._direct = self._linear and parts[0].stable == around.graph.true

    def emit(self, active: str) -> None:
        b, e = self.body, self.e
        self._going, self._contracting, self._floor = (b.alloca(e.bool) for _ in range(3))
        self._update, self._number = b.alloca(e.real), b.alloca(e.real)
        b.store(e.bool, active, self._going, 1)
        b.store(e.bool, e.false, self._floor, 1)
        b.store(e.real, e.const(float("inf")), self._update)
        b.store(e.real, e.const(0.0), self._number)
        self._begun = [b.alloca(e.real) for _ in self.parts[0].residual] if len(self.parts) > 1 else []
        self._needs_last = self._need_unknowns_of(self.parts[-1]) if self._begun else {}
        with self._while(self._going) as now:
            factors = self._first_kind(now)
            if self._direct:
                self._second_kind(factors, now)
            else:
                with self._while(self._contracting) as now:
                    self._second_kind(factors, now)
        self.converged, self.count = b.load(e.bool, self._floor, 1), b.load(e.real, self._number)

    def _while(self, flag: str):
        """Repeat while a lane's flag is up; gives the flags."""
        return _While(self.body, self.e, flag)

    def values(self) -> list[tuple[int, str]]:
        """The unknowns and their present values."""
        return [(node, self.body.load(self.e.real, pointer)) for node, pointer in self.unknowns.items()]

    def _need_unknowns_of(self, last: Correction) -> dict[int, int]:
        """Which nodes of the last part and of the residual of the first need unknowns of the last: 1 for these, 0 for others."""
        g, own, needs = self.around.graph, set(last.unknowns), {}
        for node in g.reachable([*last.outputs, *last.residual, *self.parts[0].residual]):
            needs[node] = int(node in own or any(needs[a] for a in g.args[node]))
        return needs

    def _region(self, known: dict[int, str], around: Region) -> Region:
        """A region that knows the unknowns."""
        region = Region(self.e, self.around.graph, around)
        for node, value in known.items():
            region.bind(node, value)
        return region

    def _region_of(self, one: Correction, known: dict[int, str], wanted: list[int]) -> tuple[Region, Region]:
        """A region for the `wanted` nodes of a part, and the one around it, which of the last part has all that it and the
        residual of the first have in common."""
        if not self._begun or one is not self.parts[-1]:
            return self._region(known, self.around), self.around
        shared = self._region({node: value for node, value in known.items() if node not in one.unknowns}, self.around)
        shared.require(frontier(self.around.graph, self._needs_last, [*wanted, *self.parts[0].residual], 0))
        return self._region({node: known[node] for node in one.unknowns}, shared), shared

    def _begin_next(self, shared: Region, new: dict[int, str]) -> None:
        """The residual of the first part, with which the next update begins."""
        if not self._begun:
            return
        residual, last = self.parts[0].residual, self.parts[-1].unknowns
        inner = self._region({node: new[node] for node in last}, shared)
        inner.require(residual)
        for node, pointer in zip(residual, self._begun, strict=True):
            self.body.store(self.e.real, inner.value(node), pointer)

    def _first_kind(self, now: str) -> list[Region]:
        """An update with new Jacobians; the regions that know their factors."""
        old, g = dict(self.values()), self.around.graph
        new, changes, inside, stable, shared = dict(old), {}, [], self.e.true, self.around
        for one in self.parts:
            inner, shared = self._region_of(one, new, one.outputs)
            inner.require(one.outputs)
            change, good = [inner.value(n) for n in one.change], inner.value(one.stable)
            if one.stable != g.true:
                change = by_partial_pivoting(inner, one.jacobian, one.residual, change, good, now, one.rows)
            stable = self.e.both(stable, good)
            self._changed(one, change, new, changes)
            inside.append(inner)
        self._begin_next(shared, new)
        if self._direct:
            self._take(old, new, now)
        else:
            self._apply(old, new, changes, stable, now)
        return inside

    def _second_kind(self, factors: list[Region], now: str) -> None:
        """An update with the Jacobians of an earlier one."""
        old = dict(self.values())
        new, changes, shared = dict(old), {}, self.around
        begun = [self.body.load(self.e.real, pointer) for pointer in self._begun]
        for one, known in zip(self.parts, factors, strict=True):
            if begun and one is self.parts[0]:
                residual = begun
            else:
                here, shared = self._region_of(one, new, one.residual)
                here.require(one.residual)
                residual = [here.value(node) for node in one.residual]
            inner = self._region(dict(zip(one.right, residual, strict=True)), known)
            inner.require(one.again)
            self._changed(one, [inner.value(n) for n in one.again], new, changes)
        self._begin_next(shared, new)
        if self._direct:
            self._take(old, new, now)
            self._end_round(new, changes, now)
        else:
            self._apply(old, new, changes, self.e.true, now)

    def _changed(self, one: Correction, change: list[str], new: dict[int, str], changes: dict[int, str]) -> None:
        """Subtract the change of a part."""
        for node, value in zip(one.unknowns, change, strict=True):
            new[node], changes[node] = self.e.sub(new[node], value), value

    def _take(self, old: dict[int, str], new: dict[int, str], now: str) -> None:
        """The new unknowns of the lanes that go on into memory."""
        for node, pointer in self.unknowns.items():
            self.body.store(self.e.real, self.e.select(now, new[node], old[node]), pointer)

    def _end_round(self, new: dict[int, str], changes: dict[int, str], now: str) -> None:
        """The verdict on a second update of linear equations, of which roundoff alone is left where it was small."""
        b, e = self.body, self.e
        small, total = e.true, e.const(0.0)
        for node, d in changes.items():
            size = e.add(e.abs(new[node]), b.load(e.real, self.sizes[node]))
            small = e.both(small, e.compare("olt", e.abs(d), e.mul(e.const(STALLED), size)))
            total = e.add(total, d)
        count = b.load(e.real, self._number)
        count = e.select(now, e.add(count, e.const(2.0)), count)
        b.store(e.real, count, self._number)
        cap = e.splat(b.put("sitofp i64 %cap to double"))
        found = e.both(now, e.both(small, e.compare("ole", count, cap)))
        b.store(e.bool, e.either(b.load(e.bool, self._floor, 1), found), self._floor, 1)
        allowed = e.both(e.compare("ord", total, total), e.compare("olt", count, cap))
        b.store(e.bool, e.both(now, e.both(allowed, e.invert(small))), self._going, 1)

    def _apply(self, old: dict[int, str], new: dict[int, str], changes: dict[int, str], stable: str, now: str) -> None:
        """Measure the change, and decide which lanes take it, which go on and how."""
        b, e = self.body, self.e
        update, total = e.const(0.0), e.const(0.0)
        sizes = {node: b.load(e.real, size) for node, size in self.sizes.items()}
        for node, d in changes.items():
            update = e.max(e.div(e.abs(d), e.add(e.abs(new[node]), sizes[node])), update)
            total = e.add(total, d)
        update = e.select(e.compare("uno", total, total), e.const(float("nan")), update)
        count = b.load(e.real, self._number)
        first = e.compare("oeq", count, e.const(0.0))
        ratio = e.select(first, e.const(float("nan")), e.max(e.div(update, b.load(e.real, self._update)), update))
        self._take(old, new, now)
        b.store(e.real, e.select(now, update, b.load(e.real, self._update)), self._update)
        count = e.select(now, e.add(count, e.const(1.0)), count)
        b.store(e.real, count, self._number)
        known = e.true
        for node, d in changes.items():
            own = e.add(e.abs(new[node]), e.mul(e.const(OWN), sizes[node]))
            known = e.both(known, e.compare("ole", e.mul(ratio, e.abs(d)), e.mul(e.const(FLOOR / 2.0), own)))
        floor = self._at_floor(update, ratio, e.either(first, known))
        b.store(e.bool, e.body.put(f"select {e.bool} {now}, {e.bool} {floor}, {e.bool} {b.load(e.bool, self._floor, 1)}"),
                self._floor, 1)  # fmt: skip
        cap = e.splat(b.put("sitofp i64 %cap to double"))
        allowed = e.both(e.compare("ord", update, update), e.compare("olt", count, cap))
        unfinished = e.both(e.invert(floor), allowed)
        going = b.load(e.bool, self._going, 1)
        going = e.both(going, e.either(e.invert(now), unfinished))
        b.store(e.bool, going, self._going, 1)
        near = e.both(first, e.compare("olt", update, e.const(NEAR)))
        little = e.both(e.invert(first), e.compare("olt", update, e.const(STALLED)))
        quick = e.either(e.either(near, little), e.compare("olt", ratio, e.const(CONTRACTING)))
        b.store(e.bool, e.both(e.both(now, unfinished), e.both(quick, stable)), self._contracting, 1)

    def _at_floor(self, update: str, ratio: str, known: str) -> str:
        """Whether another update would gain nothing: `dirax/engines/stopping.py`; `known`, whether what is left is roundoff of
        the unknowns themselves."""
        e = self.e
        left = e.mul(e.mul(e.const(2.0), ratio), update)
        stalled = e.both(e.compare("oge", ratio, e.const(0.5)), e.compare("olt", update, e.const(STALLED)))
        rounded = e.both(e.compare("ole", update, e.const(FLOOR)), known)
        small = e.either(rounded, e.compare("ole", left, e.const(NEGLIGIBLE)))
        if self._linear:
            small = e.either(small, e.both(e.compare("ord", ratio, ratio), e.compare("olt", update, e.const(STALLED))))
        return e.either(small, stalled)


def by_partial_pivoting(
    region: Region,
    matrix: list[list[int]],
    right: list[int],
    change: list[str],
    stable: str,
    now: str,
    sizes: Sequence[int] = (),
) -> list[str]:
    """The solution `change` of matrix·x = right, in lanes with a pivot that was too small solved for anew, one at a time.

    Rows are divided by the `sizes` of their equations, so that pivots are chosen whatever their units."""
    e, k = region.emitter, len(change)
    b = e.body
    slots = lambda base, count: [b.at(e.real, base, i) for i in range(count)]
    memory, entries, side = b.alloca(e.real, k), b.alloca(e.real, k * k), b.alloca(e.real, k)
    scratch = b.alloca("double", k * (k + 1))
    store = lambda values, base: [b.store(e.real, value, p) for value, p in zip(values, slots(base, len(values)), strict=True)]
    store(change, memory)
    weak = e.both(e.invert(stable), now)
    with b.when(e.any(weak)):
        places = [(i * k + j, node) for i, row in enumerate(matrix) for j, node in enumerate(row) if node != region.graph.zero]
        nodes = [node for _, node in places]
        cold = Region(e, region.graph, region)
        cold.require([*nodes, *right, *sizes])
        values, sides = [cold.value(n) for n in nodes], [cold.value(n) for n in right]
        if sizes:
            units = [e.div(e.const(1.0), cold.value(n)) for n in sizes]
            values = [e.mul(value, units[at // k]) for value, (at, _) in zip(values, places, strict=True)]
            sides = [e.mul(value, unit) for value, unit in zip(sides, units, strict=True)]
        if len(places) < k * k:
            with b.loop(0, str(k * k)) as at:
                b.store(e.real, e.const(0.0), b.at(e.real, entries, at))
        for value, (at, _) in zip(values, places, strict=True):
            b.store(e.real, value, b.at(e.real, entries, at))
        store(sides, side)
        for lane in range(e.width):
            with b.when(e.extract(weak, lane, e.bool)):
                pointers = ", ".join(f"ptr {b.at('double', m, lane)}" for m in (entries, side, memory))
                b.line(f"call void @{DENSE_NAME}({pointers}, ptr {scratch}, i64 {k}, i64 {e.width})")
    return [b.load(e.real, p) for p in slots(memory, k)]


class _While:
    """A loop that repeats while a flag in memory is up in one lane at least."""

    def __init__(self, body: Body, e: Emitter, flag: str):
        self.body, self.e, self.flag = body, e, flag

    def __enter__(self) -> str:
        b = self.body
        self._head, inside, self._out = b.fresh(), b.fresh(), b.fresh()
        b.branch(self._head)
        b.label(self._head)
        now = b.load(self.e.bool, self.flag, 1)
        b.branch_if(self.e.any(now), inside, self._out)
        b.label(inside)
        return now

    def __exit__(self, *_) -> None:
        self.body.branch(self._head)
        self.body.label(self._out)
