"""Files: exact round trips, named dimensions and units, no code from a file, nothing lost, one clear sentence of error."""

import copy
import errno
import json
import os
import pickle
import re
import shutil
import signal
import subprocess
import sys
import tracemalloc
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from numcodecs import zstd

import dirax as dx
from dirax.solution import atomic_files, netcdf, saving, zarr_store
from dirax.solution.description import Description, Variable, describe
from dirax.solution.plain_forms import decode_scheme, encode_scheme

ENDINGS = (".zarr", ".nc")
FILES = Path(__file__).parent / "files"


def skate_lagrangian(q, v, params):
    return v @ v / 2 - params["g"] * q[0]


def skate_one_forms(q):
    return jnp.array([[jnp.sin(q[2]), -jnp.cos(q[2]), 0.0]])


SKATE = dx.LagrangeDirac(skate_lagrangian, skate_one_forms)  # on a slope, q = (x, y, direction)
FALL = dx.LagrangeDirac(lambda q, v: v @ v / 2 + jnp.log(q[0]))  # falls into q = 0, where L ends


@pytest.fixture(scope="module")
def batch():
    """Two skates that start on the constraint, 5 steps of which every second is saved."""
    v = np.array([[0.5, 0.0, 1.0], [-1.0, 0.0, 0.3]])
    return dx.simulate(SKATE, dx.PlusLagrangeDirac(), q=np.zeros(3), v=v, params={"g": 10.0}, step=0.01, steps=5, save_every=2)


@pytest.fixture(scope="module")
def two_points():
    return dx.simulate(
        SKATE,
        dx.MinusLagrangeDirac(),
        q0=np.zeros(3),
        q1=np.array([0.01, 0.0, 0.02]),
        params={"g": 10.0},
        step=0.01,
        steps=4,
    )


@pytest.fixture(scope="module")
def failed():
    return dx.simulate(FALL, dx.PlusLagrangeDirac("midpoint"), q=[1.0], v=[-3.0], step=0.05, steps=100)


def bits(values):
    array = np.asarray(values)
    return array.dtype, array.shape, array.tobytes()


def assert_same(loaded, saved):
    assert list(loaded.fields) == list(saved.fields)
    for name in saved.fields:
        assert bits(loaded.fields[name]) == bits(saved.fields[name]), name
        assert loaded.field_info[name] == saved.field_info[name]
    assert bits(loaded.t) == bits(saved.t)
    for name in saved.initial:
        assert bits(loaded.initial[name]) == bits(saved.initial[name])
    assert (loaded.step, loaded.save_every) == (saved.step, saved.save_every)
    assert np.array_equal(loaded.ok, saved.ok) and np.shape(loaded.ok) == np.shape(saved.ok)
    assert loaded.message == saved.message
    assert loaded.stats == saved.stats
    assert loaded.scheme == saved.scheme
    assert bits(loaded.energy()) == bits(saved.energy())
    if saved.constraint_residual().size:
        assert bits(loaded.constraint_residual()) == bits(saved.constraint_residual())


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("name", ["batch", "two_points", "failed"])
def test_round_trip_is_exact(name, ending, tmp_path, request):
    saved = request.getfixturevalue(name)
    path = saved.save(tmp_path / f"run{ending}")
    loaded = dx.load(path)
    assert_same(loaded, saved)
    assert loaded.system is None and loaded.metadata["system"] == repr(saved.system)
    assert_same(dx.load(loaded.save(tmp_path / f"again{ending}")), saved)
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"again{ending}", f"run{ending}"]


@pytest.mark.parametrize("ending", ENDINGS)
def test_every_bit_pattern_survives(ending, tmp_path, batch):
    """Signed zeros, infinities, subnormal numbers and NaNs with a payload; arrays of one such value only."""
    odd = np.array([0x8000000000000000, 0x7FF0000000000000, 1, 0x7FF8000000000123], dtype=np.uint64).view(np.float64)
    field = lambda value: np.full((2, 4, 3), value)
    fields = {"q": np.tile(odd[:3], (2, 4, 1)), "p": np.tile(-odd[1:], (2, 4, 1))}
    fields |= {"zero": field(-0.0), "nothing": field(np.nan), "payload": field(odd[3])}
    info = {name: batch.field_info["q"] for name in fields}
    sol = dx.Solution(t=batch.t, fields=fields, field_info=info, step=0.01, save_every=2, stats={}, ok=batch.ok, message=["", ""])
    loaded = dx.load(sol.save(tmp_path / f"odd{ending}"))
    for name, values in fields.items():
        assert bits(loaded.fields[name]) == bits(values)


