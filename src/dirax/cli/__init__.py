"""The program `dirax`: `main` prepares the terminal and hands over to the commands."""

import atexit
import gc

ALLOCATED = 200_000
"""Objects that are made until Python looks for cycles among them: a run makes a million that are in none, and to look at all
that JAX has loaded takes a tenth of a second each time."""


def main() -> None:
    """The entry point of the program `dirax`."""
    gc.set_threshold(ALLOCATED)
    atexit.register(gc.freeze)  # else Python looks through all that was loaded once more before it ends, for .4 s
    from dirax.cli.terminal import interruptible, prepared, written

    with interruptible():
        prepared()
        from dirax.cli.commands import app

        with written():
            app(prog_name="dirax")
