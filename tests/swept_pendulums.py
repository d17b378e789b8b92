"""A small study for the tests, also as a program of its own: `python pendulums.py STORE EXECUTOR`."""

import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import dirax as dx

SYSTEM = dx.LagrangeDirac(
    lambda q, v, params: (
        v[0] ** 2 + v[1] ** 2 / 2 + v[0] * v[1] * jnp.cos(q[0] - q[1]) + params["g"] * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))
    )
)
OVER = {"g": np.linspace(0.5, 2.0, 12), "angle": np.linspace(0.0, 3.0, 20)}


def case(g, angle):
    return {"q": [angle, 0.0], "v": [0.0, 0.0], "params": {"g": g}}


def study(to, over=OVER, **changes):
    """A sweep of 240 points in small tasks."""
    settings = {"case": case, "step": 0.01, "steps": 200, "save_every": 50, "task_seconds": 0.002, "progress": False}
    return dx.sweep(SYSTEM, dx.LagrangeDAlembert(), over=over, to=to, **{**settings, **changes})


def single(g, angle, **changes):
    """The run of one point by itself."""
    settings = {"step": 0.01, "steps": 200, "save_every": 50} | changes
    return dx.simulate(SYSTEM, dx.LagrangeDAlembert(), **case(g, angle), **settings)


def same(a, b):
    """Whether two datasets have the same bits."""
    assert a.data_vars.keys() == b.data_vars.keys()
    return all(
        np.array_equal(a[name].values, b[name].values, equal_nan=a[name].dtype.kind == "f") for name in (*a.data_vars, *a.coords)
    )


def files(path):
    """All files of a store, by their place in it."""
    return {file.relative_to(path).as_posix() for file in Path(path).rglob("*") if file.is_file()}


def main(to, how):
    long = {"steps": 40_000, "save_every": 10_000, "task_seconds": 0.1}
    if how.startswith("tcp"):
        from distributed import Client

        with Client(how, timeout=30) as client:
            study(to, executor=client, **long)
    else:
        study(to, executor=None if how == "here" else int(how), **long)


if __name__ == "__main__":
    main(*sys.argv[1:])
