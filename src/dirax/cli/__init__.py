"""The program `dirax`: `main` prepares the terminal and hands over to the commands."""


def main() -> None:
    """The entry point of the program `dirax`."""
    from dirax.cli.terminal import flushed, interruptible, prepared

    with interruptible():
        prepared()
        from dirax.cli.commands import app

        try:
            app(prog_name="dirax")
        finally:
            flushed()
