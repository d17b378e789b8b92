"""A run as one C file: the kernel, its initial record and parameters, and a main that prints the rows of the run."""

from pathlib import Path
from typing import Any

import jax
import numpy as np

from dirax.engines.contract import OK, Outcome, Problem, Progress
from dirax.engines.engine import AbstractEngine
from dirax.engines.native.c_code import c_code
from dirax.engines.native.collocation_kernels import CollocationKernels, collocation_kernels
from dirax.engines.native.engine import Native
from dirax.engines.native.ir.scalars import scalars
from dirax.engines.native.kernels import Kernels, kernels
from dirax.engines.native.lanes import arrays_saved
from dirax.engines.native.loops.collocation_loop import collocation_module
from dirax.engines.native.loops.step_loop import kernel_module
from dirax.engines.native.shared import shared_module
from dirax.engines.sizes import sizes_of
from dirax.program import machine_code as llvm
from dirax.program.interpreter import UnsupportedPrimitive
from dirax.schemes.step import CLOCK

PROGRAM = """\
/* {title}

   Written by dirax; needs nothing but a C compiler and its mathematical library:

       cc -O2 {fma}-ffp-contract=off -o run {name} -lm && ./run > rows.csv          (rows of dirax.simulate, bit by bit)
       ./run STEPS EVERY                                                  (as many steps, a row every EVERY of them)

   A record for each trajectory, of which there are {lanes}: its first {state_size} numbers are the state, {state};
   the sizes by which unknowns are measured are those at this one. Its params: {params}.
   A program of one's own calls run(record, params, fields, 1, t0, h, 0, first, stop, every, iterations): steps first to stop − 1
   of a run that began at t0; fields point to the rows of {saved}. */

{code}
enum {{ LANES = {lanes}, SIZE = {size}, PARAMS = {parameters}, COMPLETED = {completed}, STATUS = {status} }};
enum {{ FIELDS = {fields}, ROW = {row} }};
static double records[LANES][SIZE] = {{
{record}
}};
static double params[LANES][PARAMS] = {{
{values}
}};
static const int64_t widths[FIELDS] = {{{widths}}}, is_node[FIELDS] = {{{nodes}}};
static const double t0 = {t0}, h = {h};

static int trajectory(int64_t lane, int64_t steps, int64_t every) {{
    int64_t rows = (steps + every - 1) / every + 1, completed, given;
    double closing[ROW], last[SIZE], *record = records[lane];
    void *fields[FIELDS], *ends[FIELDS];
    for (int64_t i = 0, at = 0; i < FIELDS; at += widths[i++]) {{
        fields[i] = malloc(sizeof(double) * (size_t)(rows * widths[i] + 1));
        if (!fields[i]) {{ fprintf(stderr, "not enough memory for %lld rows\\n", (long long)rows); exit(2); }}
        ends[i] = closing + at;
    }}
    run(record, params[lane], fields, 1, t0, h, 0, 0, steps, every, {cap});
    completed = (int64_t)record[COMPLETED];
    memcpy(last, record, sizeof last);
    if (completed == steps) run(last, params[lane], ends, 1, t0, h, 0, 0, 1, 1, {cap});
    given = completed == steps ? rows : (completed + every - 1) / every;
    for (int64_t row = 0; row < given; row++) {{
        double t = {time};
        {lane}printf("%.17g", t);
        for (int i = 0; i < FIELDS; i++) {{
            const double *from = row == rows - 1 ? ends[i] : (double *)fields[i] + row * widths[i];
            for (int64_t k = 0; k < widths[i]; k++) {{
                if (row == rows - 1 && !is_node[i]) printf(",nan");
                else printf(",%.17g", from[k]);
            }}
        }}
        printf("\\n");
    }}
    for (int64_t i = 0; i < FIELDS; i++) free(fields[i]);
    if (record[STATUS] == {ok}) return 0;
    fprintf(stderr, "trajectory %lld: step %lld failed\\n", (long long)lane, (long long)(completed + 1));
    return 1;
}}

int main(int argc, char **argv) {{
    int64_t steps = argc > 1 ? atoll(argv[1]) : {steps}, every = argc > 2 ? atoll(argv[2]) : {every};
    int failed = 0;
    if (steps < 1 || every < 1) {{ fprintf(stderr, "usage: %s [STEPS [EVERY]], whole numbers from 1 on\\n", argv[0]); return 2; }}
    printf("{header}\\n");
    for (int64_t lane = 0; lane < LANES; lane++) failed |= trajectory(lane, steps, every > steps ? steps : every);
    return failed;
}}
"""


