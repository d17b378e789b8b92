"""Sweeps: the same bits as single runs, gone on with, grown, refused; what is wrong at a point is said with the point."""

import errno
import json
import os
import socket
import threading
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import dirax as dx
import swept_pendulums
from dirax.solution.fingerprint import of_code
from dirax.solution.flushed_files import Hold
from dirax.solution.stored import TYPES
from dirax.sweeps import arrange, commit, executors, store, sweep, task, trial
from dirax.sweeps.case import Case
from dirax.sweeps.grid import cut
from dirax.sweeps.layout import decoded_texts, encoded_texts
from dirax.sweeps.queue import Queue
from swept_pendulums import OVER, SYSTEM, case, files, same, single, study


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """The finished study, and where it is."""
    path = tmp_path_factory.mktemp("done") / "study.zarr"
    return study(path), path


@pytest.fixture
def ran(monkeypatch):
    """The numbers of trajectories of the tasks that are run."""
    found = []

    def counting(plan, given, stopping=None):
        found.append(given.points)
        return task.run_task(plan, given, stopping)

    monkeypatch.setattr(executors, "run_task", counting)
    return found


# ------------------------------------------------------------------ what comes out


@pytest.mark.soak
def test_every_point_has_the_bits_of_a_run_by_itself(done):
    data, _ = done
    assert dict(data.sizes) == {"g": 12, "angle": 20, "time": 5, "coordinate": 2}
    for i, j in ((0, 0), (5, 7), (11, 19), (3, 18)):
        sol = single(OVER["g"][i], OVER["angle"][j])
        assert np.array_equal(data.q.values[i, j], sol.q) and np.array_equal(data.p.values[i, j], sol.p)
        assert np.array_equal(data.time.values, sol.t)
    assert np.all(data.status == 1) and not np.any(data.message.values != "")
    assert np.array_equal(data.g, OVER["g"]) and np.array_equal(data.angle, OVER["angle"])
    assert data.attrs["scheme"] == repr(dx.LagrangeDAlembert()) and data.attrs["step"] == 0.01


def test_rows_of_constraints_have_the_name_that_files_give_them(tmp_path):
    """Every task of a scheme that saves `constraint` failed: it is `constraint_residual` in a store."""
    one_form = lambda q: jnp.array([[jnp.sin(q[2]), -jnp.cos(q[2]), 0.0]])
    skate = dx.LagrangeDirac(lambda q, v, g: v @ v / 2 - g * q[0], one_form)
    begun = lambda g: {"q": [0.0, 0.0, 0.0], "v": [0.0, 0.0, 1.0], "params": g}
    run = {"step": 0.02, "steps": 21, "save_every": 4}
    data = dx.sweep(skate, dx.LagrangeDAlembert(), over={"g": [0.5, 2.0]}, case=begun, to=tmp_path / "skate.zarr", **run)
    sol = dx.simulate(skate, dx.LagrangeDAlembert(), **begun(2.0), **run)
    assert np.all(data.status == 1) and np.array_equal(data.constraint_residual.values[1], sol.constraint)
    assert np.array_equal(data.multipliers.values[1], sol.multipliers)


@pytest.mark.soak
def test_any_zarr_library_opens_the_store_and_so_does_load(done):
    data, path = done
    assert same(data, xr.open_zarr(path, consolidated=None)) and same(data, dx.load(path))
    assert ".unfinished" not in {name.split("/")[0] for name in files(path)}


@pytest.mark.parametrize("changes", [{"task_seconds": 1e-6}, {"task_seconds": 10.0}, {"executor": ThreadPoolExecutor(2)}])
@pytest.mark.soak_of(but=["changes2"])
def test_bits_do_not_depend_on_the_size_of_tasks_or_where_they_run(done, tmp_path, changes):
    assert same(done[0], study(tmp_path / "other.zarr", **changes))


def test_processes_in_place_of_a_pool_that_would_fork_give_the_same_bits(done, tmp_path):
    with ProcessPoolExecutor(2) as pool:
        assert same(done[0], study(tmp_path / "pool.zarr", executor=pool))
        assert not pool._processes


@pytest.fixture
def cluster():
    """A cluster of dask in threads of this process."""
    distributed = pytest.importorskip("distributed")
    with distributed.Client(processes=False, n_workers=1, threads_per_worker=2, dashboard_address=None) as client:
        yield client


def test_a_cluster_of_dask_gives_the_same_bits_in_fewer_calls_than_tasks(done, tmp_path, cluster, monkeypatch):
    calls, taken = [], Queue.taken

    def noting(queue, *given):
        calls.append(taken(queue, *given))
        return calls[-1]

    monkeypatch.setattr(Queue, "taken", noting)
    monkeypatch.setattr(arrange, "TASKS_PER_SLOT", 30)
    assert same(done[0], study(tmp_path / "dask.zarr", executor="dask", task_seconds=1e-6))
    tasks = len(list((tmp_path / "dask.zarr").glob("status/c.*")))
    assert sum(map(len, calls)) == tasks and len(calls) < tasks
    assert same(done[0], study(tmp_path / "client.zarr", executor=cluster))


