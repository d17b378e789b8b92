"""`python -m dirax`: the program `dirax`."""

from dirax.cli import main

if __name__ == "__main__":
    main()
