"""A small study for the tests, and what is run in processes of its own: the study, a scheduler of dask, its worker."""

import json
import os
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import dirax as dx

SYSTEM = dx.LagrangeDirac(
    lambda q, v, params: (
        v[0] ** 2 + v[1] ** 2 / 2 + v[0] * v[1] * jnp.cos(q[0] - q[1]) + params["g"] * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))
    )
)
LONG = {"steps": 20_000, "save_every": 5000, "task_seconds": 0.05}
"""With these, 240 points take about half a second of one processor, in some thirty tasks."""

OVER = {"g": np.linspace(0.5, 2.0, 12), "angle": np.linspace(0.0, 3.0, 20)}


FEW = {name: values[:6] for name, values in OVER.items()}
BY_XLA = {"engine": "xla", "steps": 20, "task_seconds": 1e-6}
"""A study of 36 points in six tasks, if `DEVICE_BATCH` is 6."""


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
    """The long study: here, in so many processes, or in the cluster of an address."""
    if how.startswith("tcp"):
        from distributed import Client

        with Client(how, timeout=30) as client:
            study(to, executor=client, **LONG)
    else:
        study(to, executor=None if how == "here" else int(how), **LONG)


def scheduler(address):
    """A scheduler of dask, which writes where it is into a file."""
    from distributed.cli.dask_scheduler import main

    main(["--port", "0", "--no-dashboard", "--scheduler-file", str(address)])


def dask_worker(address):
    """A worker of two threads for the scheduler that writes, or has written, such a file."""
    from distributed.cli.dask_worker import main

    main(["--scheduler-file", str(address), "--nthreads", "2", "--no-dashboard", "--no-nanny"])


def one_of_two(number, port, folder):
    """The process of this number of two of `jax.distributed`, each with two devices: a study by either engine, and one that the
    first process refuses. Prints on which devices it ran which blocks."""
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    import jax

    from dirax.sweeps import arrange, executors, trial

    jax.distributed.initialize(f"127.0.0.1:{port}", num_processes=2, process_id=number)
    arrange.DEVICE_BATCH = trial.POINTS = 6  # one shape, which is compiled once a device
    ran, plain = [], executors.run_task

    def noting(plan, task, *given):
        ran.append((plan.folder.stem, str(jax.config.jax_default_device), task.index))
        return plain(plan, task, *given)

    executors.run_task = noting
    study(folder / "xla.zarr", FEW, **BY_XLA)
    data = study(folder / "native.zarr")
    assert (data.status == 1).all()  # when it returns the others are done, too
    print(json.dumps(ran), flush=True)
    try:
        study(folder / "native.zarr", step=0.02)
    except (OSError, ValueError) as error:
        print(error, flush=True)


def called(words, function, *arguments):
    """Call a function with everything that is said on standard error in a file."""
    with open(words, "w") as file:
        os.dup2(file.fileno(), 2)
    os.dup2(2, 1)
    function(*arguments)
