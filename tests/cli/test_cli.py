"""The command line, as a user types it."""

import errno
import gc
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import dirax as dx
from dirax import gallery
from dirax.cli import terminal
from dirax.cli.commands import app
from dirax.cli.schemes import scheme_from_text
from dirax.cli.subject import changed, from_file
from dirax.gallery import peng_yoshimura, reproduction
from dirax.gallery.listing import listing
from dirax.solution import saving
from dirax.solution.style import new_figure

SPRING = """
import dirax as dx
system = dx.LagrangeDirac(lambda q, v, params: v @ v / 2 - params["k"] * (q @ q) / 2)
initial = dict(q=[1.0], v=[0.0])
params = {"k": 4.0}
step, steps = 0.05, 40
"""
FALLING = """
import jax.numpy as jnp
import dirax as dx
system = dx.LagrangeDirac(lambda q, v: v @ v / 2 + jnp.sqrt(q[0]) - 2 * q[0])
initial = dict(q=[0.1], v=[-1.0])
scheme = dx.PlusLagrangeDirac()
"""


def call(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture
def spring(tmp_path):
    path = tmp_path / "spring.py"
    path.write_text(SPRING, encoding="utf-8")
    return path


def test_list_shows_every_system_and_paper():
    text, described = call("list").stdout, json.loads(call("list", "--json").stdout)
    assert [system["name"] for system in described["systems"]] == list(gallery.names())
    assert described["papers"] == list(reproduction.papers())
    assert all(name in text for name in (*gallery.names(), *reproduction.papers()))


def test_run_prints_the_report_and_saves_once(tmp_path):
    path = tmp_path / "kepler.zarr"
    arguments = ("run", "kepler", "--set", "steps=200", "--out", path)
    result = call(*arguments)
    assert result.exit_code == 0, result.output
    assert "symplecticity" in result.stdout and "angular momentum" in result.stdout
    loaded = dx.load(path)
    assert loaded.q.shape == (201, 2) and loaded.metadata["coordinates"] == ["x", "y"]
    again = call(*arguments)
    assert again.exit_code == 1 and "exists" in again.stderr and "--overwrite" in again.stderr
    assert call(*arguments[:3], "steps=10", *arguments[4:], "--overwrite").exit_code == 0
    assert dx.load(path).q.shape == (11, 2)


def test_a_run_that_cannot_be_saved_is_shown(spring, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setitem(saving.FORMATS, ".nc", (full, Path.is_file))
    path = tmp_path / "run.nc"
    result = call("run", spring, "--out", path)
    assert result.exit_code == 1 and "steps solved" in result.stdout and "saved in" not in result.stdout
    assert f"dirax: {path} cannot be written (there is no space left for it)" in result.stderr
    assert json.loads(call("run", spring, "--out", path, "--json").stdout)["saved"] is None
    monkeypatch.setattr(os, "access", lambda *_: False)  # before anything is run
    for command in (("run", spring), ("report", spring), ("export", "c", spring), ("bench", "--json", path)):
        place = (
            ()
            if command[0] == "bench"
            else ("--out", path.with_suffix({"report": ".html", "export": ".c"}.get(command[0], ".nc")))
        )
        result = call(*command, *place)
        assert result.exit_code == 1 and "is read-only here" in result.stderr and not result.stdout


def test_run_a_file_as_json(spring, tmp_path):
    out = tmp_path / "spring.nc"
    result = call("run", spring, "--set", "k=1", "--set", "q=[2.0]", "--scheme", "plus", "--json", "--out", out)
    assert result.exit_code == 0, result.output
    described = json.loads(result.stdout)
    x, p, expected = 2.0, 0.0, []
    for _ in range(41):  # p_{k+1} = (q_{k+1} − q_k)/h and p_k − h q_k = p_{k+1}: symplectic Euler
        expected.append(x)
        p -= 0.05 * x
        x += 0.05 * p
    assert dx.load(out).q[:, 0] == pytest.approx(expected, abs=1e-12)
    assert described["q"] == pytest.approx([expected[-1]], abs=1e-12)
    assert described["ok"] is True and described["t"] == pytest.approx(2.0) and described["saved"] == str(out)
    assert {line["quantity"] for line in described["report"]["lines"]} >= {"energy", "symplecticity of one step"}


def test_a_failed_trajectory_has_a_message_and_a_status(tmp_path):
    path = tmp_path / "falling.py"
    path.write_text(FALLING, encoding="utf-8")
    result = call("run", path)
    assert result.exit_code == 1 and "kept up to step" in result.stderr
    described = call("run", path, "--json")
    assert described.exit_code == 1 and json.loads(described.stdout)["ok"] is False
    compared = call("compare", path, "--scheme", "plus")
    assert compared.exit_code == 1 and "stopped at t" in compared.stderr


def test_compare_measures_the_orders_of_named_schemes(spring):
    result = call("compare", spring, "--scheme", "plus", "--scheme", "midpoint", "--json")
    assert result.exit_code == 0, result.output
    orders = {entry["scheme"]: entry["order"] for entry in json.loads(result.stdout)["schemes"]}
    assert orders == pytest.approx({"plus": 1, "midpoint": 2}, abs=0.1)


def test_compare_finds_the_schemes_that_suit_a_system():
    result = call("compare", "vortices", "--set", "steps=20", "--json")
    assert result.exit_code == 0, result.output  # the (+) scheme and its kind take Lagrange–Dirac systems only
    assert [entry["scheme"] for entry in json.loads(result.stdout)["schemes"]] == ["method1", "method2"]


@pytest.mark.soak
def test_compare_finds_every_lagrangian_scheme_for_nonholonomic_mechanics():
    result = call("compare", "knife-edge", "--set", "steps=20", "--json")
    assert result.exit_code == 0, result.output
    orders = {entry["scheme"]: entry["order"] for entry in json.loads(result.stdout)["schemes"]}
    expected = {"plus": 1, "minus": 1, "midpoint": 2, "trapezoidal": 2, "method1": 2, "method2": 2}
    assert orders == pytest.approx(expected, abs=0.1)


def test_compare_has_the_exact_energy_of_discrete_gradients_where_there_is_a_hamiltonian():
    result = call("compare", "magnetic-spherical-pendulum", "--set", "steps=200", "--json")
    assert result.exit_code == 0, result.output
    entries = {entry["scheme"]: entry for entry in json.loads(result.stdout)["schemes"]}
    assert list(entries) == ["method1", "method2", "gradient"] and entries["gradient"]["energy_band"] < 1e-14


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("run", "keplr"), "did you mean 'kepler'"),
        (("run", "nowhere.py"), "there is no file nowhere.py"),
        (("run", os.curdir), ". is no Python file: give one that ends in .py"),
        (("run", "kepler", "--set", "steps"), "key=value"),
        (("run", "kepler", "--set", "stpes=3"), "did you mean steps"),
        (("run", "kepler", "--set", "steps=0"), "steps must be a whole number"),
        (("run", "kepler", "--set", "step=1 2"), "cannot read the value '1 2' of step"),
        (("run", "kepler", "--set", "q[2]=1"), "q has no entry '2'"),
        (("run", "kepler", "--set", "q=[[]"), "cannot read the value"),
        (("run", "kepler", "--set", "q=['a']"), "q must be a list of numbers"),
        (("run", "kepler", "--set", "q=[0,0]"), "domain"),
        (("run", "rolling-disk", "--set", "v=[1,0,0,0]"), "off the constraint"),
        (("run", "kepler", "--scheme", "plsu"), "did you mean 'plus'"),
        (("run", "kepler", "--scheme", "plus()("), "cannot read the scheme"),
        (("run", "vortices", "--scheme", "plus"), "PhaseSpaceLagrangian"),
        (("run", "kepler", "--out", "somewhere.txt"), ".zarr or .nc"),
        (("run", "kepler", "--out", "no/such/folder.nc"), "the folder no/such does not exist"),
        (("compare", "kepler", "--scheme", "midpiont"), "did you mean 'midpoint'"),
        (("reproduce", "XY"), "choose one of PY"),
    ],
)
def test_mistakes_end_with_a_sentence_and_a_status(arguments, message):
    result = call(*arguments)
    assert result.exit_code == 1 and isinstance(result.exception, SystemExit)
    assert message in result.stderr and result.stdout == ""
    assert len(result.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    "text, message",
    [
        ("x = (", "line 1"),
        ("x = 1\0", "bad.py: source code"),
        ("\nimport dirax\n1 / 0\n", "line 3: ZeroDivisionError"),
        ("initial = {}", "does not define `system`"),
        ("system = 3\ninitial = dict(q=[0.0])", "`system`"),
        ("import dirax as dx\nsystem = dx.LagrangeDirac(lambda q, v: v @ v)\ninitial = dict(q=[0.0], w=[1.0])", "`initial`"),
        (
            "import dirax as dx\nsystem = dx.LagrangeDirac(lambda q, v: v @ v)\ninitial = dict(q=[0.], v=[0.])\nscheme = 1",
            "`scheme`",
        ),
    ],
)
def test_a_file_that_does_not_fit_is_explained(tmp_path, text, message):
    path = tmp_path / "bad.py"
    path.write_text(text, encoding="utf-8")
    result = call("run", path)
    assert result.exit_code == 1 and isinstance(result.exception, SystemExit)
    assert message in result.stderr and "bad.py" in result.stderr and len(result.stderr.splitlines()) == 1