def test_dataset_names_dimensions_units_and_what_was_run(batch):
    data = batch.to_xarray(units={"t": "s", "q": ["m", "m", "rad"], "energy": "J"}, coordinates="xyφ")
    assert dict(data.sizes) == {"trajectory": 2, "time": 4, "interval": 3, "coordinate": 3, "constraint": 1}
    assert data.q.dims == ("trajectory", "time", "coordinate")
    assert data.multipliers.dims == data.constraint_residual.dims == ("trajectory", "interval", "constraint")
    assert data.energy.dims == ("trajectory", "time")
    np.testing.assert_array_equal(data.time, [0.0, 0.02, 0.04, 0.05])
    np.testing.assert_array_equal(data.interval, [0.0, 0.02, 0.04])
    np.testing.assert_array_equal(data.q.sel(coordinate="φ"), batch.q[..., 2])
    assert (data.time.units, data.q.units, data.energy.units, data.p.units) == ("s", "m, m, rad", "J", "")
    about = data.attrs
    assert about["dirax_version"] == dx.__version__
    assert about["system"] == "LagrangeDirac(lagrangian=skate_lagrangian(q, v, params), one_forms=skate_one_forms(q))"
    assert about["scheme"] == "PlusLagrangeDirac(discrete_lagrangian='left')"
    settings = {"discrete_lagrangian": {"plain": "left"}, "momentum": {"plain": "incoming"}}
    assert json.loads(about["scheme_settings"])["settings"] == settings
    assert (about["step"], about["save_every"]) == (0.01, 2)
    assert json.loads(about["stats"])["steps"] == 5
    assert json.loads(about["params"])["dict"]["g"]["array"] == 10.0


@pytest.mark.parametrize("ending", ENDINGS)
def test_names_that_clash(ending, tmp_path, two_points):
    """A field named like its own dimension or like time, two fields with dimensions of one name and different sizes."""
    info = {
        "work": dx.Field((2,), dims=("work",)),
        "time": dx.Field((), dims=()),
        "constraint": dx.Field((3,), "step", ("constraint",)),
        "multipliers": dx.Field((1,), "step", ("constraint",)),
        "matrix": dx.Field((2, 2), dims=("coordinate", "coordinate")),
    }
    fields = {name: np.random.default_rng(0).normal(size=(5 - (f.place == "step"), *f.shape)) for name, f in info.items()}
    sol = dx.Solution(t=two_points.t, fields=fields, field_info=info, step=0.01, save_every=1, stats={})
    data = sol.to_xarray()
    assert data.work.dims == ("time", "work_axis_0")
    assert data.matrix.dims == ("time", "coordinate", "matrix_axis_1")
    assert data.constraint_residual.dims == ("interval", "constraint")
    assert data.multipliers.dims == ("interval", "multipliers_axis_0")
    np.testing.assert_array_equal(data.time, two_points.t)
    np.testing.assert_array_equal(data.time_field, fields["time"])
    loaded = dx.load(sol.save(tmp_path / f"run{ending}"))
    for name in fields:
        assert bits(loaded.fields[name]) == bits(fields[name])
        assert loaded.field_info[name] == info[name]


@pytest.mark.parametrize("ending", ENDINGS)
def test_files_open_in_xarray_with_units(ending, tmp_path, two_points):
    path = two_points.save(tmp_path / f"run{ending}", units={"q": "m"}, coordinates="xyφ")
    options = {"engine": "zarr", "consolidated": False} if ending == ".zarr" else {"engine": "h5netcdf"}
    with xr.open_dataset(path, **options) as data:
        assert data.q.dims == ("time", "coordinate") and data.q.units == "m"
        assert data.q.coordinate_names == "x, y, φ"
        np.testing.assert_array_equal(data.q, two_points.q)
    assert dx.load(path).to_xarray().coordinate.values.tolist() == ["x", "y", "φ"]


def test_loading_with_the_system_restores_code_and_parameters(tmp_path, batch):
    loaded = dx.load(batch.save(tmp_path / "run.zarr"), system=SKATE)
    assert loaded.equation is batch.equation
    assert loaded.params == {"g": jnp.asarray(10.0)}
    again = dx.simulate(SKATE, loaded.scheme, **loaded.initial, params=loaded.params, step=0.01, steps=5, save_every=2)
    assert bits(again.q) == bits(batch.q)
    with pytest.raises(ValueError, match=r"the file holds the fields .*'q': \(3,\).* but the system .* have .*'q': \(3,\)"):
        dx.load(tmp_path / "run.zarr", system=dx.LagrangeDirac(skate_lagrangian))


def test_schemes_with_code_come_from_the_argument(tmp_path):
    def midpoint(q0, q1, h):
        return h * (jnp.sum((q1 - q0) ** 2) / h**2 - jnp.sum((q0 + q1) ** 2) / 4) / 2

    oscillator = dx.LagrangeDirac(lambda q, v: (v @ v - q @ q) / 2)
    scheme = dx.PlusLagrangeDirac(midpoint)
    path = dx.simulate(oscillator, scheme, q=[1.0], v=[0.0], step=0.1, steps=3).save(tmp_path / "run.nc")
    assert dx.load(path).scheme is None
    assert dx.load(path).metadata["scheme"] == "PlusLagrangeDirac(discrete_lagrangian=midpoint(q0, q1, h))"
    assert dx.load(path, system=oscillator, scheme=scheme).equation is not None


