"""Measurements of speed and memory, stored as JSON in `benchmarks/results`; `python -m benchmarks` runs the short form."""
