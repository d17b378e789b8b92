"""`python -m fuzz [systems] [first] [kinds]`, with tests on the path: what is wrong, a line each, and a summary."""

import itertools
import sys
import time
from collections import Counter

from fuzz.examine import SCHEMES, examine, examine_together, random_case

TOGETHER = 16
"""Systems of a kind that are examined as one batch: of many, not every row is computed again."""

DEEP = 200
"""One system of so many is examined alone and in depth."""

count, first, kinds = (int(a) for a in (*sys.argv[1:], *("100", "0", "24")[len(sys.argv) - 1 :]))
started, found, runs = time.perf_counter(), Counter(), 0
for kind in range(kinds):  # what is compiled serves a kind and a scheme
    system = random_case(kind, kinds)[0]
    cases = {seed: random_case(seed, kinds)[1:] for seed in range(first + (kind - first) % kinds, first + count, kinds)}
    others = {seed: case for seed, case in cases.items() if seed % DEEP}
    for name in SCHEMES:
        wrong = {seed: examine(system, name, *case, deep=True) for seed, case in cases.items() if seed not in others}
        for low in range(0, len(others), TOGETHER):
            wrong |= examine_together(system, name, dict(itertools.islice(others.items(), low, low + TOGETHER)))
        for seed, each in sorted(wrong.items()):
            found.update(what.split(":")[0] for what in each)
            for what in each:
                if not what.startswith("refused"):
                    print(f"{seed} {name} {system.kind}: {what}", flush=True)
        runs += len(wrong)
        print(f"kind {kind}, {name}: {runs} runs, {time.perf_counter() - started:.0f} s", file=sys.stderr)
print(f"{count} systems, {runs} runs, {time.perf_counter() - started:.0f} s: {dict(found) or 'nothing wrong'}")
sys.exit(any(kind != "refused" for kind in found))