def test_schemes_are_read_without_evaluating_anything():
    scheme = scheme_from_text("DiscreteDirac(map=Theta(0.25), constraints='resolve')")
    assert isinstance(scheme, dx.DiscreteDirac) and (scheme.map.theta, scheme.constraints) == (0.25, "resolve")
    composed = scheme_from_text("Composition(midpoint, [0.5, 0.5])")
    assert isinstance(composed, dx.Composition) and composed.coefficients == (0.5, 0.5)
    assert scheme_from_text("LagrangeDAlembert") == dx.LagrangeDAlembert()
    with pytest.raises(ValueError, match=r"cannot read .*__import__"):
        scheme_from_text("LagrangeDAlembert(__import__('os').name)")


@pytest.mark.parametrize(
    "text",
    ["print(1)", "Theta(0.5)", "(lambda: 0)()", "LagrangeDAlembert(**{})", "dx.PlusLagrangeDirac()", "midpoint.scheme", "3", ""],
)
def test_what_is_not_a_scheme_is_refused(text):
    with pytest.raises(ValueError, match=r"scheme|write every argument"):
        scheme_from_text(text)


def test_settings_change_data_params_and_run():
    disk = gallery.get("rolling-disk")
    example, options = changed(disk, ["q[φ]=0.5", "v[0]=-1", "m=2", "steps=1e3", "step=0.01", "save_every=5", "engine=xla"])
    assert example.initial["q"].tolist() == [0.0, 0.0, 0.0, 0.5] and example.initial["v"][0] == -1.0
    assert example.params == {**disk.params, "m": 2.0} and isinstance(example.params["m"], float)
    assert (example.steps, example.step, options) == (1000, 0.01, {"save_every": 5, "engine": "xla"})
    assert disk.initial["q"][3] == pytest.approx(np.pi / 3) and disk.params["m"] == 1.0  # the gallery's own stays as it was
    example, _ = changed(disk, ["p=[1, 2, 3, 4]"])
    assert set(example.initial) == {"q", "p"}
    example, _ = changed(disk, ["q0=[0,0,0,0]", "q1=[0,0,0,1]"])
    assert set(example.initial) == {"q0", "q1"}


