"""The scalar program: a user's function traced once, and everything that is made of it.

user_functions.py     the user's callables, checked once
tracing.py            derivatives as one equation each; so roots.py, linear_solves.py, formula.py, all by primitives.py
interpreter.py        a jaxpr read as scalars, by rules/: one rule a JAX primitive
graph.py              the scalars: expressions built once; operations/ what each operation means, and its derivative
graph_derivatives.py  derivatives of expressions
scalar_program.py     a traced function as one object; evaluation/ its values in NumPy and in JAX
sparsity/             which results depend on which unknowns; sparse_equations.py Jacobians and solutions by it
memo.py               what is kept of all this, and let go by dx.clear_caches()
"""