def test_a_loaded_run_is_not_gone_through_with_the_steps_of_another_system(tmp_path):
    driven = dx.PortHamiltonian(lambda x: x @ x / 2, np.array([[0.0, 1.0], [-1.0, 0.0]]), np.array([[0.0], [1.0]]))
    push = lambda t, x: 5 * jnp.sin(1.3 * t)[None]
    sol = dx.simulate(driven, dx.DiscreteGradient(), x=[1.0, 0.0], inputs=push, step=0.1, steps=20)
    path, t = sol.save(tmp_path / "run.nc"), 1.63
    assert bits(dx.load(path, system=driven, inputs=push).at(t).x) == bits(sol.at(t).x)
    loaded = dx.load(path, system=driven)
    for taken in (loaded, loaded[3:], copy.deepcopy(dx.load(path, system=GENTLE))):
        with pytest.raises(ValueError, match=r"that dx\.load was given leads from row .* the run has .*inputs=…"):
            taken.at(t)
    with pytest.raises(ValueError, match="inputs= drives the system of the run"):
        dx.load(path, inputs=push)


GENTLE = dx.PortHamiltonian(lambda x: x @ x / 3, np.array([[0.0, 1.0], [-1.0, 0.0]]), np.array([[0.0], [1.0]]))


def test_a_scheme_from_before_a_setting_and_a_module_had_their_names_comes_back():
    old = {"class": "PlusLagrangeDirac", "module": "dirax.elsewhere", "settings": {"discrete_lagrangian": {"plain": "left"}}}
    assert decode_scheme(old) == dx.PlusLagrangeDirac()
    with pytest.raises(ValueError, match="other settings"):
        decode_scheme(old | {"settings": {}})


class Spring(NamedTuple):
    stiffness: float


@jax.tree_util.register_dataclass
@dataclass
class Weight:
    mass: Any
    springs: tuple


def test_params_of_a_class_are_numbers_by_name_in_a_file(tmp_path):
    system = dx.LagrangeDirac(lambda q, v, params: params.mass * (v @ v) / 2 - params.springs[0].stiffness * (q @ q))
    params = Weight(jnp.asarray(2.0), (Spring(np.float64(3.0)), None))
    sol = dx.simulate(system, dx.LagrangeDAlembert(), q=[1.0], v=[0.0], params=params, step=0.1, steps=2)
    for ending in (".zarr", ".nc"):
        path = sol.save(tmp_path / f"run{ending}")
        loaded = dx.load(path)
        assert loaded.params == {"mass": 2.0, "springs": ({"stiffness": 3.0}, None)}
        assert loaded.metadata["params_code"] == "Weight"
        for place in (path, loaded.save(tmp_path / f"again{ending}")):
            with pytest.raises(ValueError, match=r"made of Weight, which is code that no file holds: pass params=.*\.params\.$"):
                dx.load(place, system=system)
        again = dx.load(path, system=system, params=params)
        assert again.equation is sol.equation and "params_code" not in again.metadata
        assert dx.verify(again)["steps replayed"].verdict == "ok"


def test_nested_schemes_and_parameter_trees_come_back(tmp_path):
    system = dx.LagrangeDirac(lambda q, v, params: v @ v / 2 - params["k"][0] @ q**2)
    scheme = dx.Composition(dx.LagrangeDAlembert("midpoint"), "yoshida4")
    params = {"k": (np.array([1.0, 2.0]), None, [3, True]), "π": np.float64(np.pi)}
    sol = dx.simulate(system, scheme, q=[1.0, 0.0], v=[0.0, 1.0], params=params, step=0.1, steps=2)
    loaded = dx.load(sol.save(tmp_path / "run.zarr"))
    assert loaded.scheme == scheme
    assert jax.tree.structure(loaded.params) == jax.tree.structure(sol.params)
    assert loaded.params["k"][1] is None and loaded.params["k"][2][1].dtype == bool
    assert bits(loaded.params["k"][0]) == bits(params["k"][0]) and float(loaded.params["π"]) == np.pi
    sol.params = {"k": lambda x: x}
    path = sol.save(tmp_path / "code.zarr")
    assert dx.load(path).params is None
    with pytest.raises(ValueError, match=r"made of <function .*lambda.*no file holds: pass params=…\.$"):
        dx.load(path, system=system)
    assert "lambda" in xr.open_zarr(path, consolidated=False).attrs["params_not_stored"]


@pytest.mark.parametrize(
    "scheme",
    [
        dx.LagrangeDAlembert("trapezoidal", "left", "outgoing"),
        dx.DiscreteDirac(dx.Theta(0.25)),
        dx.DiscreteDirac(dx.RiemannianExp(dx.Product(dx.Sphere(3), dx.Euclidean(2))), "resolve"),
        dx.Composition(dx.SymmetricComposition(dx.PlusLagrangeDirac("right")), (0.25, 0.5, 0.25)),
        dx.Adjoint(dx.MinusLagrangeDirac()),
    ],
    ids=lambda scheme: type(scheme).__name__,
)
def test_schemes_of_dirax_survive_as_plain_data(scheme):
    assert decode_scheme(json.loads(json.dumps(encode_scheme(scheme)))) == scheme


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.soak_of(".nc")
def test_long_attributes(ending, tmp_path, two_points):
    """HDF5 attributes end at 64 KB."""
    two_points = dx.load(two_points.save(tmp_path / f"run{ending}"))
    two_points.metadata["note"] = "ü" * 100_000
    assert dx.load(two_points.save(tmp_path / f"long{ending}")).metadata["note"] == "ü" * 100_000


# ------------------------------------------------------------------------------------------------------------- refusals