@pytest.mark.parametrize("name", gallery.names())
@pytest.mark.soak_of("wave-line")
def test_settings_keep_what_is_not_a_number(name):
    example, _ = changed(gallery.get(name), ())
    for key, value in gallery.get(name).initial.items():
        assert type(example.initial[key]) is type(value) if isinstance(value, bool) else np.all(example.initial[key] == value)


def test_reproduce_writes_and_prints_and_fails_where_a_number_differs(tmp_path, monkeypatch):
    def paper(verdict):
        row = reproduction.Row("a quantity", "1", "2", verdict, "a note", {"value": np.float64(2.0)})
        return reproduction.Reproduction("PY", "A paper", (row, row), {"figure_1": new_figure()[0]})

    monkeypatch.setattr(peng_yoshimura, "reproduction", lambda progress: paper(reproduction.WRONG))
    good = call("reproduce", "py", "--out", tmp_path)
    assert good.exit_code == 0 and "paper is wrong" in good.stdout and good.stdout.count("[1] a note") == 1
    assert (tmp_path / "PY" / "figure_1.png").read_bytes().startswith(b"\x89PNG")
    assert json.loads((tmp_path / "table.json").read_text("utf-8"))[0]["rows"][0]["numbers"] == {"value": 2.0}
    assert "a quantity" in (tmp_path / "table.txt").read_text("utf-8")
    monkeypatch.setattr(peng_yoshimura, "reproduction", lambda progress: paper(reproduction.DIFFERS))
    bad = call("reproduce", "PY", "--out", tmp_path, "--json")
    assert bad.exit_code == 1 and json.loads(bad.stdout)[0]["ok"] is False and "DIFFERS" in bad.stderr