class WritesC(AbstractEngine):
    """The engine "native", which writes what it runs as a C file `path`, too.

    Takes what "native" takes, from initial data that are not two points. Of collocation it is the fixed-point iteration that is
    written: a run in which that does not converge, for which "native" has Newton's method, is refused after it.
    """

    path: str
    title: str = "A run of dirax"
    name = "native"

    def supports(self, problem: Problem) -> str | None:
        """As of "native"; None where there is a C file of it."""
        if problem.first_step:
            return "a C file starts from q and v, q and p, or x"
        return Native().supports(problem)

    def run(self, problem: Problem, progress: Progress | None = None) -> Outcome:
        """Write the file, then run the problem. Raises `UnsupportedPrimitive`."""
        if reason := self.supports(problem):
            raise UnsupportedPrimitive("the run", f"is not written in C: {reason}", "dx.export_c")
        path = Path(self.path)
        text = c_program(problem, path.name, self.title)
        outcome = Native().run(problem, progress)
        if isinstance(_kernels_of(problem), CollocationKernels) and outcome.record is None and not outcome.interrupted:
            raise UnsupportedPrimitive(
                "the run", "is not written in C: the fixed-point iteration of its stages does not converge", "dx.export_c"
            )
        path.write_text(text, encoding="utf-8")
        return outcome

    def run_traced(self, problem: Problem) -> Outcome:
        """None: values that JAX traces are no numbers."""
        raise UnsupportedPrimitive("the run", "is not written in C: its numbers are traced by JAX", "dx.export_c")


def _kernels_of(p: Problem) -> Kernels | CollocationKernels:
    """The kernels by which "native" runs a problem."""
    found = collocation_kernels(p.equation, p.params, p.batch_params)
    return found or kernels(p.equation, p.params, p.batch_params, p.compensated)


def c_program(p: Problem, name: str, title: str) -> str:
    """The C file of a problem. Raises `UnsupportedPrimitive` for a kernel that C does not express."""
    made, lanes, fma = _kernels_of(p), p.batch or 1, llvm.has_fma()
    record, saved, layout = made.record, arrays_saved(p, made), p.equation.stages[0][0].state_layout
    start = np.zeros((lanes, record.size))
    start[:, record.state] = p.state
    for stage, guess in enumerate(p.guess):
        start[:, record.unknowns(stage, np.shape(guess)[-1])] = guess
    if isinstance(made, CollocationKernels):  # a fixed point finds its own sizes
        module = scalars(collocation_module(made.plan, 1, fma))
    else:
        made.check()
        assert made.plan is not None
        record.put_sizes(start, [np.reshape(sizes, (lanes, -1)) for sizes in sizes_of(p)])
        module = kernel_module(made.plan, 1, fma, groups=False)
    values = made.step.parameters.flatten(p.params, p.batch if p.batch_params else None)
    values = np.broadcast_to(values, (lanes, values.shape[-1])) if values.size else np.zeros((lanes, 1))
    listed = lambda table: ",\n".join("{" + ", ".join(float(x).hex() for x in row) + "}" for row in table)
    time = "t0 + (double)(row == rows - 1 ? steps : row * every) * h"
    if CLOCK in (names := [s.name for s in saved]):  # steps have lengths of their own
        clock = names.index(CLOCK)
        time = f"row == rows - 1 ? *(double *)ends[{clock}] : ((double *)fields[{clock}])[row]"
    columns = [*(["trajectory"] if p.batch else []), "t", *(f"{s.name}{k}" for s in saved for k in range(s.size))]
    return PROGRAM.format(
        title=title.replace("*/", "* /"),
        name=name,
        fma="-mfma " * fma,
        code=c_code(shared_module(fma) + module),
        lanes=lanes,
        lane='printf("%lld,", (long long)lane); ' if p.batch else "",
        parameters=values.shape[-1],
        state_size=record.state_size,
        state=", ".join(f"{part} {shape}" for part, shape in layout.items()),
        params=_names(p.params),
        saved=", ".join(s.name for s in saved),
        size=record.size,
        completed=record.completed,
        status=record.status,
        time=time,
        fields=len(saved),
        row=sum(s.size for s in saved),
        record=listed(start),
        values=listed(values),
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
