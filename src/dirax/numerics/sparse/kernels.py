"""The loops of sparse matrices: colours, elimination trees, and elimination in a band and in a fixed order.

Index arrays are those of compressed rows: the entries of row i are `columns[starts[i]:starts[i + 1]]`.
"""

# Names in capitals are constants that a kernel is given.
# pyrefly: ignore-errors[unknown-name]

from dirax.numerics.loops.compiler import Doubles, Ints, Longs


def greedy_colours(row_starts: Ints, columns: Ints, column_starts: Ints, rows: Ints, sizes: Longs, last: Ints, colours: Ints):
    """Colours of columns such that no row has two of one colour: each column in turn takes the first that is free."""
    for j in range(sizes[0]):
        last[j] = -1
        colours[j] = -1
    for j in range(sizes[0]):
        for a in range(column_starts[j], column_starts[j + 1]):
            i = rows[a]
            for b in range(row_starts[i], row_starts[i + 1]):
                c = colours[columns[b]]
                if c >= 0:
                    last[c] = j
        free = 0
        while last[free] == j:
            free = free + 1
        colours[j] = free


def count_fill(starts: Ints, columns: Ints, sizes: Longs, parent: Ints, mark: Ints, counts: Longs):
    """The elimination tree of a symmetric pattern, and how many entries each column of L has below its diagonal."""
    for i in range(sizes[0]):
        parent[i] = -1
        mark[i] = i
        counts[i] = 0
        for a in range(starts[i], starts[i + 1]):
            j = columns[a]
            if j < i:
                while mark[j] != i:
                    if parent[j] < 0:
                        parent[j] = i
                    counts[j] = counts[j] + 1
                    mark[j] = i
                    j = parent[j]


def list_fill(
    starts: Ints, columns: Ints, parent: Ints, fill_starts: Longs, sizes: Longs, mark: Ints, there: Longs,
    fill_rows: Ints, left_starts: Longs, left: Ints, left_places: Longs,
):  # fmt: skip
    """The rows of the entries of L below the diagonal, column by column, and for every row its columns to the left of the
    diagonal with the places of its entries in them."""
    at = 0
    for j in range(sizes[0]):
        there[j] = fill_starts[j]
    for i in range(sizes[0]):
        mark[i] = i
        left_starts[i] = at
        for a in range(starts[i], starts[i + 1]):
            j = columns[a]
            if j < i:
                while mark[j] != i:
                    fill_rows[there[j]] = i
                    left[at] = j
                    left_places[at] = there[j]
                    at = at + 1
                    there[j] = there[j] + 1
                    mark[j] = i
                    j = parent[j]
    left_starts[sizes[0]] = at


def in_units(
    rows: Ints, columns: Ints, places: Ints, values: Doubles, sizes: Doubles, counts: Longs, units: Doubles, scaled: Doubles
):
    """A matrix for unknowns of the size 1, and its rows in the `units` of their terms; entry a is `values[places[a]]`. `counts`:
    how many equations, entries and values."""
    for i in range(counts[0]):
        units[i] = 0.0
    for i in range(counts[2]):
        scaled[i] = 0.0
    for a in range(counts[1]):
        units[rows[a]] = units[rows[a]] + abs(values[places[a]]) * sizes[columns[a]]
    for i in range(counts[0]):
        units[i] = 1.0 / units[i]
    for a in range(counts[1]):
        scaled[places[a]] = values[places[a]] * units[rows[a]] * sizes[columns[a]]


# ---------------------------------------------------------------------------------------------- elimination in a band