# ------------------------------------------------------------------------------------------------------ the program as it is


def program(*arguments, before="", redirected="", **options):
    """`dirax` as a process of its own, its streams redirected as a shell does."""
    code = f"import sys; sys.argv[0] = 'dirax'\n{before}\nfrom dirax.cli import main\nmain()"
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options}
    shell = ["sh", "-c", f'exec "$@" {redirected}', "sh"] if redirected else []
    return subprocess.Popen([*shell, sys.executable, "-c", code, *map(str, arguments)], **options)


def ended(process):
    out, err = process.communicate(timeout=120)
    text = (err or b"").decode()
    assert "Traceback" not in text
    return process.returncode, (out or b"").decode("latin-1"), text


def test_list_and_help_do_not_import_jax():
    after = "import atexit; atexit.register(lambda: print('jax' in sys.modules, 'numpy' in sys.modules, file=sys.stderr))"
    for command in ("list", "--help"):
        status, out, err = ended(program(command, before=after))
        assert (status, err.split()) == (0, ["False", "False"]) and "reproduce" in out


@pytest.mark.soak
def test_the_package_is_the_program():
    run = lambda *command: subprocess.run([sys.executable, *command, "list"], capture_output=True, text=True, timeout=120)
    assert run("-m", "dirax").stdout == run("-c", "from dirax.cli import main; main()").stdout == call("list").stdout


def test_the_listing_says_what_the_examples_say():
    examples = [gallery.get(name) for name in gallery.names()]
    assert listing() == [(e.name, e.title, e.source) for e in examples]


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_a_reader_that_stops_ends_the_program():
    reader, writer = os.pipe()
    process = program("list", stdout=writer)
    os.close(writer)
    os.close(reader)
    assert ended(process) == (-signal.SIGPIPE, "", "")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
@pytest.mark.parametrize("command", ["list", "--help"])
def test_a_full_disk(command):
    with open("/dev/full", "w") as full:
        status, _, err = ended(program(command, stdout=full))
    assert status == 1 and "could not be written: No space left" in err and len(err.splitlines()) == 1