def test_traced_solutions_are_refused(tmp_path):
    def run(x):
        sol = dx.simulate(FALL, dx.PlusLagrangeDirac(), q=jnp.stack([x]), v=[0.0], step=0.1, steps=2)
        with pytest.raises(ValueError, match=r"traced values.*outside of jax\.grad, jit and vmap"):
            sol.save(tmp_path / "run.zarr")
        return sol.q[-1, 0]

    jax.grad(run)(1.0)
    assert not list(tmp_path.iterdir())


def test_names_are_checked(batch):
    with pytest.raises(ValueError, match=r"units names 'energie', which .*: did you mean 'energy'\?"):
        batch.to_xarray(units={"energie": "J"})
    with pytest.raises(TypeError, match=r"units\['q'\] must be a string, or a list of strings, but 3 was given"):
        batch.to_xarray(units={"q": 3})
    with pytest.raises(ValueError, match=r"coordinates names 'x' twice"):
        batch.to_xarray(coordinates=["x", "y", "x"])
    with pytest.raises(ValueError, match=r"one name for each of 3 coordinates, but it holds 2"):
        batch.to_xarray(coordinates=["x", "y"])


@pytest.mark.parametrize("ending", ENDINGS)
def test_an_existing_file_is_kept_unless_overwrite(ending, tmp_path, batch, two_points):
    path = two_points.save(tmp_path / f"run{ending}")
    with pytest.raises(FileExistsError, match=r"run\.\w+ exists: pass overwrite=True"):
        batch.save(path)
    assert_same(dx.load(path), two_points)
    assert_same(dx.load(batch.save(path, overwrite=True)), batch)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_a_folder_of_something_else_is_never_replaced(tmp_path, batch):
    for name in ("mine.zarr", "mine.nc"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "thesis.tex").write_text("precious")
        with pytest.raises(FileExistsError, match=r"is no \.\w+ file, so it is not replaced"):
            batch.save(tmp_path / name, overwrite=True)
        assert (tmp_path / name / "thesis.tex").read_text() == "precious"


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("moment", ["writing", "moving"])
def test_an_interrupted_save_leaves_the_old_file(moment, ending, tmp_path, batch, two_points, monkeypatch):
    path = two_points.save(tmp_path / f"run{ending}")
    if moment == "writing":
        write, is_one = saving.FORMATS[ending]

        def interrupted(*args):
            write(*args)
            raise KeyboardInterrupt

        monkeypatch.setitem(saving.FORMATS, ending, (interrupted, is_one))
    else:
        monkeypatch.setattr(atomic_files, "_exchanged", lambda *_: False)  # as where the system cannot
        replace = atomic_files.os.rename if ending == ".zarr" else atomic_files.os.replace

        def stopped(source, target):
            if str(target) == str(path) and "old" not in str(source):
                raise KeyboardInterrupt
            replace(source, target)

        monkeypatch.setattr(atomic_files.os, "rename" if ending == ".zarr" else "replace", stopped)
    with pytest.raises(KeyboardInterrupt):
        batch.save(path, overwrite=True)
    monkeypatch.undo()
    assert_same(dx.load(path), two_points)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("ending", ENDINGS)
def test_what_the_system_says_against_writing_is_said_of_the_path(ending, tmp_path, batch, two_points, monkeypatch):
    path = two_points.save(tmp_path / f"run{ending}")

    def full(*_):
        raise OSError(errno.ENOSPC, "inner words")

    monkeypatch.setitem(saving.FORMATS, ending, (full, saving.FORMATS[ending][1]))
    with pytest.raises(
        OSError, match=rf"^{re.escape(str(path))} cannot be written \(there is no space left.* free some"
    ) as raised:
        batch.save(path, overwrite=True)
    assert raised.value.errno == errno.ENOSPC
    assert_same(dx.load(path), two_points)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    monkeypatch.setattr(atomic_files.os, "access", lambda *_: False)
    with pytest.raises(OSError, match=rf"^the folder {re.escape(str(tmp_path))} is read-only here: make it writable"):
        batch.save(tmp_path / f"other{ending}")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems have no such call")
def test_a_folder_is_replaced_in_one_action(tmp_path, batch, two_points, monkeypatch):
    path = two_points.save(tmp_path / "run.zarr")
    monkeypatch.setattr(atomic_files.os, "rename", None)  # it is never out of its place
    assert_same(dx.load(batch.save(path, overwrite=True)), batch)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_paths(tmp_path, batch):
    with pytest.raises(ValueError, match=r"path must end in \.zarr .* or \.nc .*, but '.*run\.h5' was given"):
        batch.save(tmp_path / "run.h5")
    with pytest.raises(FileNotFoundError, match=r"folder .*nowhere does not exist: create it"):
        batch.save(tmp_path / "nowhere" / "run.nc")
    with pytest.raises(FileNotFoundError, match=r"there is no file .*run\.nc: check the path"):
        dx.load(tmp_path / "run.nc")
    for path in (None, 5, b"run.nc"):
        for action in (dx.load, batch.save):
            with pytest.raises(TypeError, match=rf'path must be a text .* such as "run\.zarr", but {path!r} was given'):
                action(path)


