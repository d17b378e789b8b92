"""The program `dirax`: `main` prepares the terminal and hands over to the commands."""


@app.command()
@with_messages
def cache(
    clear: Annotated[bool, typer.Option("--clear", help="remove all kernels")] = False,
    as_json: Json = False,
) -> None:
    """Show the compiled kernels that are kept on the disk: where, how many, how large; or remove them."""
    from dirax.cli.cache import cleared, described, sentence

    found = cleared() if clear else described()
    if as_json:
        show_json(found)
    else:
        typer.echo(sentence(found))


def main() -> None:
    """The entry point of the program `dirax`."""
    from dirax.cli.terminal import interruptible, prepared, written

    with interruptible():
        prepared()
        from dirax.cli.commands import app

        with written():
            app(prog_name="dirax")
