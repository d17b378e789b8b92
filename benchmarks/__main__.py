"""python -m benchmarks [--full] [NAME …]: the short form of every benchmark, or of those named; results as JSON."""

import sys

from benchmarks import batches, first_call, reduction, saving, sparse, sweep, xla_vs_c
from benchmarks.harness import RESULTS

BENCHMARKS = {
    "xla_vs_c": xla_vs_c,
    "saving": saving,
    "batches": batches,
    "first_call": first_call,
    "reduction": reduction,
    "sparse": sparse,
    "sweep": sweep,
}


def main(arguments: list[str]) -> int:
    """Run what was asked for; 1 for an unknown name."""
    names = [word for word in arguments if not word.startswith("-")]
    unknown = [name for name in names if name not in BENCHMARKS]
    if unknown:
        print(f"no benchmark {', '.join(unknown)}; there are {', '.join(BENCHMARKS)}.", file=sys.stderr)
        return 1
    for name in names or BENCHMARKS:
        BENCHMARKS[name].main(short="--full" not in arguments)
    print(f"stored in {RESULTS.relative_to(RESULTS.parents[1])}/")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