@pytest.mark.parametrize("ending", ENDINGS)
def test_long_names(ending, tmp_path, two_points):
    with pytest.raises(ValueError, match=r"the name .* has 30\d bytes: choose one of at most 255"):
        two_points.save(tmp_path / ("r" * 300 + ending))
    path = two_points.save(tmp_path / ("ü" * 120 + ending))
    assert_same(dx.load(path), two_points)
    with pytest.raises(FileNotFoundError, match="there is no file"):
        dx.load(tmp_path / ("r" * 300 + ending))


KILLED = """
import os, signal, sys
from dirax.solution.atomic_files import placed
with placed(sys.argv[1], False) as beside:
    beside.write_text("half a file")
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("ending", ENDINGS)
def test_what_a_killed_save_left_is_swept_by_the_next(ending, tmp_path, two_points):
    path = tmp_path / f"run{ending}"
    killed = subprocess.run([sys.executable, "-c", KILLED, path], capture_output=True, text=True)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".run-")
    with atomic_files.placed(path, False) as beside:  # one that is still at work is left alone
        assert not left.exists() and beside.parent.exists()
        two_points.save(path)
        assert beside.parent.exists()
        if ending == ".zarr":
            shutil.copytree(path, beside)
            shutil.rmtree(path)
        else:
            shutil.copy(path, beside)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    assert_same(dx.load(path), two_points)


def one_sentence(path, **arguments) -> str:
    """What `dx.load` says about a bad file."""
    with pytest.raises(ValueError) as caught:
        dx.load(path, **arguments)
    text = str(caught.value)
    assert text.startswith(f"{path} cannot be loaded: ") and "\n" not in text and text.endswith(".")
    assert len(text) - len(str(path)) < 200
    return text


@pytest.mark.soak
def test_foreign_files(tmp_path):
    xr.Dataset({"a": ("x", np.zeros(3))}).to_netcdf(tmp_path / "other.nc", engine="h5netcdf")
    assert "holds no dirax solution" in one_sentence(tmp_path / "other.nc")
    xr.Dataset({"a": ("x", np.zeros(3))}).to_zarr(tmp_path / "other.zarr", consolidated=False, zarr_format=3)
    assert "holds no dirax solution" in one_sentence(tmp_path / "other.zarr")
    for name in ("text.nc", "text.zarr"):
        (tmp_path / name).write_text("q,p\n1,2\n")
        assert one_sentence(tmp_path / name)
    (tmp_path / "empty.zarr").mkdir()
    assert "not a zarr store" in one_sentence(tmp_path / "empty.zarr")


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.999])
@pytest.mark.soak_of(but=["0.999"])
def test_truncated_netcdf(share, tmp_path, batch):
    path = batch.save(tmp_path / "run.nc")
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    assert one_sentence(path)


def test_damaged_zarr(tmp_path, batch):
    path = batch.save(tmp_path / "run.zarr")
    chunks = sorted(p for p in path.rglob("*") if p.is_file() and p.name != "zarr.json")
    assert {p.relative_to(path).parts[0] for p in chunks} >= {"q", "p", "time", "energy"}
    for number, chunk in enumerate(chunks):
        copy = tmp_path / f"copy{number}.zarr"
        shutil.copytree(path, copy)
        target = copy / chunk.relative_to(path)
        if number % 2:
            target.unlink()
        else:
            target.write_bytes(target.read_bytes()[:-3])
        assert one_sentence(copy)
    shutil.rmtree(path / "q")
    assert "variable q is missing" in one_sentence(path)


def test_one_flipped_bit_is_noticed(tmp_path, two_points):
    path = two_points.save(tmp_path / "run.nc")
    content = bytearray(path.read_bytes())
    at = content.find(np.asarray(two_points.q).tobytes()[:48])
    assert at > 0
    content[at + 20] ^= 1
    path.write_bytes(content)
    assert "it is not what was saved" in one_sentence(path)
    path.write_bytes(content[:-16])  # without the checksum of the whole, as the first files are
    assert "variable q is not what was saved" in one_sentence(path)


def edited(path, change):
    """The zarr store with its attributes changed."""
    file = path / "zarr.json"
    node = json.loads(file.read_text())
    node["attributes"].pop(saving.SEAL, None)  # as in the first files, so that what is said is looked at
    change(node["attributes"])
    file.write_text(json.dumps(node))


@pytest.mark.parametrize(
    "name, value",
    [
        ("fields", "[]]"),
        ("fields", '{"q": 1}'),
        ("fields", '[{"name": "q"}]'),
        ("stats", None),
        ("step", "soon"),
        ("message", "[1, 2]"),
        ("params", '{"call": "os.system"}'),
        ("params", '{"array": [1], "dtype": "object", "shape": [1]}'),
        ("initial", '["nothing"]'),
        ("checksums", "{}"),
        ("dirax_format", "one"),
        ("dirax_format", 0),
        ("dirax_format", 1.5),
        ("dirax_format", True),
        ("step", -1.0),
        ("step", 0.0),
        ("step", float("nan")),
        ("step", float("inf")),
        ("save_every", -5),
        ("save_every", 0),
        ("save_every", 2.0),
        ("save_every", 10**30),
        ("save_every", 5),  # every second was
        ("step", 1e30),
        ("step", 0.011),
        ("batch_params", -1),
        ("batch_params", 2),
        ("ok", '"maybe"'),
        ("message", '{"0": 3}'),
        ("batch_params", "no"),
        ("checksums", "[]"),
        ("stats", "[]"),
        ("derived", '["fields"]'),
        ("initial", '["q", "q"]'),
        ("fields", "[" * 100_000),
        ("metadata", '{"coordinates": [1, 2, 3]}'),
        ("metadata", '{"units": {"q": 3}}'),
        ("scheme_settings", '{"class": "PlusLagrangeDirac", "module": "dirax.schemes.lagrange_dirac", "settings": {"x": 1}}'),
    ],
)
def test_crafted_attributes(name, value, tmp_path, batch):
    path = batch.save(tmp_path / "run.zarr")
    edited(path, lambda attributes: attributes.update({name: value}))
    assert one_sentence(path)


@pytest.mark.parametrize("change", ["shape", "place", "more", "variable"])
def test_fields_that_are_not_as_described(change, tmp_path, batch):
    path = batch.save(tmp_path / "run.zarr")

    def changed(attributes):
        fields = json.loads(attributes["fields"])
        if change == "more":
            fields.append({**fields[0], "name": "r", "variable": "r"})
        else:
            fields[0][change] = {"shape": [2], "place": "step", "variable": "p"}[change]
        attributes["fields"] = json.dumps(fields)

    edited(path, changed)
    assert one_sentence(path)


def rewritten(path, sol, **arrays):
    """A file as `save` writes it, with other arrays and the checksums that belong to them."""
    said = describe(sol)
    variables = {**said.variables, **said.axes}
    for name, values in arrays.items():
        variables[name] = Variable(variables[name].dims, values)
    variables, attributes = saving.file_form(Description(variables, {}, said.attributes))
    saving.FORMATS[path.suffix][0](path, variables, attributes)
    return path


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.soak_of(".nc")
def test_times_that_do_not_increase(ending, tmp_path, two_points):
    assert_same(dx.load(rewritten(tmp_path / f"good{ending}", two_points)), two_points)
    down, nan = two_points.t.copy(), two_points.t.copy()
    down[2], nan[3] = -1.0, np.nan
    for number, t in enumerate((down, nan)):
        path = rewritten(tmp_path / f"run{number}{ending}", two_points, time=t, interval=t[:-1])
        assert "times do not increase" in one_sentence(path)
    path = rewritten(tmp_path / f"steps{ending}", two_points, interval=two_points.t[1:])
    assert "steps do not begin" in one_sentence(path)


def test_stores_with_links_and_codecs_of_another_kind(tmp_path, batch):
    good = batch.save(tmp_path / "good.zarr")
    linked = tmp_path / "linked.zarr"
    shutil.copytree(good, linked)
    shutil.rmtree(linked / "q")
    (linked / "q").symlink_to(good / "q")
    assert "q is a link" in one_sentence(linked)
    node = json.loads((good / "q" / "zarr.json").read_text())
    first = node["codecs"][0]
    for codecs in (None, [], "zstd", [3], [{"name": "zstd"}], [first, first], [{"name": "bytes", "configuration": 3}]):
        (good / "q" / "zarr.json").write_text(json.dumps(node | {"codecs": codecs}))
        assert one_sentence(good)
    for change in ({"shape": [-1]}, {"shape": 3}, {"chunk_grid": None}, {"attributes": []}, {"data_type": ["float64"]}):
        (good / "q" / "zarr.json").write_text(json.dumps(node | change))
        assert one_sentence(good)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="other systems have no pipes among files")
@pytest.mark.parametrize("place", ["zarr.json", "q/zarr.json", "q/c/0/0/0"])
def test_pipes_and_devices_are_not_read(place, tmp_path, batch):
    """They may have no end: one that is read waits for ever, or takes all memory."""
    path = batch.save(tmp_path / "run.zarr")
    (path / place).unlink()
    os.mkfifo(path / place)
    assert f"{place} is a pipe" in one_sentence(path)
    (path / place).unlink()
    (path / place).symlink_to("/dev/zero")
    assert f"{place} is a link" in one_sentence(path)


def test_a_description_and_a_chunk_have_no_more_bytes_than_belong_there(tmp_path, batch):
    path = batch.save(tmp_path / "run.zarr")
    for place in ("q/c/0/0/0", "zarr.json"):
        os.truncate(path / place, 2**40)  # a file that is empty on the disk
        assert "bytes" in one_sentence(path)


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("name", ["q", "time", "energy", "initial_v"])
@pytest.mark.soak_of("q-.nc", "time-.nc", "energy-.nc", "initial_v-.nc")
def test_numbers_of_another_type_are_not_taken_for_floats(name, ending, tmp_path, batch):
    """The same bytes as whole numbers have the same checksum: q was 4607182418800017408."""
    path = batch.save(tmp_path / f"run{ending}")
    if ending == ".zarr":
        file = path / name / "zarr.json"
        file.write_text(file.read_text().replace('"float64"', '"int64"'))
    else:
        h5py = pytest.importorskip("h5py")
        with h5py.File(path, "r+") as store:
            values = store[name][()].view(np.int64)
            del store[name], store.attrs[saving.SEAL]
            store[name] = values
    assert f"variable {name} holds int64, and dirax writes float64 there" in one_sentence(path)


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_folder_or_a_file_in_the_place_of_the_other(ending, tmp_path):
    (tmp_path / "folder.nc").mkdir()
    (tmp_path / "file.zarr").write_text("")
    assert one_sentence(tmp_path / "folder.nc") and one_sentence(tmp_path / "file.zarr")


def test_sizes_are_read_before_numbers(tmp_path, batch):
    """Arrays of 4e8 zeros in a few kilobytes are refused without being unpacked."""
    h5py = pytest.importorskip("h5py")
    extra = batch.save(tmp_path / "extra.nc")
    with h5py.File(extra, "r+") as store:
        store.create_dataset("zeros", (400_000_000,), "f8", chunks=(1_000_000,), compression="gzip")
    within = batch.save(tmp_path / "within.nc")
    with h5py.File(within, "r+") as store:
        del store["p"]
        store.create_dataset("p", (400_000_000,), "f8")
    packed = batch.save(tmp_path / "packed.zarr")
    node = json.loads((packed / "p" / "zarr.json").read_text())
    node["codecs"].append({"name": "zstd", "configuration": {"level": 0, "checksum": False}})
    (packed / "p" / "zarr.json").write_text(json.dumps(node))
    (packed / "p" / "c" / "0" / "0" / "0").write_bytes(zstd.compress(bytes(2**27), 1))
    tracemalloc.start()
    try:
        for path in (extra, within, packed):
            assert one_sentence(path)
        assert tracemalloc.get_traced_memory()[1] < 2**24
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.soak_of(".nc")
def test_files_of_the_first_version(ending, tmp_path):
    """A batch of two skates, saved by dirax 0.1.0 through xarray."""
    path = FILES / "first.nc"
    if ending == ".zarr":
        shutil.unpack_archive(FILES / "first.zarr.zip", tmp_path / "first.zarr")
        path = tmp_path / "first.zarr"
    loaded = dx.load(path, system=SKATE)
    assert loaded.scheme == dx.PlusLagrangeDirac() and loaded.metadata["note"] == "ü" * 3000
    assert loaded.metadata["coordinates"] == ["x", "y", "φ"] and loaded.ok.tolist() == [True, True]
    again = dx.simulate(SKATE, loaded.scheme, **loaded.initial, params=loaded.params, step=loaded.step, steps=5, save_every=2)
    np.testing.assert_allclose(again.q, loaded.q, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(again.energy(), loaded.derived["energy"], rtol=1e-12)
    assert_same(dx.load(loaded.save(tmp_path / f"again{ending}")), loaded)


@pytest.mark.parametrize("sealed", [False, True])
@pytest.mark.soak_of("True")
def test_a_netcdf_file_in_circles_is_refused(tmp_path, monkeypatch, sealed):
    """A list of free places that goes on at itself, in a file without a checksum or with the right one: the HDF5 library never
    ends."""
    import h5py

    path = tmp_path / "circle.nc"
    with h5py.File(path, "w", libver="earliest") as file:
        file["a"] = file["b"] = np.arange(3.0)
    raw = bytearray(path.read_bytes())
    heap, number = raw.index(b"HEAP"), lambda place: int.from_bytes(raw[place : place + 8], "little")
    free, data = number(heap + 16), number(heap + 24)
    raw[data + free : data + free + 8] = free.to_bytes(8, "little")
    seal = netcdf.SEAL + zlib.crc32(raw).to_bytes(4, "little")
    path.write_bytes(raw + (seal if sealed else b""))
    monkeypatch.setattr(netcdf, "LIMIT", 1.0)
    assert "did not come to an end of it within 1 s" in one_sentence(path)


@pytest.mark.parametrize("ending", ENDINGS)
def test_long_arrays_go_through_chunks_and_compression(ending, tmp_path, monkeypatch):
    monkeypatch.setattr(zarr_store, "CHUNK", 4000)
    monkeypatch.setattr(zarr_store, "SMALL", 2000)
    random = np.random.default_rng(0)
    info = {"q": dx.Field((3,)), "flag": dx.Field((2, 2), "step", ("a", "b"))}
    fields = {"q": random.normal(size=(2, 301, 3)), "flag": random.integers(0, 9, (2, 300, 2, 2))}
    sol = dx.Solution(t=np.arange(301.0), fields=fields, field_info=info, step=1.0, save_every=1, stats={}, ok=np.ones(2, bool))
    path = sol.save(tmp_path / f"run{ending}")
    loaded = dx.load(path)
    for name in fields:
        assert bits(loaded.fields[name]) == bits(fields[name])
    if ending == ".zarr":
        assert len([p for p in (path / "q" / "c").rglob("*") if p.is_file()]) == 4
        with xr.open_zarr(path, consolidated=False) as data:
            np.testing.assert_array_equal(data.q, fields["q"])


# ------------------------------------------------------------------------------------------------------------------- fuzz


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.soak_of(".nc")
def test_a_flipped_bit_anywhere_is_a_sentence_or_changes_nothing(ending, tmp_path, two_points):
    path = two_points.save(tmp_path / f"run{ending}")
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    random = np.random.default_rng(5)
    sizes = np.cumsum([file.stat().st_size for file in files])
    refused = 0
    for bit in random.integers(0, 8 * sizes[-1], 200).tolist():
        number = int(np.searchsorted(sizes, bit // 8, side="right"))
        content = files[number].read_bytes()
        damaged = bytearray(content)
        damaged[bit // 8 - (sizes[number - 1] if number else 0)] ^= 1 << bit % 8
        files[number].write_bytes(damaged)
        try:
            loaded = dx.load(path)
            for name in two_points.fields:
                assert bits(loaded.fields[name]) == bits(two_points.fields[name])
        except ValueError as error:
            assert str(error).startswith(f"{path} cannot be loaded: ") and "\n" not in str(error)
            refused += 1
        files[number].write_bytes(content)
    assert refused > 50
    assert_same(dx.load(path), two_points)


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.soak_of(".nc")
def test_an_edited_description_is_noticed(ending, tmp_path, batch):
    path = batch.save(tmp_path / f"run{ending}")
    if ending == ".zarr":
        file = path / "zarr.json"
        file.write_text(file.read_text().replace('"step": 0.01', '"step": 0.02'))
    else:
        h5py = pytest.importorskip("h5py")
        with h5py.File(path, "r+") as store:
            store.attrs["step"] = 0.02
    assert "its description is not what was saved" in one_sentence(path)


def test_a_later_format_is_refused(tmp_path, batch):
    path = batch.save(tmp_path / "run.zarr")
    edited(path, lambda attributes: attributes.update(dirax_format=2))
    assert "later dirax (format 2, this one reads 1): update dirax" in one_sentence(path)


def test_only_schemes_of_dirax_are_made_from_a_file(tmp_path, batch):
    class Evil(dx.AbstractScheme):
        command: str = ""

        def __init__(self, command=""):
            raise AssertionError("executed")

        def step_equation(self, system, shape):
            raise AssertionError("executed")

    path = batch.save(tmp_path / "run.zarr")
    for module in (Evil.__module__, "dirax.schemes.lagrange_dirac"):
        record = {"class": "Evil", "module": module, "settings": {"command": {"plain": "rm"}}}
        edited(path, lambda attributes, record=record: attributes.update(scheme_settings=json.dumps(record)))
        assert dx.load(path).scheme is None


class Bomb:
    """Unpickling it creates a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (self.path, "w")