@pytest.mark.soak
def test_without_a_client_dask_gets_a_cluster_of_its_own(done, tmp_path):
    pytest.importorskip("distributed")
    assert same(done[0], study(tmp_path / "dask.zarr", executor="dask"))


def test_what_a_worker_finished_before_it_died_is_not_run_again(done, tmp_path):
    path = tmp_path / "study.zarr"
    study(path)
    layout, axes = store.layout_of(path), store.axes_of(path)
    left = sweep._task(axes, layout.grid, next(iter(layout.grid)), None)
    plan = SimpleNamespace(folder=path, layout=layout)  # with nothing to run
    found = task.finished(plan, left)
    assert found.ok == left.points and found.failed == found.refused == 0
    (path / layout.file("status", left.index)).unlink()
    assert task.finished(plan, left) is None


def test_what_fails_in_a_call_is_tried_alone_and_the_rest_together():
    tasks = list(range(40))
    waiting = Queue(tasks)
    assert waiting.taken(1.0, 2) == [0]  # nothing is known of their time
    waiting.took(0.1)
    assert waiting.taken(1.0, 2) == list(range(1, 10)) and waiting.taken(0.0, 2) == [10]
    waiting.put_alone([1, 2])
    waiting.put_back([10])
    rest = []
    while waiting:
        rest.append(waiting.taken(0.5, 2))
    assert rest[0] == [10, 11, 12, 13, 14] and rest[-2:] == [[1], [2]]
    assert sorted(task for call in rest for task in call) == [1, 2, *range(10, 40)]


def test_units_and_names_of_coordinates(tmp_path):
    units = {"angle": "rad", "q": ["rad", "rad"], "t": "s"}
    data = study(tmp_path / "units.zarr", {"g": [1.0], "angle": [0.1, 0.2]}, units=units, coordinates=["θ1", "θ2"])
    assert data.angle.attrs["units"] == "rad" and data.q.attrs["units"] == "rad" and data.time.attrs["units"] == "s"
    assert data.coordinate.values.tolist() == ["θ1", "θ2"]


def test_axes_side_by_side(tmp_path):
    data = study(tmp_path / "pairs.zarr", {"g": [0.5, 1.0, 2.0], "angle": [1.0, 2.0, 3.0]}, zip=True)
    assert data.q.dims == ("point", "time", "coordinate") and data.angle.dims == ("point",)
    assert np.array_equal(data.q.values[1], single(1.0, 2.0).q)


def test_a_system_of_the_xla_engine_one_batch_a_device(tmp_path):
    over = {"g": OVER["g"][:3], "angle": OVER["angle"][:3]}
    data = study(tmp_path / "xla.zarr", over, engine="xla", steps=20)
    one = single(over["g"][1], over["angle"][2], steps=20, engine="xla")
    assert (
        np.allclose(data.q.values[1, 2, -1], one.q[-1], rtol=1e-12, atol=1e-14)
        and json.loads(data.fingerprint)["engine"] == "xla"
    )


@pytest.mark.soak
def test_processes_of_jax_distributed_share_the_tasks_of_one_store(done, tmp_path, forked, monkeypatch):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = [tmp_path / f"words{number}.txt" for number in (0, 1)]
    both = [forked(swept_pendulums.one_of_two, n, port, tmp_path, words=file) for n, file in enumerate(words)]
    monkeypatch.setattr(arrange, "DEVICE_BATCH", 6)
    monkeypatch.setattr(trial, "POINTS", 6)
    alone = study(tmp_path / "alone.zarr", swept_pendulums.FEW, **swept_pendulums.BY_XLA)
    for process in both:
        process.join(120)
        assert process.exitcode == 0
    assert same(dx.load(tmp_path / "xla.zarr"), alone) and same(dx.load(tmp_path / "native.zarr"), done[0])
    said = [file.read_text().splitlines() for file in words]
    shares = [json.loads(next(line for line in lines if line.startswith("[["))) for lines in said]
    for name in ("xla", "native"):
        first, second = ([tuple(block) for study_of, _, block in share if study_of == name] for share in shares)
        assert sorted(first + second) == sorted(store.layout_of(tmp_path / f"{name}.zarr").grid)
        assert abs(len(first) - len(second)) <= 1
    devices = [{device for study_of, device, _ in share if study_of == "xla"} for share in shares]
    assert len(devices[0]) == len(devices[1]) == 2 and not devices[0] & devices[1]
    assert all("differs in step" in lines[-1] for lines in said)
    assert not list(tmp_path.glob("*.zarr/.unfinished")) and not list(tmp_path.glob(".*"))


