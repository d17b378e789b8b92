"""sweep(): a study of many points into a store, gone on with by the same call.

sweep.py              the walk
axes.py, grid.py      the points, and how they are cut into tasks; arrange.py what the store holds and how large tasks are
case.py, keep.py      the functions of one point, called for many: columns.py in NumPy; energy.py the energy by compiled code
trial.py              a short run before: shapes, ways of calling, time of a trajectory
layout.py, commit.py  the arrays and files of the store, and how a task enters it; store.py made, held, grown
settle.py             which store a call goes on with: fingerprint.py whose it is
task.py, driver.py    a task, and all of them to their ends; queue.py those that wait, and how many make a call
executors.py          where they run: processes.py, worker.py those of dirax's own; ranks.py several processes that make one call
progress.py           how far it is
"""
