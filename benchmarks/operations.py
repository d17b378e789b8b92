"""What a batch costs in vector instructions, counted while it runs: the table of docs/speed.md on batches beside heyoka.

    python -m benchmarks.operations

Needs heyoka and objdump. Every basic block of a kernel of dirax, after LLVM's passes, gets a counter, which is multiplied by the
block's instructions on vectors of floating-point numbers; those of a step of heyoka, which has no loops, are counted in its
machine code and multiplied by its steps. A product with a sum is one instruction. What the machine can do is measured by
products with sums that wait for nothing.
"""

import collections
import ctypes
import os
import re
import subprocess
import tempfile
import time

os.environ["DIRAX_THREADS"] = "1"

import llvmlite.binding as llvm
import numpy as np

import dirax as dx
from benchmarks.collocation_batch import BATCH, END, SIDE_BY_SIDE, beside_heyoka, propagated, taylor
from benchmarks.splitting import FOURTEEN
from benchmarks.work_precision import henon_heiles
from dirax.engines.native import kernel_cache
from dirax.program import machine_code

SETTINGS = (
    ("splitting of order 6", FOURTEEN, 145),
    ("splitting of order 6", FOURTEEN, 480),
    ("Gauss, 6 stages", dx.Collocation(6), 100),
    ("Gauss, 7 stages", dx.Collocation(7), 100),
    ("Gauss, 8 stages", dx.Collocation(8), 100),
)
TOLERANCES = (1e-7, 1e-9, 1e-12)
REPEATS = 8
OPERATION = r"(?:fadd|fsub|fmul|fdiv|fneg|fcmp \w+|select|(?:tail )?call <\d+ x double> @llvm\.\w+[\w.]*)"
ARITHMETIC = re.compile(rf"= {OPERATION}\W.*<\d+ x double>")
ON_VECTORS = re.compile(r"\tv(add|sub|mul|div|fn?m\w+|cmp\w*|max|min|and|andn|or|xor|sqrt|rndscale|getexp|blendm)p[ds] .*zmm")


class Counter:
    """Kernels that count: what LLVM is given gets a counter in each basic block."""

    def __init__(self):
        self.instructions: list[int] = []
        self.libraries: list = []

    def object_code(self, text: str, target=None, assembly: bool = False, level: int = 2):
        """In place of `machine_code.object_code`."""
        target = target or machine_code.host()
        machine, passes, builder = machine_code._compiler(*target, level)
        module = llvm.parse_assembly(f'target triple = "{target[0]}"\n' + text, llvm.create_context())
        passes.run(module, builder)
        counted = llvm.parse_assembly(self._instrumented(str(module)), llvm.create_context())
        return machine.emit_object(counted)

    def _instrumented(self, text: str) -> str:
        lines, self.instructions, waiting = [], [], False
        for line in text.splitlines():
            begins = line.startswith("define") or (re.match(r'[\w.$"-]+:', line) is not None)
            if waiting and " = phi " not in line and line.strip() and not begins:
                at, number = len(self.instructions), f"%counted{len(self.instructions)}"
                place = f"getelementptr (i64, ptr @counts, i64 {at})"
                lines += [f"  {number} = load i64, ptr {place}", f"  {number}.1 = add i64 {number}, 1"]
                lines += [f"  store i64 {number}.1, ptr {place}"]
                self.instructions.append(0)
                waiting = False
            if begins:
                waiting = True
            lines.append(line)
            if self.instructions and ARITHMETIC.search(line):
                self.instructions[-1] += 1
        return "\n".join([*lines, f"@counts = global [{len(self.instructions)} x i64] zeroinitializer"])

    def load(self, code: bytes, names: tuple[str, ...]):
        """In place of `machine_code.load`."""
        library = LOAD(code, (*names, "counts"))
        self.libraries.append((library, list(self.instructions)))
        return library

    def take(self) -> int:
        """Instructions since the last time."""
        total = 0
        for library, instructions in self.libraries:
            counts = (ctypes.c_int64 * len(instructions)).from_address(library["counts"])
            total += sum(a * b for a, b in zip(counts, instructions, strict=True))
            ctypes.memset(counts, 0, 8 * len(instructions))
        return total


LOAD = machine_code.load


def counted(run) -> int:
    """Vector instructions of a run of a batch."""
    counter, kept = Counter(), (machine_code.object_code, kernel_cache.read, kernel_cache.write)
    machine_code.object_code, machine_code.load = counter.object_code, counter.load
    kernel_cache.read, kernel_cache.write = lambda entry: None, lambda entry, kernel: None
    try:
        again = run()
        again()
        counter.take()
        again()
        return counter.take()
    finally:
        machine_code.object_code, kernel_cache.read, kernel_cache.write = kept
        machine_code.load = LOAD


