"""The xla engine: jitted steps on arrays, on any device; the oracle.

newton.py, dense.py   one equation solved, its linear equations; derivatives by the implicit function theorem
lane.py               one step of one trajectory, and what it carries
loop.py               many steps of all trajectories as one compiled function, and the rows saved on the way
engine.py             the run: chunks from the host, or one scan under a transformation
"""

from dirax.engines.xla.dense import Dense
from dirax.engines.xla.engine import Xla

__all__ = ["Dense", "Xla"]
