"""The speed of dirax beside other programs: what is timed, the others, and the table of ratios."""
