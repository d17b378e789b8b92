"""The program `dirax`: `main` prepares the terminal and hands over to the commands."""


def main() -> None:
    """The entry point of the program `dirax`."""
    from dirax.cli.terminal import interruptible, prepared, written

    with interruptible():
        prepared()
        from dirax.cli.commands import app

        with written():
            app(prog_name="dirax")
