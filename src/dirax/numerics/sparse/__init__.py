"""Sparse matrices: orders of elimination, colours of columns, and elimination itself."""