@pytest.mark.skipif(os.name != "posix", reason="file descriptors of POSIX")
def test_closed_streams():
    status, _, err = ended(program("list", redirected=">&-"))
    assert status == 1 and err.startswith("dirax: standard output is closed") and len(err.splitlines()) == 1
    status, out, _ = ended(program("list", redirected="2>&-"))
    assert status == 0 and "kepler" in out


@pytest.mark.parametrize("encoding", ["latin-1", "ascii"])
@pytest.mark.soak_of("latin-1")
def test_encodings_that_lack_signs(encoding):
    environment = {**os.environ, "PYTHONIOENCODING": encoding, "PYTHONUTF8": "0"}
    status, out, _ = ended(program("list", env=environment))
    assert status == 0 and ("Barbero Liñán" in out or encoding == "ascii")  # click writes UTF-8 where ASCII is said
    assert terminal._simpler(UnicodeEncodeError("ascii", "θ₁ ─ −φ ☃", 0, 9, "")) == ("theta1 - -phi ?", 9)


@pytest.mark.parametrize("columns", [1, 20])
def test_narrow_terminals(columns):
    environment = {**os.environ, "COLUMNS": str(columns), "FORCE_COLOR": "1", "TERM": "xterm"}
    for arguments in (("list",), ("--help",), ("run", "--help"), ("run",)):
        status, out, err = ended(program(*arguments, env=environment))
        assert status == (2 if arguments == ("run",) else 0) and out + err


@pytest.mark.parametrize(
    "setting",
    ["q=" + "[" * 50_000, "q=" + "9" * 50_000, "a" * 50_000 + "=1", "=" * 50_000, "a" * 50_000, "q[" + "1" * 50_000 + "]=1"],
)
def test_settings_of_any_length(setting):
    result = call("run", "kepler", "--set", setting)
    assert result.exit_code == 1 and isinstance(result.exception, SystemExit)
    assert len(result.stderr) < 400 and len(result.stderr.splitlines()) == 1