def test_slurm_is_asked_for_workers_by_a_script_and_its_cluster_is_an_executor():
    jobqueue = pytest.importorskip("dask_jobqueue", reason="dask-jobqueue is not installed: pip install dirax[dask]")
    from distributed import Client

    options = {"scheduler_options": {"dashboard_address": None, "host": "127.0.0.1"}, "interface": None}
    with jobqueue.SLURMCluster(cores=4, processes=4, memory="8GB", walltime="02:00:00", **options) as cluster:
        script = cluster.job_script()
        assert "#SBATCH --cpus-per-task=4" in script and "#SBATCH -t 02:00:00" in script
        assert "distributed.cli.dask_worker" in script and cluster.scheduler_address in script
        with Client(cluster) as client:
            assert executors.checked(client) is client and executors.parallel(client, False) == 1  # no worker yet


# ------------------------------------------------------------------ going on, growing


@pytest.mark.soak
def test_the_same_call_again_runs_what_is_missing(done, tmp_path, ran):
    path = tmp_path / "study.zarr"
    study(path)
    first = sum(ran)
    study(path)
    assert first == sum(ran) == 240
    removed = sorted(path.glob("status/c.*"))[0]
    removed.unlink()
    assert np.sum(xr.open_zarr(path).status == 0) > 0
    assert same(study(path), done[0]) and first < sum(ran) < 2 * first


def test_finished_points_whose_numbers_are_gone_are_not_taken_for_nan(done, tmp_path):
    path = tmp_path / "study.zarr"
    data = study(path)
    gone = sorted(path.glob("q/c.*"))[1]
    gone.unlink()
    with pytest.raises(RuntimeError, match=r"q/c[.0-9]+ is gone, .*: delete .*status/c[.0-9]+, and the same call"):
        _ = data.q.values
    (path / "status" / ".".join(gone.name.split(".")[:3])).unlink()
    assert np.sum(np.isnan(dx.load(path).q.values)) > 0
    assert same(study(path), done[0])


def test_steps_of_variable_length_have_no_times_in_common(tmp_path):
    oscillator = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2)
    run = {"case": lambda a: {"q": [a], "v": [0.0]}, "step": 0.1, "steps": 4}
    scheme = dx.VariableSteps(dx.Collocation(1), lambda q: 1.0 + q @ q)
    data = dx.sweep(oscillator, scheme, over={"a": [1.0, 2.0]}, to=tmp_path / "variable.zarr", **run)
    assert "time" not in data.coords and np.all(np.diff(data.clock) < np.array([[0.06], [0.03]]))


def test_more_points_are_added_and_those_that_are_there_not_run_again(done, tmp_path, ran):
    path = tmp_path / "study.zarr"
    kept, older = (study(path, {"g": OVER["g"][::2], "angle": OVER["angle"][1::3]}) for _ in range(2))
    there, q = sum(ran), kept.load().q.values
    assert same(study(path), done[0])
    assert sum(ran) == 240 and there == 6 * 7
    assert np.array_equal(kept.q.values, q)
    with pytest.raises(RuntimeError, match="has grown since"):
        _ = older.q.values
    with pytest.raises(ValueError, match="leave out none"):
        study(path, {"g": OVER["g"][:3], "angle": OVER["angle"]})


def test_more_points_side_by_side(tmp_path, ran):
    path = tmp_path / "pairs.zarr"
    study(path, {"g": OVER["g"][:3], "angle": OVER["angle"][:3]}, zip=True)
    data = study(path, {"g": OVER["g"][4::-1], "angle": OVER["angle"][4::-1]}, zip=True)
    assert sum(ran) == 5 and np.array_equal(data.q.values[1], single(OVER["g"][3], OVER["angle"][3]).q)


class Above:
    def __init__(self, level):
        self.level = level

    def __call__(self, sol):
        return self.count(sol)

    def count(self, sol):
        return {"count": np.sum(sol.q > self.level)}


def test_the_store_of_another_sweep_is_refused_with_what_differs(done):
    _, path = done
    before = {name: (path / name).read_bytes() for name in files(path)}
    other = lambda g, angle: {"q": [angle, 0.1], "v": [0.0, 0.0], "params": {"g": g}}
    with pytest.raises(ValueError, match=r"differs in step \(0\.01 there, 0\.02 here\).*another path"):
        study(path, step=0.02)
    with pytest.raises(ValueError, match=r"differs in case \(scalars"):
        study(path, case=other)
    with pytest.raises(ValueError, match="differs in keep"):
        study(path, keep=lambda sol: {"end": sol.q[-1]})
    codes = [of_code(Above(1.0)), of_code(Above(2.0)), of_code(Above(1.0).count), of_code(Above(2.0).count)]
    assert len(set(codes)) == 4 and of_code(Above(1.0)) == codes[0]
    assert before == {name: (path / name).read_bytes() for name in files(path)}
    renamed = lambda g, angle: dict(v=[0.0, 0.0], q=[1.0 * angle, 0.0], params={"g": g})
    assert renamed(1.0, 2.0) == case(1.0, 2.0)


