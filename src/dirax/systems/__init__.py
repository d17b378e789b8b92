"""Systems as the user states them, without a time step.

system.py             AbstractSystem: what a system says of itself; forms.py, implicit_form.py the forms it shows itself in
lagrange_dirac.py     and a file for every other kind of system
constraints.py        constraints on velocities and holonomic ones
magnitudes.py         how large what is zero up to a rounding counts as, where a defect is compared with its terms
constraint_algorithm.py, constraint_chain.py    the final constraint manifold
interconnection.py    systems joined at their ports
"""
