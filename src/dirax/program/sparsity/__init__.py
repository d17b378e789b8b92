"""Which results of a function depend on which of its unknowns: index sets through the jaxpr, an array of them at a time.

The set of every entry of an array is a row of one sparse matrix of booleans. What moves entries about takes rows, what computes
entry by entry unites them, a sum is a product of matrices. Entries that are zero whatever the unknowns are followed too, so that
a matrix of zeros with some entries is as sparse as it looks. Nothing is found by trying values: a set can be too large and
never too small.

walk.py         the jaxpr, primitive by primitive
movement.py     what moves entries; arithmetic.py what computes with them
values.py       what is known of an array, and when it is too much
"""

from dirax.program.sparsity.values import Dense
from dirax.program.sparsity.walk import pattern_of

__all__ = ["Dense", "pattern_of"]