def band_factor(
    starts: Ints, places: Ints, sources: Ints, values: Doubles, sizes: Longs,
    upper: Doubles, lower: Doubles, inverse: Doubles, pivots: Ints,
):  # fmt: skip
    """L and U of a matrix with BELOW diagonals below the main one, WIDTH in all with those of exchanged rows, by elimination
    with partial pivoting. Entry a of row i is `values[sources[a]]`, at `places[a]` from the first column that the row has."""
    n = sizes[0]
    for a in range((n + BELOW) * WIDTH):
        upper[a] = 0.0
    for i in range(min(BELOW, n)):
        for a in range(starts[i], starts[i + 1]):
            upper[i * WIDTH + places[a]] = values[sources[a]]
    for j in range(n):
        i = j + BELOW
        if i < n:
            for a in range(starts[i], starts[i + 1]):
                upper[i * WIDTH + places[a]] = values[sources[a]]
        best = abs(upper[j * WIDTH])
        pivot = 0
        for r in range(1, BELOW + 1):
            size = abs(upper[(j + r) * WIDTH])
            pivot = r if size > best else pivot
            best = max(size, best)
        pivots[j] = pivot
        if pivot > 0:
            for c in range(WIDTH):
                kept = upper[j * WIDTH + c]
                upper[j * WIDTH + c] = upper[(j + pivot) * WIDTH + c]
                upper[(j + pivot) * WIDTH + c] = kept
        one = 1.0 / upper[j * WIDTH]
        inverse[j] = one
        for r in range(1, BELOW + 1):
            m = upper[(j + r) * WIDTH] * one
            lower[j * BELOW + r - 1] = m
            for c in range(1, WIDTH):
                upper[(j + r) * WIDTH + c - 1] = upper[(j + r) * WIDTH + c] - m * upper[j * WIDTH + c]
            upper[(j + r) * WIDTH + WIDTH - 1] = 0.0


def band_solve(
    order: Ints, rows: Ints, upper: Doubles, lower: Doubles, inverse: Doubles, pivots: Ints, right: Doubles, sizes: Longs,
    x: Doubles, found: Doubles,
):  # fmt: skip
    """The solution with those factors, of equations `rows` in turn for unknowns `order` in turn."""
    n = sizes[0]
    for i in range(n):
        x[i] = right[rows[i]]
    for i in range(WIDTH):
        x[n + i] = 0.0
    for j in range(n):
        p = pivots[j]
        t = x[j + p]
        x[j + p] = x[j]
        x[j] = t
        for r in range(1, BELOW + 1):
            x[j + r] = x[j + r] - lower[j * BELOW + r - 1] * t
    for i in range(WIDTH):
        x[n + i] = 0.0
    for j in range(n - 1, -1, -1):
        s = x[j]
        for c in range(1, WIDTH):
            s = s - upper[j * WIDTH + WIDTH - c] * x[j + WIDTH - c]
        s = s * inverse[j]
        x[j] = s
        found[order[j]] = s


def band_solve_transposed(
    order: Ints, rows: Ints, upper: Doubles, lower: Doubles, inverse: Doubles, pivots: Ints, right: Doubles, sizes: Longs,
    x: Doubles, found: Doubles,
):  # fmt: skip
    """The same for the transposed matrix."""
    n = sizes[0]
    for i in range(n):
        x[i] = right[order[i]]
    for i in range(WIDTH):
        x[n + i] = 0.0
    for j in range(n):
        t = x[j] * inverse[j]
        x[j] = t
        for c in range(1, WIDTH):
            x[j + c] = x[j + c] - upper[j * WIDTH + c] * t
    for i in range(WIDTH):
        x[n + i] = 0.0
    for j in range(n - 1, -1, -1):
        s = x[j]
        for r in range(1, BELOW + 1):
            s = s - lower[j * BELOW + r - 1] * x[j + r]
        p = pivots[j]
        x[j] = x[j + p]
        x[j + p] = s
    for i in range(n):
        found[rows[i]] = x[i]


# -------------------------------------------------------------------------------------- elimination in a fixed order


