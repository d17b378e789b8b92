"""Random Lagrangian systems with every kind of constraint, run by every scheme and examined: `make fuzz`."""
