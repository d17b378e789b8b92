"""Reduction by symmetry: from a system to the one on the quotient.

reduce.py             dx.reduce; reduced.py the systems it gives, euler_poincare.py and lie_poisson.py those on a Lie algebra
actions.py            group actions and momentum maps; symmetry.py the search for them; coordinates.py where they are translations
connection.py         discrete connections; trivializations.py and dirac.py the trivializations and reduced structures of [RL]
stages.py             a quotient reduced again
"""
