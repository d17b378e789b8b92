"""Random Lagrangian systems with every kind of constraint, run by every scheme and examined: `python -m fuzz 100` (from tests)."""