def test_pickles_are_never_opened(tmp_path, batch):
    """A zarr store of format 2 whose chunk is a pickle, whole or as an array inside a good store; npz and pickle files."""
    mark = tmp_path / "executed"
    bomb = pickle.dumps(np.array([Bomb(str(mark))], dtype=object))
    array = {
        "zarr_format": 2,
        "shape": [1],
        "chunks": [1],
        "dtype": "|O",
        "compressor": None,
        "fill_value": None,
        "order": "C",
        "filters": [{"id": "pickle"}],
    }
    whole = tmp_path / "whole.zarr"
    (whole / "q").mkdir(parents=True)
    (whole / ".zgroup").write_text('{"zarr_format": 2}')
    (whole / ".zattrs").write_text('{"dirax_format": 1}')
    inside = batch.save(tmp_path / "inside.zarr") / "q"
    shutil.rmtree(inside)
    inside.mkdir()
    for folder in (whole / "q", inside):
        (folder / ".zarray").write_text(json.dumps(array))
        (folder / "0").write_bytes(bomb)
    assert one_sentence(whole)
    assert "format 2" in one_sentence(inside.parent)
    for name in ("plain.nc", "plain.zarr"):
        (tmp_path / name).write_bytes(bomb)
        assert one_sentence(tmp_path / name)
    with zipfile.ZipFile(tmp_path / "zip.nc", "w") as archive:
        archive.writestr("q.npy", bomb)
    assert one_sentence(tmp_path / "zip.nc")
    assert not mark.exists()


