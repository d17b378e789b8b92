"""Loops over arrays that have to be quick: written in Python, compiled by LLVM, called from NumPy and from JAX."""
