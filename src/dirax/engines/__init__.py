"""Engines: what runs the steps of a StepEquation. One package each, one line in policy.py.

engine.py, contract.py     what an engine is asked, what it gives back, and what a failed trajectory's rows hold
policy.py             which engine takes what, and every number that decides
stopping.py           when Newton's method stops
native/               machine code for small systems; xla/ arrays on any device; sparse/ large ones; auto.py chooses
step_program.py       a step as one scalar program; in_jax.py that program for JAX
"""
