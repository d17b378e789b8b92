"""A run as one C file: the kernel, its initial record and parameters, and a main that prints the rows of the run."""

from pathlib import Path
from typing import Any

import jax
import numpy as np

from dirax.engines.contract import OK, Outcome, Problem, Progress
from dirax.engines.engine import AbstractEngine
from dirax.engines.native.c_code import c_code
from dirax.engines.native.collocation_kernels import collocation_kernels
from dirax.engines.native.engine import Native
from dirax.engines.native.kernels import Kernels, kernels
from dirax.engines.native.lanes import arrays_saved
from dirax.engines.native.loops.step_loop import kernel_module
from dirax.engines.sizes import sizes_of
from dirax.program import machine_code as llvm
from dirax.program.interpreter import UnsupportedPrimitive

PROGRAM = """\
/* {title}

   Written by dirax; needs nothing but a C compiler and its mathematical library:

       cc -O2 {fma}-ffp-contract=off -o run {name} -lm && ./run > rows.csv          (rows of dirax.simulate, bit by bit)
       ./run STEPS EVERY                                                  (as many steps, a row every EVERY of them)

   record[0] … record[{last_state}] is the state: {state}; the sizes by which unknowns are measured are those at this one.
   params: {params}.
   A program of one's own calls run(record, params, fields, 1, t0, h, 0, first, stop, every, iterations): steps first to stop − 1
   of a run that began at t0; fields point to the rows of {saved}. */

{code}
enum {{ SIZE = {size}, STATE = {state_size}, COMPLETED = {completed}, STATUS = {status}, FIELDS = {fields}, ROW = {row} }};
static double record[SIZE] = {{{record}}};
static double params[] = {{{values}}};
static const int64_t widths[FIELDS] = {{{widths}}}, is_node[FIELDS] = {{{nodes}}};
static const double t0 = {t0}, h = {h};

int main(int argc, char **argv) {{
    int64_t steps = argc > 1 ? atoll(argv[1]) : {steps}, every = argc > 2 ? atoll(argv[2]) : {every};
    if (steps < 1 || every < 1) {{ fprintf(stderr, "usage: %s [STEPS [EVERY]], whole numbers from 1 on\\n", argv[0]); return 2; }}
    if (every > steps) every = steps;
    int64_t rows = (steps + every - 1) / every + 1, completed, given;
    double closing[ROW], last[SIZE];
    void *fields[FIELDS], *ends[FIELDS];
    for (int64_t i = 0, at = 0; i < FIELDS; at += widths[i++]) {{
        fields[i] = malloc(sizeof(double) * (size_t)(rows * widths[i]));
        if (!fields[i]) {{ fprintf(stderr, "not enough memory for %lld rows\\n", (long long)rows); return 2; }}
        ends[i] = closing + at;
    }}
    run(record, params, fields, 1, t0, h, 0, 0, steps, every, {cap});
    completed = (int64_t)record[COMPLETED];
    memcpy(last, record, sizeof record);
    if (completed == steps) run(last, params, ends, 1, t0, h, 0, 0, 1, 1, {cap});
    printf("{header}\\n");
    given = completed == steps ? rows : (completed + every - 1) / every;
    for (int64_t row = 0; row < given; row++) {{
        int64_t number = row == rows - 1 ? steps : row * every;
        printf("%.17g", t0 + (double)number * h);
        for (int i = 0; i < FIELDS; i++) {{
            const double *from = row == rows - 1 ? ends[i] : (double *)fields[i] + row * widths[i];
            for (int64_t k = 0; k < widths[i]; k++) {{
                if (row == rows - 1 && !is_node[i]) printf(",nan");
                else printf(",%.17g", from[k]);
            }}
        }}
        printf("\\n");
    }}
    if (record[STATUS] != {ok}) fprintf(stderr, "step %lld failed\\n", (long long)(completed + 1));
    return record[STATUS] != {ok};
}}
"""


class WritesC(AbstractEngine):
    """The engine "native", which writes what it runs as a C file `path`, too.

    Takes one trajectory from initial data that are not two points, by a scheme whose kernel works on one node at a time.
    """

    path: str
    title: str = "A run of dirax"
    name = "native"

    def supports(self, problem: Problem) -> str | None:
        """As of "native"; None where there is a C file of it."""
        if problem.batch is not None or problem.first_step:
            return "a C file holds one trajectory that starts from q and v, q and p, or x"
        if collocation_kernels(problem.equation, problem.params, problem.batch_params) is not None:
            return "the kernel of a collocation scheme has its nodes side by side in vectors, which C has not"
        return Native().supports(problem)

    def run(self, problem: Problem, progress: Progress | None = None) -> Outcome:
        """Write the file, then run the problem. Raises `UnsupportedPrimitive`."""
        if reason := self.supports(problem):
            raise UnsupportedPrimitive("the run", f"is not written in C: {reason}", "dx.export_c")
        path = Path(self.path)
        path.write_text(c_program(problem, path.name, self.title), encoding="utf-8")
        return Native().run(problem, progress)

    def run_traced(self, problem: Problem) -> Outcome:
        """None: values that JAX traces are no numbers."""
        raise UnsupportedPrimitive("the run", "is not written in C: its numbers are traced by JAX", "dx.export_c")


def c_program(p: Problem, name: str, title: str) -> str:
    """The C file of a problem of one trajectory. Raises `UnsupportedPrimitive` for a kernel that C does not express."""
    made: Kernels = kernels(p.equation, p.params, p.batch_params, p.compensated)
    made.check()
    assert made.plan is not None
    record, saved, layout = made.record, arrays_saved(p, made), p.equation.stages[0][0].state_layout
    start = np.zeros(record.size)
    start[record.state] = p.state
    for stage, guess in enumerate(p.guess):
        start[record.unknowns(stage, np.shape(guess)[-1])] = guess
    record.put_sizes(start, sizes_of(p))
    values = made.step.parameters.flatten(p.params, None) if made.step.parameters.size else np.zeros(1)
    of = lambda numbers: ", ".join(float(x).hex() for x in np.ravel(numbers))
    columns = ["t", *(f"{s.name}{k}" for s in saved for k in range(s.size))]
    return PROGRAM.format(
        title=title,
        name=name,
        fma="-mfma " * llvm.has_fma(),
        code=c_code(kernel_module(made.plan, 1, llvm.has_fma(), groups=False)),
        last_state=record.state_size - 1,
        state_size=record.state_size,
        state=", ".join(f"{part} {shape}" for part, shape in layout.items()),
        params=_names(p.params),
        saved=", ".join(s.name for s in saved),
        size=record.size,
        completed=record.completed,
        status=record.status,
        fields=len(saved),
        row=sum(s.size for s in saved),
        record=of(start),
        values=of(values),
        widths=", ".join(str(s.size) for s in saved),
        nodes=", ".join(str(int(not s.ends_before)) for s in saved),
        t0=float(p.t0).hex(),
        h=float(p.h).hex(),
        steps=p.steps,
        every=p.save_every,
        cap=p.max_iterations,
        header=",".join(columns),
        ok=OK,
    )


def _names(params: Any) -> str:
    """The entries of params in their order, with those that are no floats, which are built in."""
    found = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        kind = "" if np.issubdtype(np.asarray(leaf).dtype, np.floating) else " (built in)"
        found.append(f"{jax.tree_util.keystr(path)}{np.shape(leaf) or ''}{kind}")
    return ", ".join(found) or "none"
