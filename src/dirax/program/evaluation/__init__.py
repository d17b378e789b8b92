"""Values of the scalar program: in_numpy.py at once, by_jax.py inside a traced function, functions.py of the user's functions."""