def test_whole_numbers_that_became_fractions_are_said_to_be_what_differs(tmp_path):
    path = tmp_path / "whole.zarr"
    study(path, {"g": [1.0], "angle": [1, 2]}, case=lambda g, angle: case(g, angle + 0.5))
    with pytest.raises(ValueError, match=r"differs in the type of the values of angle \(int64 there, float64 here\)"):
        study(path, {"g": [1.0], "angle": [1, 1.5, 2]}, case=lambda g, angle: case(g, angle + 0.5))


def test_a_later_dirax_and_other_stores_are_refused(done, tmp_path):
    path = tmp_path / "study.zarr"
    study(path, {"g": [1.0], "angle": [0.5]})
    node = json.loads((path / "zarr.json").read_text())
    for change in ({"dirax_version": "99.1.0"}, {"dirax_sweep_format": 99, "dirax_version": "99.1.0"}):
        (path / "zarr.json").write_text(json.dumps(node | {"attributes": node["attributes"] | change}))
        with pytest.raises(ValueError, match=r"later dirax \(99\.1\.0"):
            study(path, {"g": [1.0], "angle": [0.5]})
    with pytest.raises(ValueError, match="later dirax"):
        dx.load(path)
    single(1.0, 0.5).save(tmp_path / "one.zarr")
    with pytest.raises(ValueError, match="not the store of a sweep"):
        study(tmp_path / "one.zarr")
    with pytest.raises(ValueError, match=r"ends in \.zarr"):
        study(tmp_path / "study.nc")
    assert np.all(study(path, {"g": [1.0], "angle": [0.5]}, overwrite=True).status == 1)


def test_one_caller_at_a_time(done):
    _, path = done
    hold = Hold()
    assert hold.take(path)
    try:
        with pytest.raises(OSError, match="another call is filling the store"):
            study(path)
        assert (path / ".unfinished" / "lock").exists()  # what belongs to the other call is left alone
    finally:
        hold.release(path)
    assert same(study(path), done[0])


# ------------------------------------------------------------------ disks


def test_a_full_disk_is_one_error_and_the_same_call_goes_on(done, tmp_path, monkeypatch):
    path, calls, real = tmp_path / "study.zarr", [], os.fsync

    def full(descriptor):
        calls.append(descriptor)
        if len(calls) > 25:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(descriptor)

    monkeypatch.setattr(commit.os, "fsync", full)
    with pytest.raises(OSError, match=r"no space left for it.*same call again goes on \(.* of 240 points done") as raised:
        study(path)
    assert raised.value.errno == errno.ENOSPC
    monkeypatch.setattr(commit.os, "fsync", real)
    assert not any("unfinished" in name for name in files(path))
    assert same(study(path), done[0])


def test_a_study_larger_than_the_disk_is_refused_before_it_begins(tmp_path):
    with pytest.raises(OSError, match="GiB of the disk are free"):
        study(
            tmp_path / "huge.zarr", {"g": np.linspace(1, 2, 10**4), "angle": np.linspace(0, 3, 10**5)}, steps=10_000, save_every=1
        )


def test_a_store_that_cannot_be_written_is_one_error(tmp_path, monkeypatch):
    path = tmp_path / "study.zarr"
    study(path, {"g": [1.0], "angle": [0.5]})

    def refusing(*_, **__):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(store.Path, "mkdir", refusing)
    with pytest.raises(OSError, match=r"cannot be written .*ead-only"):
        study(path, {"g": [1.0], "angle": [0.5]})


# ------------------------------------------------------------------ case


def by_numpy(g, angle):
    return {"q": np.array([angle, 0.0]), "v": np.zeros(2), "params": {"g": np.abs(-g)}}


def by_jax(g, angle):
    return {"q": jnp.array([angle, 0.0]), "v": jnp.zeros(2), "params": {"g": jnp.abs(g)}}


def by_python(g, angle):
    return {"q": [float(angle), 0.0 if angle < 9 else 1.0], "v": [0.0, 0.0], "params": {"g": float(g)}}


@pytest.mark.parametrize(
    ("function", "mode"), [(case, "scalars"), (by_numpy, "columns"), (by_jax, "scalars"), (by_python, "points")]
)
def test_ways_to_write_case_have_one_result(function, mode):
    values = {"g": np.linspace(0.5, 2.0, 50), "angle": np.linspace(0.0, 3.0, 50)}
    few = {name: axis[::10] for name, axis in values.items()}
    chosen = Case.of(function, tuple(values), 0).chosen(few)
    assert chosen.mode == mode
    data, params = chosen.at(values)
    assert np.array_equal(data["q"], np.stack([values["angle"], np.zeros(50)], axis=1)) and np.array_equal(
        params["g"], values["g"]
    )