@pytest.mark.parametrize("text", ["(" * 50_000, "plus" * 20_000, "LagrangeDAlembert(" * 5_000 + ")" * 5_000, "-" * 50_000 + "1"])
def test_schemes_of_any_length(text):
    result = call("run", "kepler", "--scheme", text)
    assert result.exit_code == 1 and isinstance(result.exception, SystemExit)
    assert len(result.stderr) < 400 and len(result.stderr.splitlines()) == 1


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize("moment", ["import dirax.cli.commands", "import dirax.gallery", "import jax"])
def test_an_interruption_at_any_moment(moment):
    """Ctrl-C in the middle of an import: of the commands, of a command's own modules, of JAX."""
    name = moment.removeprefix("import ")
    before = f"""
import os, signal
class Interrupts:
    def find_spec(self, name, path=None, target=None):
        if name == {name!r}:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupts())
"""
    status, out, err = ended(program("run", "kepler", before=before))
    assert (status, out, err.strip()) == (130, "", "dirax: interrupted.")


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize("moment", ["ast", "dirax.float64", "dirax.cli", "dirax.cli.terminal"])
@pytest.mark.parametrize("started", ["module", "script"])
def test_an_interruption_while_the_package_is_loaded(moment, started, tmp_path):
    """Before the commands can see to it, of `python -m dirax` and of the script `dirax`."""
    interrupts = f"""
import os, signal, sys
class Interrupts:
    def find_spec(self, name, path=None, target=None):
        if name == {moment!r}:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupts())
sys.modules.pop("ast", None)
"""
    (tmp_path / "sitecustomize.py").write_text(interrupts)
    (tmp_path / "dirax").write_text("from dirax.cli import main\nmain()\n")
    (tmp_path / "bin").mkdir()
    script = (tmp_path / "dirax").rename(tmp_path / "bin" / "dirax")
    path = os.pathsep.join([str(tmp_path), str(Path(dx.__file__).parents[1])])
    command = ["-m", "dirax"] if started == "module" else [str(script)]
    process = subprocess.Popen(
        [sys.executable, *command, "list"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": path},
    )
    status, out, err = ended(process)
    assert (status, out, err.strip()) == (130, "", "dirax: interrupted.")


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_an_interruption_that_an_import_would_lose():
    before = """
import os, signal
class Interrupts:
    def find_spec(self, name, path=None, target=None):
        if name == "dirax.gallery":
            try:
                os.kill(os.getpid(), signal.SIGINT)
            except KeyboardInterrupt:
                pass
sys.meta_path.insert(0, Interrupts())
"""
    status, out, err = ended(program("list", "--json", before=before))
    assert (status, out, err.strip()) == (130, "", "dirax: interrupted.")


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_an_interruption_while_garbage_is_collected(capsys):
    interrupt = lambda phase, _: phase == "start" and signal.raise_signal(signal.SIGINT)
    handler = signal.getsignal(signal.SIGINT)
    try:
        with pytest.raises(SystemExit, match="130"), terminal.interruptible():
            gc.callbacks.append(interrupt)
            gc.collect(0)
            gc.callbacks.remove(interrupt)
            time.sleep(5)
    finally:
        signal.signal(signal.SIGINT, handler)
    assert capsys.readouterr().err == "dirax: interrupted.\n"


def test_another_program_keeps_its_own_interruptions():
    code = "import signal, dirax; print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "True"


@pytest.mark.parametrize(
    ("system", "initial", "scheme"),
    [
        ("dx.PortHamiltonian(lambda x: x @ x / 2, J=[[0.0, 1.0], [-1.0, 0.0]])", "dict(x=[1.0, 0.0])", "DiscreteGradient"),
        ("dx.EulerPoincare(dx.SO3(), lambda xi: xi @ xi / 2)", "dict(x=system.state([0.1, 0.2, 1.0]))", "DiscreteEulerPoincare"),
    ],
)
@pytest.mark.soak_of(
    "dx.EulerPoincare(dx.SO3(), lambda xi: xi @ xi / 2)-dict(x=system.state([0.1, 0.2, 1.0]))-DiscreteEulerPoincare"
)
def test_a_file_without_a_scheme_has_the_first_that_suits_it(tmp_path, system, initial, scheme):
    """It finds modules that lie beside it, too."""
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "beside_it.py").write_text("steps = 20\n", encoding="utf-8")
    file = tmp_path / "folder" / "mine.py"
    text = f"import dirax as dx\nfrom beside_it import steps\nsystem = {system}\ninitial = {initial}\n"
    file.write_text(text, encoding="utf-8")
    example = from_file(file)
    assert type(example.scheme).__name__ == scheme and example.steps == 20
    assert example.simulate().ok


def test_a_file_says_what_else_a_run_takes(tmp_path):
    file = tmp_path / "ball.py"
    ball = "import dirax as dx\nsystem = dx.LagrangeDirac(lambda q, v: v @ v / 2 - q[0])\nstep, steps = 0.05, 40\n"
    more = "events = [dx.Impact(lambda q: q[0])]\nt0, save_every = 1.0, 2\n"
    file.write_text(ball + more + "initial = dict(q=[0.3], v=[0.4])\n", encoding="utf-8")
    example = from_file(file)
    sol = example.simulate()
    assert len(sol.impacts) == 1 and float(sol.t[0]) == 1.0 and sol.rows == 21
    found = json.loads(call("run", file, "--set", "save_every=1", "--json").stdout)
    assert found["t"] == 3.0 and any(line["quantity"] == "impacts" for line in found["report"]["lines"])
    assert "events and walls are not written as C" in call("export", "c", file, "--out", tmp_path / "ball.c").stderr
    file.write_text(ball + "initial = dict(q=[[0.3], [0.2]], v=[0.4])\n", encoding="utf-8")
    assert from_file(file).simulate().batch == 2
