"""Sparse matrices: orders of elimination, colours of columns, and elimination itself."""

FEWEST_SPARSE = 128
"""Unknowns from which on equations around a run are solved by sparse elimination, where they are sparse and regular."""
