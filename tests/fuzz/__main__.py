"""`python -m fuzz [systems] [first] [kinds]`, with tests on the path: what is wrong, a line each, and a summary."""

import itertools
import sys
import time
from collections import Counter

from fuzz.examine import SCHEMES, examine, random_case

count, first, kinds = (int(a) for a in (*sys.argv[1:], *("100", "0", "24")[len(sys.argv) - 1 :]))
started, found, runs = time.perf_counter(), Counter(), 0
for kind, name in itertools.product(range(kinds), SCHEMES):  # what is compiled serves a kind and a scheme
    for seed in range(first + (kind - first) % kinds, first + count, kinds):
        system, params, start = random_case(seed, kinds)
        runs += 1
        for wrong in examine(system, name, params, start, deep=seed % 50 == 0):
            found[wrong.split(":")[0]] += 1
            if not wrong.startswith("refused"):
                print(f"{seed} {name} {system.kind}: {wrong}", flush=True)
    print(f"kind {kind}, {name}: {runs} runs, {time.perf_counter() - started:.0f} s", file=sys.stderr)
print(f"{count} systems, {runs} runs, {time.perf_counter() - started:.0f} s: {dict(found) or 'nothing wrong'}")
sys.exit(any(kind != "refused" for kind in found))