def test_a_case_gives_params_of_a_dataclass_that_jax_has_not_seen():
    @dataclass
    class Pendulum:
        g: float
        whole: bool

    values = {"g": np.linspace(0.5, 2.0, 5)}
    function = lambda g: {"q": [g], "v": [0.0], "params": Pendulum(2 * g, True)}
    _, params = Case.of(function, ("g",), 0).chosen(values).at(values)
    assert np.array_equal(params.g, 2 * values["g"]) and params.whole.tolist() == [True] * 5


def test_a_wrong_case_names_the_point(tmp_path):
    at = r"g = 1\.[0-9]+, angle = 2\.[0-9]+"
    wrong = lambda g, angle: (g > 1.0) & (g < 2.0) & (angle > 2.0) & (angle < 3.0)

    def fails(g, angle):
        if wrong(g, angle):
            raise RuntimeError("no such pendulum")
        return case(g, angle)

    grown = lambda g, angle: {"q": [angle, 0.0], "v": [0.0] * (3 if wrong(g, angle) else 2), "params": {"g": g}}
    undefined = lambda g, angle: {"q": [jnp.where(wrong(g, angle), jnp.nan, angle), 0.0], "v": [0.0, 0.0], "params": {"g": g}}
    for function, text in ((fails, "no such pendulum"), (grown, r"shape \(3,\)"), (undefined, "finite")):
        with pytest.raises(ValueError, match=text) as raised:
            study(tmp_path / "wrong.zarr", case=function)
        assert raised.match(at)
    for function, text in (
        (lambda g, angle: [angle], "must return a dict"),
        (lambda g, angle: {"angle": [angle]}, "may return q, v"),
        (lambda g, angle: {"q": [[angle]], "v": [0.0]}, "a row of real numbers"),
        (
            lambda g, angle: case(g, angle) | {"params": {"g": "Mars"}},
            r"numbers and arrays, but params\['g'\] is 'Mars'",
        ),
    ):
        with pytest.raises(ValueError, match=text):
            study(tmp_path / "wrong.zarr", case=function)
    with pytest.raises(TypeError, match="case takes mass, but the axes in over are g, angle"):
        study(tmp_path / "wrong.zarr", case=lambda mass: {})
    with pytest.raises(TypeError, match="case takes g, and not angle, so that all points along angle would be the same"):
        study(tmp_path / "wrong.zarr", case=lambda g: {"q": [0.5, 0.0], "v": [0.0, 0.0], "params": {"g": g}})
    assert not (tmp_path / "wrong.zarr").exists()


@pytest.mark.parametrize(
    "function",
    [
        lambda rng: {"q": rng.normal(size=2), "v": [0.0, 0.0], "params": {"g": 1.0}},
        lambda sample, rng: {"q": rng.normal(size=2), "v": [0.0, 0.0], "params": {"g": 1.0}},
        lambda sample, key: {"q": jax.random.normal(key, (2,)), "v": [0.0, 0.0], "params": {"g": 1.0}},
    ],
)
@pytest.mark.soak_of(but=["<lambda>2"])
def test_random_numbers_belong_to_the_point(tmp_path, function):
    some = study(tmp_path / "some.zarr", {"sample": range(0, 40, 3)}, case=function, steps=5)
    more = study(tmp_path / "more.zarr", {"sample": range(40)}, case=function, steps=5, task_seconds=1.0)
    assert np.array_equal(some.q.values, more.q.values[::3]) and len(np.unique(more.q.values[:, 0, 0])) == 40
    other = study(tmp_path / "seed.zarr", {"sample": range(40)}, case=function, steps=5, seed=1)
    assert not np.any(other.q.values[:, 0] == more.q.values[:, 0])


def test_random_numbers_of_ones_own_are_refused(tmp_path):
    generator = np.random.default_rng(0)
    with pytest.raises(ValueError, match="let it take an argument rng"):
        study(tmp_path / "own.zarr", case=lambda g, angle: {"q": generator.normal(size=2), "v": [0.0, 0.0], "params": {"g": g}})


# ------------------------------------------------------------------ keep


@pytest.mark.parametrize(
    "keep",
    [
        lambda sol: {"end": sol.q[-1], "error": np.max(np.abs(sol.energy() - sol.energy()[0]))},
        lambda sol: {"end": sol.q[-1], "error": jnp.max(jnp.abs(sol.energy() - sol.energy()[0]))},
        lambda sol: {"end": sol.q[..., -1, :], "error": np.abs(sol.energy() - sol.energy()[..., :1]).max(axis=-1)},
        lambda sol: {"end": [float(x) for x in sol.q[-1]], "error": float(max(abs(sol.energy() - sol.energy()[0])))},
    ],
)
@pytest.mark.soak_of("<lambda>2")
def test_ways_to_write_keep_have_one_result(done, tmp_path, keep):
    over = {"g": OVER["g"][:3], "angle": OVER["angle"]}
    data = study(tmp_path / "kept.zarr", over, keep=keep)
    assert set(data.data_vars) == {"end", "error", "message", "status"} and "time" not in data.coords
    assert np.array_equal(data.end.values, done[0].q.values[:3, :, -1])
    sol = single(over["g"][2], over["angle"][11])
    assert np.isclose(data.error.values[2, 11], np.abs(sol.energy() - sol.energy()[0]).max(), rtol=1e-6, atol=1e-15)


