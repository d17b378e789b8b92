"""export_c(): a run as a C file that depends on nothing."""

from pathlib import Path
from typing import Any

from dirax.program.interpreter import UnsupportedPrimitive
from dirax.run.simulate import simulate
from dirax.schemes.step import AbstractScheme
from dirax.solution.atomic_files import checked_place, written
from dirax.solution.solution import Solution
from dirax.systems.system import AbstractSystem


def export_c(path: Any, system: AbstractSystem, scheme: AbstractScheme, title: str = "", **settings: Any) -> Solution:
    """Write the run of `scheme` on `system` as one C file, which needs a C compiler and nothing else, and return the Solution.

    `settings` are those of `dx.simulate`: initial data, params, step, steps, save_every. The file says how it is compiled; its
    `main` prints the rows of the run, t and every saved array, with the bits of the Solution. Initial state and parameters are
    arrays in it, and `run` can be called by a program of one's own. Of a batch, the rows of one trajectory stand after those of
    another, each behind its number. A start from two points is not written, nor events and walls, nor a run by collocation in
    which the fixed-point iteration of the stages does not converge. Raises what `dx.simulate` raises, `ValueError` for these and
    for another engine than the native one, whose code it is, and `OSError` where the file cannot be written.

        dx.export_c("disk.c", system, dx.LagrangeDAlembert(), q=q, v=v, step=0.01, steps=1000)
    """
    from dirax.engines.native.c_program import WritesC  # the compiler is there where its engine is used

    file = Path(path)
    if file.suffix != ".c":
        raise ValueError(f"path must end in .c, but it is {str(path)!r}.")
    if (engine := settings.pop("engine", "native")) not in ("auto", "native"):
        raise ValueError(f'engine must be "native", whose code is written, but {engine!r:.80} was given: leave it out.')
    if settings.get("events"):
        raise ValueError(
            "events and walls are not written as C, where nothing looks for them: leave events= out, or run with dx.simulate."
        )
    checked_place(file, True)
    try:
        with written(file):
            return simulate(system, scheme, **settings, engine=WritesC(str(file), title or type(system).__name__))
    except UnsupportedPrimitive as error:
        raise ValueError(f"this run cannot be written as C: {error.primitive} {error.reason}.") from error
