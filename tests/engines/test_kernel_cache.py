"""The kernels on the disk: nothing is run that somebody else may have written, nothing odd stops a run, and it stays small."""

import json
import os
import shutil
import stat
import subprocess
import sys
import time
from pathlib import Path

import jax.numpy as jnp
import pytest

import dirax as dx
from dirax.engines.native import kernel_cache, private_folder
from dirax.engines.native.kernel_cache import Contents, Kernel

if not private_folder.POSIX:
    pytest.skip("this system does not say whose a file is", allow_module_level=True)

KERNEL = Kernel(7, b"machine code")
name = lambda k=0: kernel_cache.name_of("kernel", k)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("DIRAX_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "kernels"


@pytest.fixture(params=[0o000, 0o022, 0o777], ids=oct)
def umask(request):
    before = os.umask(request.param)
    yield request.param
    os.umask(before)


def mode(path: Path) -> int:
    return stat.S_IMODE(path.lstat().st_mode)


def test_what_is_written_is_read():
    assert kernel_cache.read(name()) is None
    kernel_cache.write(name(), KERNEL)
    assert kernel_cache.read(name()) == KERNEL and kernel_cache.read(name(1)) is None


def test_folder_and_files_are_the_users_alone_whatever_the_umask(folder, umask):
    kernel_cache.write(name(), KERNEL)
    assert mode(folder) == mode(folder.parent) == 0o700
    assert {mode(path) for path in folder.iterdir()} == {0o600}
    assert sorted(path.name for path in folder.iterdir()) == sorted([".key", name()])
    assert kernel_cache.read(name()) == KERNEL


def test_a_folder_that_was_open_is_closed_before_anything_is_read(folder):
    kernel_cache.write(name(), KERNEL)
    folder.chmod(0o777)
    assert kernel_cache.read(name()) == KERNEL and mode(folder) == 0o700


def test_entries_are_signed_under_their_name_with_the_users_key(folder, monkeypatch):
    kernel_cache.write(name(), KERNEL)
    (folder / name(1)).write_bytes((folder / name()).read_bytes())
    (folder / name(1)).chmod(0o600)
    assert kernel_cache.read(name(1)) is None
    monkeypatch.setenv("DIRAX_CACHE", str(folder.parent / "of somebody else"))
    kernel_cache.write(name(), Kernel(7, b"other code"))
    foreign = (folder.parent / "of somebody else" / "kernels" / name()).read_bytes()
    monkeypatch.setenv("DIRAX_CACHE", str(folder.parent))
    (folder / name()).write_bytes(foreign)
    assert kernel_cache.read(name()) is None


def test_damaged_and_short_entries_are_misses(folder):
    kernel_cache.write(name(), KERNEL)
    good = (folder / name()).read_bytes()
    for bad in (b"", good[:20], good[:-1], good + b"\0", bytes([good[0] ^ 1]) + good[1:], good[:40] + b"\xff" + good[41:]):
        (folder / name()).write_bytes(bad)
        assert kernel_cache.read(name()) is None
    key = (folder / ".key").read_bytes()
    (folder / name()).write_bytes(kernel_cache._signature(key, name(), b"abc") + b"abc")
    assert kernel_cache.read(name()) is None


def replaced(path: Path, how: str) -> None:
    """Put something odd, or something that others may have written, where a file was."""
    content = path.read_bytes()
    if how == "mode":
        path.chmod(0o666)
        return
    path.unlink()
    if how == "link":
        path.with_name("elsewhere").write_bytes(content)
        path.with_name("elsewhere").chmod(0o600)
        path.symlink_to(path.with_name("elsewhere"))
    elif how == "pipe":
        os.mkfifo(path, 0o600)
    elif how == "folder":
        path.mkdir(0o600)


@pytest.mark.parametrize("how", ["mode", "link", "pipe", "folder"])
def test_what_others_may_have_written_is_passed_over_with_a_note(folder, how):
    kernel_cache.write(name(), KERNEL)
    replaced(folder / name(), how)
    started = time.perf_counter()
    with pytest.warns(RuntimeWarning, match="kernel cache .* passed over, and the kernel compiled anew"):
        assert kernel_cache.read(name()) is None
    kernel_cache.write(name(), KERNEL)
    if how != "folder":
        assert kernel_cache.read(name()) == KERNEL
    assert time.perf_counter() - started < 5


@pytest.mark.parametrize("how", ["mode", "link", "pipe", "short"])
def test_a_doubtful_key_is_replaced_and_what_it_signed_forgotten(folder, how):
    kernel_cache.write(name(), KERNEL)
    old = (folder / ".key").read_bytes()
    if how == "short":
        (folder / ".key").write_bytes(old[:5])
        assert kernel_cache.read(name()) is None
    else:
        replaced(folder / ".key", how)
        with pytest.warns(RuntimeWarning, match=r"\.key"):
            assert kernel_cache.read(name()) is None
    kernel_cache.write(name(1), KERNEL)
    assert mode(folder / ".key") == 0o600 and (folder / ".key").read_bytes() != old
    assert kernel_cache.read(name(1)) == KERNEL and kernel_cache.read(name()) is None


@pytest.mark.parametrize("what", ["file", "link"])
def test_a_folder_that_is_none_is_passed_over(folder, what):
    folder.parent.mkdir()
    if what == "file":
        folder.write_text("")
    else:
        (folder.parent / "other").mkdir()
        folder.symlink_to(folder.parent / "other")
    with pytest.warns(RuntimeWarning, match="no folder"):
        kernel_cache.write(name(), KERNEL)
    with pytest.warns(RuntimeWarning, match="no folder"):
        assert kernel_cache.read(name()) is None
    with pytest.raises(PermissionError, match="not used"):
        kernel_cache.contents()


@pytest.mark.parametrize("whose", ["folder", "file"])
def test_what_belongs_to_another_user_is_passed_over(folder, monkeypatch, whose):
    kernel_cache.write(name(), KERNEL)
    mine, owner = os.fstat, os.geteuid() + 1

    def foreign(handle):
        found = mine(handle)
        if stat.S_ISDIR(found.st_mode) is not (whose == "folder"):
            return found
        return os.stat_result((*found[:4], owner, *found[5:]))

    monkeypatch.setattr(private_folder.os, "fstat", foreign)
    with pytest.warns(RuntimeWarning, match="belongs to another user"):
        assert kernel_cache.read(name()) is None


def test_a_place_that_cannot_be_written_is_no_error(folder):
    folder.parent.write_text("a file where the folder should be")
    kernel_cache.write(name(), KERNEL)
    assert kernel_cache.read(name()) is None


def test_kernels_used_longest_ago_leave_first(folder, monkeypatch):
    monkeypatch.setenv("DIRAX_CACHE_FILES", "3")
    for k in range(3):
        kernel_cache.write(name(k), KERNEL)
        os.utime(folder / name(k), (k, k))
    assert kernel_cache.read(name(0)) == KERNEL  # used now
    kernel_cache.write(name(3), KERNEL)
    assert [kernel_cache.read(name(k)) is not None for k in range(4)] == [True, False, True, True]
    assert kernel_cache.contents() == Contents(3, 3 * (40 + len(KERNEL.code)))


def test_the_size_is_bounded(folder, monkeypatch):
    monkeypatch.setenv("DIRAX_CACHE_MEGABYTES", "1")
    for k in range(4):
        kernel_cache.write(name(k), Kernel(1, bytes(300_000)))
        os.utime(folder / name(k), (k, k))
    assert [(folder / name(k)).exists() for k in range(4)] == [False, True, True, True]
    kernel_cache.write(name(9), Kernel(1, bytes(2_000_000)))
    assert kernel_cache.contents().files == 3 and kernel_cache.read(name(9)) is None


def test_a_full_cache_is_looked_through_now_and_then(folder, monkeypatch):
    monkeypatch.setenv("DIRAX_CACHE_FILES", "512")
    looks, entries = [], kernel_cache._entries
    for k in range(512):
        kernel_cache.write(name(k), KERNEL)
    monkeypatch.setattr(kernel_cache, "_entries", lambda folder: looks.append(folder) or entries(folder))
    for k in range(512, 612):
        kernel_cache.write(name(k), KERNEL)
    assert 3 <= len(looks) <= 50 and kernel_cache.contents().files <= 512
    kept = [kernel_cache.read(name(k)) is not None for k in range(612)]
    assert sum(kept) >= 480 and all(kept[180:]) and not any(kept[:60])  # of those written at one moment any may be the first


def test_what_other_processes_write_counts(folder, monkeypatch):
    """Before a quarter of the room is used up that there was at the last look, a process looks again."""
    monkeypatch.setenv("DIRAX_CACHE_FILES", "100")
    kernel_cache.write(name(), KERNEL)
    for k in range(1, 101):
        shutil.copy(folder / name(), folder / name(k))
    for k in range(101, 126):
        kernel_cache.write(name(k), KERNEL)
    assert kernel_cache.contents().files <= 100


@pytest.mark.parametrize("setting", ["DIRAX_CACHE_FILES", "DIRAX_CACHE_MEGABYTES"])
def test_settings_that_are_no_numbers_are_refused(monkeypatch, setting):
    monkeypatch.setenv(setting, "many")
    with pytest.raises(ValueError, match=f"{setting} must be a whole number of at least 0, but 'many' was given"):
        kernel_cache.write(name(), KERNEL)


def test_what_killed_processes_left_is_swept(folder):
    kernel_cache.write(name(), KERNEL)
    old, new = (folder / f"{word}{private_folder.UNFINISHED}" for word in ("old", "new"))
    for path in (old, new):
        path.write_bytes(b"part")
    os.utime(old, (1, 1))
    kernel_cache._room.clear()  # as in another process, whose first kernel it is
    kernel_cache.write(name(1), KERNEL)
    assert not old.exists() and new.exists()


def test_clearing_removes_what_is_the_caches_own(folder):
    for k in range(3):
        kernel_cache.write(name(k), KERNEL)
    (folder / "notes.txt").write_text("not a kernel")
    assert kernel_cache.clear().files == 3
    assert kernel_cache.contents() == Contents(0, 0) and [path.name for path in folder.iterdir()] == ["notes.txt"]
    assert kernel_cache.clear() == Contents(0, 0)


def test_the_folder_follows_the_environment(monkeypatch):
    monkeypatch.setenv("DIRAX_CACHE", "off")
    assert kernel_cache.cache_folder() is None and kernel_cache.read(name()) is None and kernel_cache.contents().files == 0
    kernel_cache.write(name(), KERNEL)
    monkeypatch.delenv("DIRAX_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
    assert kernel_cache.cache_folder() == Path("/somewhere/dirax/kernels")


WORKER = """
import sys, types
for package, place in (("dirax", ""), ("dirax.engines", "/engines"), ("dirax.engines.native", "/engines/native")):
    sys.modules[package] = module = types.ModuleType(package)  # the cache without the rest of the package
    module.__path__ = [sys.argv[1] + place]
from dirax.engines.native import kernel_cache as cache
hits = 0
for k in range(150):
    name, kernel = cache.name_of(k % 12), cache.Kernel(k % 12, bytes([k % 12]) * 500)
    found = cache.read(name)
    assert found in (None, kernel), "an entry that is none of ours"
    hits += found is not None
    cache.write(name, kernel)
print(hits)
"""


@pytest.mark.soak
def test_several_processes_share_it(folder, monkeypatch):
    monkeypatch.setenv("DIRAX_CACHE_FILES", "8")
    source = str(Path(dx.__file__).parent)
    command = [sys.executable, "-W", "error", "-c", WORKER, source]
    running = [subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for _ in range(4)]
    said = [process.communicate(timeout=60) for process in running]
    assert [process.returncode for process in running] == [0] * 4, said
    assert kernel_cache.contents().files <= 8 and any(int(out) for out, _ in said)
    assert not list(folder.glob(f"*{private_folder.UNFINISHED}"))


@pytest.mark.soak
def test_a_run_goes_on_whatever_is_in_the_cache(folder):
    system = dx.LagrangeDirac(lambda q, v: v @ v / 2 + jnp.cos(q[0]))
    run = lambda: dx.simulate(system, dx.LagrangeDAlembert(), q=[1.0], v=[0.0], step=0.01, steps=20, engine="native")
    first = run()
    (entry,) = (path for path in folder.iterdir() if path.name != ".key")
    key = (folder / ".key").read_bytes()

    def again(cached: bool) -> None:
        dx.clear_caches()
        sol = run()
        assert sol.stats["kernel_cached"] is cached and sol.q.tobytes() == first.q.tobytes()
        assert sol.stats["operations"] == first.stats["operations"]

    again(True)
    for code in (b"", b"\x7fELF and nothing more", entry.read_bytes()[40:200]):  # signed, and no object code
        content = (7).to_bytes(8, "little") + code
        entry.write_bytes(kernel_cache._signature(key, entry.name, content) + content)
        again(False)
    replaced(entry, "pipe")
    with pytest.warns(RuntimeWarning, match="no regular file"):
        again(False)
    again(True)


def test_the_command_line_shows_and_clears_it(folder, monkeypatch):
    from typer.testing import CliRunner

    from dirax.cli.commands import app

    call = lambda *options: CliRunner().invoke(app, ["cache", *options])
    kernel_cache.write(name(), Kernel(1, bytes(400_000)))
    shown, described = call().stdout, json.loads(call("--json").stdout)
    assert f"1 kernel (0.4 MB) in {folder}" in shown and "at most 4096 kernels (200.0 MB)" in shown
    assert described["folder"] == str(folder) and described["kernels"] == 1 and described["bytes"] == 400_040
    assert "1 kernel (0.4 MB) removed" in call("--clear").stdout and call("--clear").exit_code == 0
    assert json.loads(call("--json").stdout)["kernels"] == 0
    monkeypatch.setenv("DIRAX_CACHE", "off")
    assert "No compiled kernels are kept" in call().stdout
    monkeypatch.setenv("DIRAX_CACHE", str(folder.parent))
    folder.rmdir()
    folder.write_text("")
    refused = call()
    assert refused.exit_code == 1 and "kernel cache is not used" in refused.stderr
    monkeypatch.setenv("DIRAX_CACHE", str(folder))
    assert all("DIRAX_CACHE to a folder, or to off" in call(*options).stderr for options in ((), ("--clear",)))