TANK = dx.LagrangeDirac(lambda q, v: 1e-9 * v @ v / 2 - q @ q / 2e-12)
"""An oscillator of a nanohenry and a picofarad."""


@pytest.mark.parametrize("scale", [2.0**-50, 1.0])
@pytest.mark.parametrize("points", [2, 6, 64])
@pytest.mark.parametrize("rows", [2, 6, 7])
@pytest.mark.soak_of(but=["6-64-8.881784197001252e-16"])
def test_no_axis_is_taken_for_that_of_the_points_whatever_the_units(tmp_path, scale, points, rows):
    charges = np.linspace(1.0, 3.0, points)

    def kept(keep):
        data = dx.sweep(
            TANK,
            dx.LagrangeDAlembert(),
            over={"charge": charges},
            case=lambda charge: {"q": [scale * charge, 0.0], "v": [0.0, 0.0]},
            keep=keep,
            step=1e-11,
            steps=rows - 1,
            to=tmp_path / "tanks.zarr",
            overwrite=True,
            progress=False,
        )
        return {name: array.values[..., 0] for name, array in data.data_vars.items() if name not in ("status", "message")}

    ends = kept(lambda sol: {"first": sol.q[0], "last": sol.q[-1]})
    assert np.array_equal(ends["first"], scale * charges)
    assert np.allclose(ends["last"], charges * ends["last"][0], rtol=1e-9, atol=0.0)
    early = kept(lambda sol: {"early": sol.q[:50]})["early"]
    assert np.array_equal(early[:, 0], ends["first"]) and np.array_equal(early[:, -1], ends["last"])


def test_another_value_of_what_a_case_closes_over_is_noticed_in_any_units():
    scale = 1e-15

    def case(charge):
        return {"q": [1.0, scale * charge], "v": [0.0, 0.0]}

    values = {"charge": np.linspace(1.0, 3.0, 6)}
    for _ in range(2):
        data, _ = Case.of(case, ("charge",), 0).chosen(values).at(values)
        assert np.allclose(data["q"][:, 1], scale * values["charge"], rtol=1e-12, atol=0.0)
        scale *= 5.0


def test_functions_that_cannot_be_sent_to_other_processes_are_one_error(tmp_path):
    kept = threading.Lock()
    with pytest.raises(TypeError, match=r"cannot be sent to other processes \(cannot pickle.*leave executor out"):
        study(tmp_path / "locked.zarr", {"g": [1.0], "angle": [0.5]}, executor=1, keep=lambda sol: {"x": 1.0 * kept.locked()})


@pytest.mark.parametrize("kept", [np.int16(3), np.uint64(3), np.float16(0.5)])
def test_numbers_of_types_that_stores_do_not_hold_are_kept_in_wider_ones(kept, tmp_path):
    data = study(tmp_path / "small.zarr", {"g": [1.0], "angle": [0.5, 1.0]}, keep=lambda sol: {"x": kept})
    assert np.all(data.x == kept) and data.x.dtype.name in TYPES


@pytest.mark.soak
def test_numbers_of_several_types_are_kept_and_given_in_one_that_has_them_all(tmp_path):
    angles = np.linspace(0.5, 2.0, 6)
    grid = {"g": [1.0], "angle": angles}
    late = lambda sol: {"x": sol.q[0, 0] if sol.q[0, 0] > 1.0 else 0, "n": 3 if sol.q[0, 0] > 1.0 else np.int8(1)}
    data = study(tmp_path / "kept.zarr", grid, keep=late)
    assert np.array_equal(data.x.values[0], np.where(angles > 1.0, angles, 0.0))
    assert np.array_equal(data.n.values[0], np.where(angles > 1.0, 3, 1))
    chosen = lambda g, angle: case(g, angle) | {"params": {"g": 1.0 if angle < 1.0 else 1.5, "n": 1 if angle < 1.0 else 0.5}}
    data = study(tmp_path / "given.zarr", grid, case=chosen)
    for j in (0, 5):
        assert np.array_equal(data.q.values[0, j], single([1.0, 1.5][j > 0], angles[j]).q)


