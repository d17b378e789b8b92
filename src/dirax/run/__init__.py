"""simulate(): validate → discretize → start → engine → Solution; prepare(): the same, again and again with other numbers.

simulate.py, prepare.py   what a user calls; settings.py, validate.py, scalars.py their form
carry_out.py              the walk, and what goes on with it; traced_run.py the same under JAX's transformations
plan.py, batch_plan.py    the short way of a run, or of a batch, of a kind that is known; premises.py what both ask
step_search.py            tolerance= in place of step=
start.py                  complete initial data, the first state; refused_start.py the errors for data off a constraint
redundancy.py             constraints that follow from others; final_manifold.py the hidden ones of a singular Lagrangian
event.py, impact.py       what a user states; event_run.py the run with both
event_search.py …         zeros in steps: event_scan.py which steps, dips.py where; event_traced.py, event_on_host.py under JAX
impact_run.py …           bounces: flight.py one trajectory, made by flights.py, impact_search.py the next wall
impact_on_host.py …       the same under JAX: flown_parts.py what the host finds, step_parts.py what is differentiated;
                          impact_traced.py where the host cannot
streaming.py              rows that go to the disk while the run goes on
result.py                 rows, times and messages; failure_messages.py why a trajectory ended (its rows: engines/contract.py)
export_c.py               a run as a C file
"""
