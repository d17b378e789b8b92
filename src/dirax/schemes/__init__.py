"""Schemes: from a system to the equation of one step.

step.py               StepEquation, the hub; abstract_step.py the same as a class, layout.py its named parts
lagrange_dirac.py     (+), (−) and Lagrange–d'Alembert; discrete_lagrangian.py the midpoint rule and its like
discrete_dirac.py     Methods 1 and 2 of [BLM] by any discretization map
discrete_gradient.py, collocation.py, euler_poincare.py, routh.py, in_charts.py, composition.py    the other schemes
*_step.py             the equations of one step of each
*_premise.py          what must hold where a run begins, and refuses it otherwise
discrete_structure.py what the steps of a scheme satisfy, as `dx.verify` measures it
discrete_constraints.py    the constraint algorithm for difference equations
"""