@pytest.mark.soak
def test_a_store_that_grows_keeps_the_types_of_its_numbers(tmp_path):
    path = tmp_path / "grown.zarr"
    kept = lambda sol: {"x": sol.q[0, 0] if sol.q[0, 0] < 1.0 else 0}
    study(path, {"g": [1.0], "angle": [0.25, 0.5]}, keep=kept)
    for angles in ([2.0, 0.25, 0.5], np.r_[np.linspace(2.0, 3.0, 40), 0.25, 0.5]):
        data = study(path, {"g": [1.0], "angle": angles}, keep=kept)
        assert np.array_equal(data.x.values[0], np.where(data.angle < 1.0, data.angle, 0.0))
    whole = study(tmp_path / "whole.zarr", {"g": [1.0], "angle": [1.5, 2.0]}, keep=kept)
    assert whole.x.dtype == np.int64
    whole = study(tmp_path / "whole.zarr", {"g": [1.0], "angle": [0.25, 1.5, 2.0]}, keep=kept)
    assert whole.x.values[0].tolist() == [0.25, 0.0, 0.0]


def test_a_type_that_does_not_have_a_later_number_is_one_error(tmp_path):
    many = {"g": np.linspace(1.0, 2.0, 1000), "angle": [0.5]}
    odd = lambda g: 0.3 < (g - 1.0) * 999.0 - 500.0 < 1.3
    with pytest.raises(ValueError, match=r"one type at all points, but at g = 1\.501.* its params\['n'\] is 1\.5, which int64"):
        study(
            tmp_path / "given.zarr", many, case=lambda g, angle: case(g, angle) | {"params": {"g": g, "n": 1.5 if odd(g) else 1}}
        )
    kept = lambda sol: {"x": sol.t[-1] + 0.5 if odd(float(sol.params["g"])) else 0}
    with pytest.raises(ValueError, match=r"keep must return x in one type .*at g = 1\.501.*0\.0 in place of 0"):
        study(tmp_path / "kept.zarr", many, keep=kept)


def test_a_wrong_keep_is_one_error(tmp_path):
    with pytest.raises(ValueError, match="keep must return real numbers, but x has the dtype complex128"):
        study(tmp_path / "wrong.zarr", keep=lambda sol: {"x": 1j})
    with pytest.raises(ValueError, match=r"keep fails for the trajectory at g = 0\.5, angle = 0\.0: KeyError"):
        study(tmp_path / "wrong.zarr", keep=lambda sol: {"x": sol.fields["x"]})
    with pytest.raises(ValueError, match="keep must return a dict"):
        study(tmp_path / "wrong.zarr", keep=lambda sol: sol.q)
    for name in ("status", "message", "E/m", "", "..", "../out"):
        with pytest.raises(ValueError, match=r"keep returned an array named .*but names are folders of the store"):
            study(tmp_path / "wrong.zarr", keep=lambda sol, name=name: {name: sol.q[-1]})
    with pytest.raises(ValueError, match="keep must return numbers and arrays, but rows is none: ValueError"):
        study(tmp_path / "wrong.zarr", keep=lambda sol: {"rows": [[1], [1, 2]]})
    with pytest.raises(ValueError, match="'g' is the name of an axis and of what is kept"):
        study(tmp_path / "wrong.zarr", keep=lambda sol: {"g": sol.q[-1]})


def test_an_axis_of_truths_stays_one(tmp_path):
    start = lambda on: {"q": [1.0 + on], "v": [0.0]}
    oscillator = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q @ q / 2)
    run = {"case": start, "keep": lambda sol: {"e (J)": sol.q[0, 0]}, "step": 0.1, "steps": 2, "to": tmp_path / "on.zarr"}
    data = dx.sweep(oscillator, dx.LagrangeDAlembert(), over={"on": [False, True]}, **run)
    assert data.on.dtype == bool and data["e (J)"].sel(on=True) == 2.0


# ------------------------------------------------------------------ points that fail

FALLING = dx.LagrangeDirac(lambda q, v: v @ v / 2 + jnp.sqrt(q[0]) - 2 * q[0])


def test_trajectories_that_fail_are_nan_from_there_on_and_others_unchanged(tmp_path):
    heights = np.array([0.1, 3.0, -1.0, 4.0])  # falls out of the domain, stays, begins outside, stays
    data = dx.sweep(
        FALLING,
        dx.PlusLagrangeDirac(),
        over={"height": heights},
        case=lambda height: {"q": [height], "v": [-1.0]},
        step=0.01,
        steps=40,
        save_every=5,
        to=tmp_path / "falling.zarr",
    )
    assert data.status.values.tolist() == [2, 1, 3, 1]
    alone = dx.simulate(FALLING, dx.PlusLagrangeDirac(), q=[0.1], v=[-1.0], step=0.01, steps=40, save_every=5)
    rows = np.sum(~np.isnan(data.q.values[0, :, 0]))
    assert 0 < rows < 9 and np.array_equal(data.q.values[0, :rows, 0], alone.q[:rows, 0])
    assert "failed: " in data.message.values[0] and "domain" in data.message.values[2] and not data.message.values[1]
    assert np.all(np.isnan(data.q.values[2])) and np.all(np.isfinite(data.q.values[[1, 3]]))


