"""The xla engine: jitted steps on arrays, on any device; the oracle."""

from dirax.engines.xla.engine import first_lane, run, run_traced, take_step, unpacked_rows

__all__ = ["first_lane", "run", "run_traced", "take_step", "unpacked_rows"]
