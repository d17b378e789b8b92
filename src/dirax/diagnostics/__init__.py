"""Whether the structure is there: measured on trajectories.

verify.py             dx.verify; report.py the table it gives, verdicts.py how a value becomes a line
*_lines.py            the lines, a file a subject
replay*.py, other_solutions.py   every row from the one before, and what a step of several solutions may have found
convergence.py, compare.py, drift.py    orders, schemes side by side, long runs
bench/                beside other programs
"""
