"""Geometry without mechanics: Dirac structures, manifolds, discretization maps.

linear.py             one Dirac structure on one vector space; subspaces.py, representations.py, scattering.py what it is made of
structures.py         Dirac structures on manifolds; discrete.py, finite_difference.py, generating_functions.py the discrete ones
spaces.py, products.py    manifolds; lie_group.py, lie_groups.py the groups among them; manifolds.py, charts.py what all have
maps.py               discretization maps; cotangent_lift.py, projected_map.py, map_report.py
tulczyjew.py          the Tulczyjew triples, continuous and discrete
"""
