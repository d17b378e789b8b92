"""simulate(): validate → discretize → start → engine → Solution; prepare(): the same, again and again with other numbers.

simulate.py, prepare.py   what a user calls; settings.py and validate.py the form of the arguments
carry_out.py              the walk, and what goes on with it; plan.py the short way of a run of a kind that is known
step_search.py            tolerance= in place of step=
start.py                  complete initial data, the first state; refused_start.py the errors for data off a constraint
redundancy.py             constraints that follow from others; final_manifold.py the hidden ones of a singular Lagrangian
result.py                 rows, times and messages; failure_messages.py why a trajectory ended (its rows: engines/contract.py)
"""