def fixed_factor(
    starts: Ints, places: Ints, sources: Ints, fill_starts: Longs, fill_rows: Ints,
    left_starts: Longs, left: Ints, left_places: Longs, values: Doubles, sizes: Longs,
    x: Doubles, y: Doubles, units: Doubles, lower: Doubles, upper: Doubles, inverse: Doubles, left_over: Longs,
):  # fmt: skip
    """L by columns and U by rows of a matrix whose pivots are taken in order, both with the pattern `fill_rows`.

    Entry a of those of pivot k is `values[sources[a]]`: in column k at row `places[a]`, or in row k at column −1 − `places[a]`.
    `left_over` is 0, or n where a pivot was less than 1e-4 of its column, rows in units of their largest entries: there it ends.
    """
    n = sizes[0]
    left_over[0] = 0
    for i in range(n):
        x[i] = 0.0
        y[i] = 0.0
        units[i] = 0.0
    for k in range(n):
        for a in range(starts[k], starts[k + 1]):
            i = max(places[a], k)
            units[i] = max(units[i], abs(values[sources[a]]))
    for k in range(n):
        for a in range(starts[k], starts[k + 1]):
            place = places[a]
            if place >= 0:
                x[place] = x[place] + values[sources[a]]
            else:
                y[-1 - place] = y[-1 - place] + values[sources[a]]
        for b in range(left_starts[k], left_starts[k + 1]):
            j = left[b]
            first = left_places[b]
            up = upper[first]
            low = lower[first]
            x[k] = x[k] - low * up
            if up != 0.0 or low != 0.0:
                for a in range(first + 1, fill_starts[j + 1]):
                    i = fill_rows[a]
                    x[i] = x[i] - lower[a] * up
                    y[i] = y[i] - upper[a] * low
        one = 1.0 / x[k]
        inverse[k] = one
        ratio = 1e-4 * abs(one) * units[k]
        large = 0.0 if ratio < 1e290 else 1.0
        x[k] = 0.0
        for a in range(fill_starts[k], fill_starts[k + 1]):
            i = fill_rows[a]
            large = 1.0 if abs(x[i]) * ratio > units[i] else large
            lower[a] = x[i] * one
            upper[a] = y[i]
            x[i] = 0.0
            y[i] = 0.0
        if large > 0.0:
            left_over[0] = n
            break


def fixed_solve(
    order: Ints, rows: Ints, fill_starts: Longs, fill_rows: Ints, lower: Doubles, upper: Doubles, inverse: Doubles,
    right: Doubles, sizes: Longs, x: Doubles, found: Doubles,
):  # fmt: skip
    """The solution with those factors, of equations `rows` in turn for unknowns `order` in turn."""
    n = sizes[0]
    for i in range(n):
        x[i] = right[rows[i]]
    for k in range(n):
        t = x[k]
        for a in range(fill_starts[k], fill_starts[k + 1]):
            x[fill_rows[a]] = x[fill_rows[a]] - lower[a] * t
    for k in range(n - 1, -1, -1):
        s = x[k]
        for a in range(fill_starts[k], fill_starts[k + 1]):
            s = s - upper[a] * x[fill_rows[a]]
        s = s * inverse[k]
        x[k] = s
        found[order[k]] = s


def fixed_solve_transposed(
    order: Ints, rows: Ints, fill_starts: Longs, fill_rows: Ints, lower: Doubles, upper: Doubles, inverse: Doubles,
    right: Doubles, sizes: Longs, x: Doubles, found: Doubles,
):  # fmt: skip
    """The same for the transposed matrix."""
    n = sizes[0]
    for i in range(n):
        x[i] = right[order[i]]
    for k in range(n):
        t = x[k] * inverse[k]
        x[k] = t
        for a in range(fill_starts[k], fill_starts[k + 1]):
            x[fill_rows[a]] = x[fill_rows[a]] - upper[a] * t
    for k in range(n - 1, -1, -1):
        s = x[k]
        for a in range(fill_starts[k], fill_starts[k + 1]):
            s = s - lower[a] * x[fill_rows[a]]
        x[k] = s
        found[rows[k]] = s
