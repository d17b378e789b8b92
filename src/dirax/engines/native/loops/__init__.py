"""The loops of a run as LLVM IR.

plan.py               what is computed where: once, a step, a Newton update
step_loop.py          rows, steps and stages; stage.py one stage; record.py what is carried between them
newton_loop.py        the iteration; ../../newton_step.py one update; dense.py its linear equations with pivoting
collocation_*.py      the same for stages in lanes
"""