def test_a_study_that_is_refused_everywhere_says_so(tmp_path):
    with pytest.raises(ValueError, match=r"all points that were tried are refused.*height = -1\.0"):
        dx.sweep(
            FALLING,
            dx.PlusLagrangeDirac(),
            over={"height": [-3.0, -1.0]},
            case=lambda height: {"q": [height], "v": [-1.0]},
            step=0.01,
            steps=10,
            to=tmp_path / "none.zarr",
        )


# ------------------------------------------------------------------ parts


def test_wrong_axes_name_the_axis(tmp_path):
    for over, error, text in (
        ([1.0], TypeError, "over must be a dict"),
        ({"g": [1.0, np.nan]}, ValueError, r"over\['g'\] must be finite"),
        ({"g": [[1.0]]}, ValueError, "a row of numbers"),
        ({"g": [1.0, 2.0, 1.0]}, ValueError, "the value 1.0 of g twice"),
        ({"time": [1.0]}, ValueError, "names an axis 'time'"),
    ):
        with pytest.raises(error, match=text):
            study(tmp_path / "wrong.zarr", over)
    with pytest.raises(ValueError, match="g has 2, angle has 1"):
        study(tmp_path / "wrong.zarr", {"g": [1.0, 2.0], "angle": [1.0]}, zip=True)
    for name, value in (("executor", "cluster"), ("seed", 1.5), ("project", "no"), ("overwrite", 1), ("to", None)):
        with pytest.raises(TypeError, match=f"{name} must be"):
            study(**{"to": tmp_path / "wrong.zarr", name: value})
    assert type(executors.checked(np.int64(2))) is int


@pytest.mark.parametrize(("shape", "points"), [((7,), 3), ((5, 6, 7), 20), ((5, 6, 7), 1), ((3, 4), 100), ((1, 9), 4)])
def test_blocks_cover_the_grid_once(shape, points):
    grid = cut(shape, points)
    numbers = np.concatenate([grid.numbers(index).ravel() for index in grid])
    assert sorted(numbers.tolist()) == list(range(int(np.prod(shape)))) and grid.points <= max(points, 1)


def test_texts_in_a_store():
    texts = np.array(["", "θ = 1", "a\nb"], object)
    assert decoded_texts(encoded_texts(texts)).tolist() == texts.tolist()


def test_texts_as_an_axis(tmp_path):
    signs = {"left": -1.0, "right": 1.0}
    start = lambda side: {"q": [signs[side], 0.0], "v": [0.0, 0.0], "params": {"g": 1.0}}
    data = study(tmp_path / "sides.zarr", {"side": ["left", "right"]}, case=start)
    assert np.array_equal(data.sel(side="right").q.values, single(1.0, 1.0).q) and data.side.values.tolist() == ["left", "right"]


def test_the_system_is_read_by_its_program(tmp_path):
    from dirax.solution import fingerprint

    a = lambda q, g: g * jnp.sin(q) + 1.0
    b = lambda position, field: field * jnp.sin(position) + 1.0
    c = lambda q, g: g * jnp.sin(q) + 2.0
    kinds = (jax.ShapeDtypeStruct((2,), np.float64), 1.0)
    of = lambda f: fingerprint.of_functions([(f, kinds)])
    assert of(a) == of(b) != of(c)
    table = np.arange(3.0)
    assert fingerprint.of_code(lambda x: table + x) == fingerprint.of_code(lambda x: table + x)
    first = fingerprint.of_code(lambda x: table + x)
    table = np.arange(4.0)
    assert first != fingerprint.of_code(lambda x: table + x)
    assert SYSTEM is not None


@pytest.mark.parametrize("as_float", [False, True])
def test_what_keep_sees_of_the_iterations_is_that_of_the_point(tmp_path, as_float):
    quartic = dx.LagrangeDirac(lambda q, v: v @ v / 2 - jnp.sum(q**4) / 4)
    number = float if as_float else lambda x: x
    keep = lambda sol: {"iterations": number(sol.stats["newton_iterations"]), "worst": sol.stats["max_residual"]}
    run = {"step": 0.2, "steps": 20}
    over, case = {"a": [0.1, 1.0, 5.0]}, lambda a: {"q": [a], "v": [0.0]}
    data = dx.sweep(quartic, dx.LagrangeDAlembert(), over=over, case=case, to=tmp_path / "a.zarr", keep=keep, **run)
    alone = [dx.simulate(quartic, dx.LagrangeDAlembert(), **case(a), **run).stats for a in over["a"]]
    assert data.iterations.values.tolist() == [stats["newton_iterations"] for stats in alone]
    assert data.worst.values.tolist() == [stats["max_residual"] for stats in alone]