def test_unknown_codecs_types_and_object_arrays_are_refused(tmp_path, batch):
    path = batch.save(tmp_path / "run.zarr")
    file = path / "q" / "zarr.json"
    good = json.loads(file.read_text())
    for change, words in (
        ({"codecs": [{"name": "numcodecs.pickle"}]}, "is encoded by 'numcodecs.pickle'"),
        ({"data_type": "variable_length_bytes"}, "the data type 'variable_length_bytes'"),
        ({"data_type": {"name": "struct"}}, ""),
        ({"storage_transformers": [{"name": "x"}]}, "storage transformers"),
        ({"node_type": "spell"}, "neither a group nor an array"),
    ):
        file.write_text(json.dumps(good | change))
        assert words in one_sentence(path)
    h5py = pytest.importorskip("h5py")
    path = batch.save(tmp_path / "run.nc")
    with h5py.File(path, "r+") as store:
        store["text"] = np.array(["a"], dtype=object)
    assert "variable text has the type" in one_sentence(path)


def test_netcdf_links_to_other_files_are_refused(tmp_path, batch):
    h5py = pytest.importorskip("h5py")
    path = batch.save(tmp_path / "run.nc")
    with h5py.File(path, "r+") as store:
        store["elsewhere"] = h5py.ExternalLink("other.nc", "/q")
    assert "its entry elsewhere is a link" in one_sentence(path)
