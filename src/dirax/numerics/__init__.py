"""Decisions about floating-point numbers, each once: what every room above measures by.

tolerances.py         every threshold, with its reason
ranks.py              the rank of a matrix; equilibration.py its units
newton.py             Newton's method around a run (in the steps: engines/stopping.py; of traced functions: program/roots.py)
loops/                loops over arrays in Python, compiled by LLVM; sparse/ sparse matrices by them
arrays.py             the kinds of arrays that signatures name
"""
