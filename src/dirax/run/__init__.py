"""simulate(): validate → discretize → start → engine → Solution.

simulate.py           the walk
validate.py           the form of the arguments
start.py              complete initial data, the first state; refused_start.py the errors for data off a constraint
redundancy.py         constraints that follow from others; final_manifold.py the hidden ones of a singular Lagrangian
result.py             rows, times and messages; failure_messages.py why a trajectory ended (its rows: engines/contract.py)
"""
