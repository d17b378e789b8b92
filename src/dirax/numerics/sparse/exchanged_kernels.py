"""The loops of elimination with exchanged rows, of matrices by columns: entries of column k are those from `starts[k]` on."""

from dirax.numerics.loops.compiler import Doubles, Ints, Longs


def exchanged_factor(
    starts: Ints, places: Ints, sources: Ints, own: Ints, room: Longs, values: Doubles, sizes: Longs,
    x: Doubles, units: Doubles, mark: Ints, stack: Ints, reached: Ints, next: Longs, place: Ints,
    lower_starts: Longs, lower_rows: Ints, lower: Doubles, upper_starts: Longs, upper_rows: Ints, upper: Doubles,
    inverse: Doubles, pivots: Ints,
):  # fmt: skip
    """L and U by columns of a matrix with the columns in a given order, by elimination with rows exchanged where it has to be
    (J. R. Gilbert, T. Peierls, SIAM J. Sci. Stat. Comput. 9 (1988) 862): `pivots` are the rows in turn.

    Entry a of those of column k is `values[sources[a]]`, in row `places[a]`. The pivot is the entry of the row `own[k]` where
    that is no less than a tenth of the largest, rows in units of their largest entries. Where L or U has more than `room` entries
    the inverse pivots are infinite, and there are no entries.
    """
    n = sizes[0]
    for i in range(n):
        x[i] = 0.0
        units[i] = 0.0
        mark[i] = -1
        place[i] = -1
    for a in range(starts[n]):
        units[places[a]] = max(units[places[a]], abs(values[sources[a]]))
    for i in range(n):
        units[i] = 1.0 / units[i] if units[i] > 0.0 else 0.0
    low = 0
    up = 0
    for k in range(n):
        lower_starts[k] = low
        upper_starts[k] = up
        top = n  # reached[top:] are the rows that column k will have entries in, those that others follow from first
        for a in range(starts[k], starts[k + 1]):
            i = places[a]
            if mark[i] != k:
                mark[i] = k
                stack[0] = i
                depth = 0
                next[0] = lower_starts[place[i]] if place[i] >= 0 else 0
                while depth >= 0:
                    j = place[stack[depth]]
                    at = next[depth]
                    end = lower_starts[j + 1] if j >= 0 else 0
                    while at < end and mark[lower_rows[at]] == k:
                        at = at + 1
                    if at < end:
                        i = lower_rows[at]
                        next[depth] = at + 1
                        mark[i] = k
                        depth = depth + 1
                        stack[depth] = i
                        next[depth] = lower_starts[place[i]] if place[i] >= 0 else 0
                    else:
                        top = top - 1
                        reached[top] = stack[depth]
                        depth = depth - 1
            x[places[a]] = x[places[a]] + values[sources[a]]
        if max(low, up) + n - top > room[0]:
            low = 0
            up = 0
            for i in range(n):
                lower_starts[i] = 0
                lower_starts[i + 1] = 0
                upper_starts[i] = 0
                pivots[i] = own[i]
                inverse[i] = 1e308 * 10.0
            break
        for a in range(top, n):
            i = reached[a]
            j = place[i]
            if j >= 0:
                value = x[i]
                x[i] = 0.0
                upper_rows[up] = j
                upper[up] = value
                up = up + 1
                for b in range(lower_starts[j], lower_starts[j + 1]):
                    x[lower_rows[b]] = x[lower_rows[b]] - lower[b] * value
            else:
                lower_rows[low] = i
                low = low + 1
        best = 0.0
        pivot = lower_rows[lower_starts[k]]  # there is one: elimination leaves a regular pattern regular
        for a in range(lower_starts[k], low):
            i = lower_rows[a]
            size = abs(x[i]) * units[i]
            pivot = i if size > best else pivot
            best = max(size, best)
        i = own[k]
        if mark[i] == k and place[i] < 0 and abs(x[i]) * units[i] >= 0.1 * best:
            pivot = i
        one = 1.0 / x[pivot]
        inverse[k] = one
        x[pivot] = 0.0
        pivots[k] = pivot
        place[pivot] = k
        first = lower_starts[k]
        last = first
        for a in range(first, low):
            i = lower_rows[a]
            if i != pivot:
                lower_rows[last] = i
                lower[last] = x[i] * one
                x[i] = 0.0
                last = last + 1
        low = last
        lower_starts[k + 1] = low
    upper_starts[n] = up
    for a in range(low):
        lower_rows[a] = place[lower_rows[a]]


def exchanged_solve(
    order: Ints, lower_starts: Longs, lower_rows: Ints, lower: Doubles, upper_starts: Longs, upper_rows: Ints, upper: Doubles,
    inverse: Doubles, pivots: Ints, right: Doubles, sizes: Longs, x: Doubles, found: Doubles,
):  # fmt: skip
    """The solution with those factors, for unknowns `order` in turn."""
    n = sizes[0]
    for i in range(n):
        x[i] = right[pivots[i]]
    for k in range(n):
        t = x[k]
        for a in range(lower_starts[k], lower_starts[k + 1]):
            x[lower_rows[a]] = x[lower_rows[a]] - lower[a] * t
    for k in range(n - 1, -1, -1):
        t = x[k] * inverse[k]
        found[order[k]] = t
        for a in range(upper_starts[k], upper_starts[k + 1]):
            x[upper_rows[a]] = x[upper_rows[a]] - upper[a] * t


def exchanged_solve_transposed(
    order: Ints, lower_starts: Longs, lower_rows: Ints, lower: Doubles, upper_starts: Longs, upper_rows: Ints, upper: Doubles,
    inverse: Doubles, pivots: Ints, right: Doubles, sizes: Longs, x: Doubles, found: Doubles,
):  # fmt: skip
    """The same for the transposed matrix."""
    n = sizes[0]
    for k in range(n):
        s = right[order[k]]
        for a in range(upper_starts[k], upper_starts[k + 1]):
            s = s - upper[a] * x[upper_rows[a]]
        x[k] = s * inverse[k]
    for k in range(n - 1, -1, -1):
        s = x[k]
        for a in range(lower_starts[k], lower_starts[k + 1]):
            s = s - lower[a] * x[lower_rows[a]]
        x[k] = s
        found[pivots[k]] = s