def of_a_step(solver) -> int:
    """Vector instructions of a step of heyoka."""
    with tempfile.NamedTemporaryFile(suffix=".o") as file:
        file.write(solver.llvm_state.object_code)
        file.flush()
        shown = subprocess.run(["objdump", "-d", "--no-show-raw-insn", file.name], capture_output=True, text=True, check=True)
    found, inside = 0, False
    for line in shown.stdout.splitlines():
        if line.endswith(">:"):
            inside = "<step>:" in line
        elif inside and ON_VECTORS.search(line):
            found += 1
    return found


def peak() -> float:
    """Products with sums on vectors in a second, of one thread."""
    width, chains = machine_code.vector_width(), 16
    kind = f"<{width} x double>"
    body = [f"%a{i} = phi {kind} [ zeroinitializer, %entry ], [ %b{i}, %loop ]" for i in range(chains)]
    body += ["%i = phi i64 [ 0, %entry ], [ %next, %loop ]"]
    body += [f"%b{i} = call {kind} @llvm.fma.v{width}f64({kind} %a{i}, {kind} %x, {kind} %x)" for i in range(chains)]
    body += ["%next = add i64 %i, 1", "%more = icmp slt i64 %next, %n", "br i1 %more, label %loop, label %out"]
    sums = [f"%s{i} = fadd {kind} {'%b0' if i == 0 else f'%s{i - 1}'}, %b{i}" for i in range(chains)]
    text = f"declare {kind} @llvm.fma.v{width}f64({kind}, {kind}, {kind})\n" + "\n".join(
        [
            "define void @run(ptr %p, i64 %n) {", "entry:", f"%x = load {kind}, ptr %p, align 8", "br label %loop", "loop:",
            *body, "out:", *sums, f"store {kind} %s{chains - 1}, ptr %p, align 8", "ret void", "}",
        ]
    )  # fmt: skip
    library = machine_code.load(machine_code.object_code(text), ("run",))
    run, n = machine_code.function(library, "run", ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int64)), 4_000_000
    numbers, best = np.full(width, 1e-3), 0.0
    for _ in range(REPEATS):
        begun = time.process_time()
        run(numbers.ctypes.data, n)
        best = max(best, chains * n / (time.process_time() - begun))
    return best


def main() -> None:
    """Print the table."""
    q, v, solvers, exact = beside_heyoka(TOLERANCES)
    start, system = np.concatenate([q, v], axis=1), dx.LagrangeDirac(henon_heiles)
    fastest, blocks = peak(), BATCH // SIDE_BY_SIDE
    print(f"peak: {fastest:.3g} vector instructions a second")
    rows: dict[str, list] = collections.defaultdict(list)
    runs = {}

    def prepared(scheme, n, more=1, system=system):
        return dx.prepare(system, scheme, q=q, v=v, step=END / n, steps=n * more, save_every=n * more)

    anew = lambda: dx.LagrangeDirac(lambda q, v: henon_heiles(q, v))  # what was compiled for `system` counts nothing
    instructions = {}
    for name, scheme, n in SETTINGS:
        label = f"{name}, {n} steps"
        runs[label] = prepared(scheme, n), prepared(scheme, n, 2)
        instructions[label] = counted(lambda of=(scheme, n, 1, anew()): prepared(*of)) / blocks
    for tolerance, solver in solvers.items():
        steps = [max(int(one[3]) for one in solver.propagate_res) for _ in propagated(solver, start)]
        label = f"heyoka, {tolerance:.0e}, order {solver.order}, {np.mean(steps):.0f} steps"
        instructions[label] = of_a_step(solver) * float(np.mean(steps))
        runs[label] = solver
    timed = lambda run: (lambda begun, kept: (time.process_time() - begun, kept))(time.process_time(), run())
    for _ in range(REPEATS):
        for label, run in runs.items():
            if isinstance(run, tuple):  # what a call costs besides is taken off
                (once, sol), (twice, _) = timed(run[0]), timed(run[1])
                rows[label].append((twice - once, once, np.max(np.abs(np.asarray(sol.q)[:, -1] - exact))))
            else:
                seconds, (_, ends) = timed(lambda run=run: taylor(run, start))
                rows[label].append((seconds, 0.0, np.max(np.abs(ends[:, :2] - exact))))
    print("| | error | vector instructions | µs | at the peak |\n|---|---|---|---|---|")
    for label, values in rows.items():
        seconds = float(np.median([value[0] for value in values]))
        least = instructions[label] / fastest / SIDE_BY_SIDE
        print(f"| {label} | {values[0][2]:.1e} | {instructions[label]:.3g} | {seconds / BATCH * 1e6:.1f} | {least * 1e6:.1f} |")


if __name__ == "__main__":
    main()
