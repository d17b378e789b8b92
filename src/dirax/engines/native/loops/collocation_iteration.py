"""The iteration of a collocation step in IR: attempts from two guesses, sweeps until nothing more is gained, and the verdict."""

from dirax.engines.native.loops.collocation_nodes import Nodes
from dirax.engines.native.loops.collocation_sweeps import Sweep
from dirax.engines.native.loops.over_nodes import Pair
from dirax.engines.stopping import EPSILON, STALLED

FAR = 2.0**-20
"""Relative changes above which nothing more is asked of an iterate: it is not at its root."""

CLEAR = 64 * EPSILON
"""Changes above it, relative to the terms of an iterate, are more than their roundoff."""

SURE = 2.0**-6
"""What is likely roundoff of a size, which is a bound that can be far too large: changes clear of it are looked at again."""

PATIENCE = 3.0
"""Times that an iteration may pause above it: its error can go to and fro between the entries."""


class Iteration:
    """The iteration for the iterates in the rooms of `pair`, of which those of the step before stand in the rooms `before`, by a
    kind of sweep; the last changes are left in the rooms `moved`, and `sizes` are how large iterates are. A last change after
    which more was to be expected than roundoff, the sequence before it says, stands in `open` as well, where others are zero."""

    def __init__(self, nodes: Nodes, pair: Pair, before: list[str], moved: list[str], sizes: list[str]):
        self.body, self.one, self.all = nodes.body, nodes.one, nodes.all
        self.pair, self.before, self.moved, self.sizes = pair, before, moved, sizes
        self.open = nodes.all.rooms(len(moved))

    def emit(self, sweep: Sweep, later: str, running: str) -> tuple[str, str, str]:
        """The iteration from the polynomial of the step before, where that fails from constants, or the other way round:
        (converged, the last change, sweeps) of those that are running."""
        b, over, one = self.body, self.all, self.one
        self.trying, self.change, self.sweeps = b.alloca(one.bool), b.alloca(one.real), b.alloca(one.real)
        self.changes = [b.alloca(one.real) for _ in range(3)]
        b.store(one.bool, running, self.trying)
        b.store(one.real, one.const(0.0), self.sweeps)
        b.store(one.real, one.const(0.0), self.change)
        with b.loop(0, 2) as attempt, b.when(one.any(b.load(one.bool, self.trying))):
            first = b.put(f"icmp eq i64 {attempt}, 0")
            trying = b.load(one.bool, self.trying)
            iterates = self.pair.now()
            with b.when(first), over.at() as node:
                over.filled(iterates, sweep.guess(self.before, later, sweep.continued[0], node), node)
            with b.when(b.put(f"xor i1 {first}, true")), over.at() as node:
                guess = zip(sweep.guess(self.before, later, sweep.continued[1], node), iterates, strict=True)
                over.filled(iterates, [over.chosen(trying, a, over.load(room, node)) for a, room in guess], node)
            self._iterate(sweep)
        converged = one.both(running, one.invert(b.load(one.bool, self.trying)))
        return converged, b.load(one.real, self.change), b.load(one.real, self.sweeps)

    def _iterate(self, sweep: Sweep) -> None:
        """Sweeps until the next change of every entry of an iterate is below its roundoff, or changes shrink no more, and again
        where these are more than roundoff; those that have come to a root then try no longer."""
        b, over, one = self.body, self.all, self.one
        count_here, active, shaky, pauses = b.alloca("i64"), b.alloca(one.bool), b.alloca(one.bool), b.alloca(one.real)
        if sweep.together:
            self._know_terms(sweep, b.load(one.bool, self.trying))
            for place, value in zip(self.changes, (float("inf"), float("inf"), 0.0), strict=True):
                b.store(one.real, one.const(value), place)
        else:
            with over.at() as node:
                over.filled(self.open, [over.emitter.const(float("inf"))] * len(self.open), node)
        b.store(one.bool, one.false, shaky)
        b.store("i64", "0", count_here)
        b.store(one.real, one.const(0.0), pauses)
        b.store(one.bool, b.load(one.bool, self.trying), active)
        head, out, ended = b.fresh(), b.fresh(), b.fresh()
        b.branch(head)
        b.label(head)
        now, unstable = b.load(one.bool, active), over.flag()
        rooms = self.pair.now(), self.pair.others()
        if sweep.together:
            peaks = over.peak(), over.peak()
            sweep.sweep(lambda node, new, stable: self._measured(sweep, node, new, peaks, *rooms))
            further = self._shrinks(*map(over.highest, peaks))
        else:
            going = over.flag()
            sweep.sweep(lambda node, new, stable: self._compared(sweep, node, new, stable, now, going, unstable, *rooms))
            further = over.marked(going)
        b.store(one.real, one.add(b.load(one.real, self.sweeps), one.select(now, one.const(1.0), one.const(0.0))), self.sweeps)
        count = b.put(f"add i64 {b.load('i64', count_here)}, 1")
        b.store("i64", count, count_here)
        allowed = b.put(f"icmp slt i64 {count}, %cap")
        still = b.put(f"select i1 {b.put(f'icmp eq i64 {count}, 1')}, {one.bool} {one.true}, {one.bool} {further}")
        shrinking = one.both(now, still)
        still = b.put(f"select i1 {allowed}, {one.bool} {shrinking}, {one.bool} {one.false}")
        b.store(one.bool, still, active)
        before = one.both(b.load(one.bool, shaky), one.invert(now))
        cut = b.put(f"select i1 {allowed}, {one.bool} {one.false}, {one.bool} {shrinking}")
        b.store(one.bool, one.either(one.either(before, cut), one.both(now, over.marked(unstable))), shaky)
        self.pair.swap()
        b.branch_if(one.any(still), head, out)
        b.label(out)
        missed = self._missed(sweep)
        if not sweep.together:
            paused = b.load(one.real, pauses)
            again = one.both(missed, one.compare("olt", paused, one.const(PATIENCE)))
            again = b.put(f"select i1 {allowed}, {one.bool} {again}, {one.bool} {one.false}")
            b.store(one.real, one.select(again, one.add(paused, one.const(1.0)), paused), pauses)
            b.store(one.bool, again, active)
            b.branch_if(one.any(again), head, ended)
            b.label(ended)
        self._judge(sweep, one.either(missed, b.load(one.bool, shaky)))

    def _measured(self, sweep: Sweep, node: str, new: list[str], peaks: tuple[str, str], rooms: list, others: list) -> None:
        """The new iterates at a node into the other rooms; and their largest change, by the sizes of the iterates, and by what is
        likely of these."""
        over, e = self.all, self.all.emitter
        for a, room, other, place, size in zip(new, rooms, others, self.moved, sweep.sizes(self.sizes), strict=True):
            moved, size = e.abs(e.sub(a, over.load(room, node))), over.splat(size)
            for peak, part in zip(peaks, (size, e.mul(size, e.const(SURE))), strict=True):
                relative = e.div(moved, e.add(e.abs(a), part))
                over.raised(peak, e.select(e.compare("ogt", moved, e.const(0.0)), relative, e.const(0.0)))
            over.store(moved, place, node)
            over.store(a, other, node)

    def _shrinks(self, of_size: str, update: str) -> str:
        """Whether the largest change is not small yet, or more than roundoff and the smallest so far is one of the last: an error
        that goes to and fro between coordinates does not shrink at every sweep."""
        b, one = self.body, self.one
        last, least, stale = (b.load(one.real, place) for place in self.changes)
        more = one.compare("oge", update, least)
        stale = one.select(more, one.add(stale, one.const(1.0)), one.const(0.0))
        for value, place in zip((update, one.select(more, least, update), stale), self.changes, strict=True):
            b.store(one.real, value, place)
        patience = one.select(one.compare("ogt", update, one.const(CLEAR)), one.const(PATIENCE), one.const(1.0))
        now = one.max(update, last)
        left = one.both(one.compare("ogt", now, one.const(EPSILON)), one.compare("olt", stale, patience))
        begun = one.compare("oeq", last, one.const(float("inf")))
        return one.either(one.either(begun, one.compare("ogt", of_size, one.const(STALLED))), left)

    def _compared(
        self, sweep: Sweep, node: str, new: list[str], stable: str, now: str, going: str, unstable: str, rooms: list, others: list
    ) -> None:
        """The new iterates at a node, of trajectories that go on `now`, into the other rooms; and whether they have to go on."""
        over, e = self.all, self.all.emitter
        found, far = [], e.false
        for a, room, other in zip(new, rooms, others, strict=True):
            before = over.load(room, node)
            over.store(a if self.one.width == 1 else over.chosen(now, a, before), other, node)
            moved, size = e.abs(e.sub(a, before)), e.abs(a)
            found.append((moved, size))
            far = e.either(far, e.compare("ogt", moved, e.mul(size, e.const(FAR))))
        alone = self.one.width == 1
        over.mark(going, far)
        with over.seldom(e.invert(far)):
            further = e.false
            for (moved, size), room, open_ in zip(found, self.moved, self.open, strict=True):
                last, floor = over.load(room, node), e.mul(size, e.const(EPSILON))
                shrinks, more = e.compare("olt", moved, last), e.compare("ogt", moved, floor)
                # the next change will be moved²/last, and so on
                left = e.mul(moved, moved)
                floor = e.mul(floor, last)
                for _ in range(sweep.later):
                    left, floor = e.mul(left, moved), e.mul(floor, last)
                more = e.both(more, e.compare("uge", left, floor))
                further = e.either(further, e.both(shrinks, more))
                due = e.select(more, moved, e.const(0.0))
                over.store(due if alone else over.chosen(now, due, over.load(open_, node)), open_, node)
            over.mark(going, further)
        for (moved, _), room in zip(found, self.moved, strict=True):
            over.store(moved if alone else over.chosen(now, moved, over.load(room, node)), room, node)
        if stable != e.true:
            over.mark(unstable, e.invert(stable))

    def _missed(self, sweep: Sweep) -> str:
        """Which of those that try have changed by more than roundoff and not for the last time. An iterate that is nothing but
        roundoff is measured by what it is made of."""
        b, over, one = self.body, self.all, self.one
        missed, trying = over.flag(), b.load(one.bool, self.trying)
        self._compare(sweep, missed)
        far = one.both(trying, over.marked(missed))
        with b.when(one.any(far)):
            self._know_terms(sweep, far)
            over.clear(missed)
            self._compare(sweep, missed)
        return one.both(trying, over.marked(missed))

    def _judge(self, sweep: Sweep, failed: str) -> None:
        """Those that tried and have not failed are at a root, and try no longer."""
        b, over, one = self.body, self.all, self.one
        trying = b.load(one.bool, self.trying)
        if not sweep.later:
            peak = over.peak()
            with over.at() as node:
                for room in self.moved:
                    over.raised(peak, over.load(room, node))
            b.store(one.real, one.select(trying, over.highest(peak), b.load(one.real, self.change)), self.change)
        b.store(one.bool, one.both(trying, failed), self.trying)

    def _know_terms(self, sweep: Sweep, some: str) -> None:
        """Take what the iterates of some trajectories are made of into their sizes."""
        b, one = self.body, self.one
        for size, value in zip(self.sizes, sweep.terms(), strict=True):
            known = b.load(one.real, size)
            b.store(one.real, one.select(some, one.max(value, known), known), size)

    def _compare(self, sweep: Sweep, missed: str) -> None:
        """Mark where a last change is not small, or was not to be the last and is more than roundoff."""
        over, e = self.all, self.all.emitter
        sizes, iterates = sweep.sizes(self.sizes), self.pair.now()
        limits = [(self.moved, CLEAR, 1.0)] if sweep.together else [(self.moved, STALLED, 1.0), (self.open, CLEAR, SURE)]
        with over.at() as node:
            off = e.false
            for i, size in enumerate(sizes):
                own = e.abs(over.load(iterates[i], node))
                for changes, most, share in limits:
                    whole = e.add(own, e.mul(over.splat(size), e.const(share)))
                    off = e.either(off, e.compare("ugt", over.load(changes[i], node), e.mul(whole, e.const(most))))
            over.mark(missed, off)
