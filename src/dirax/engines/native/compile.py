"""LLVM in this process: from IR text to object code, and from object code to addresses; and a cache of it on disk."""

import functools
import hashlib
import itertools
import os
import platform
import tempfile
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding as llvm

_numbers = itertools.count()


@functools.cache
def _initialized() -> bool:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return True


@functools.cache
def host() -> tuple[str, str, str]:
    """(triple, processor, features) of this machine."""
    _initialized()
    return llvm.get_process_triple(), llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()


@functools.cache
def features() -> dict[str, bool]:
    return dict(llvm.get_host_cpu_features())


def has_fma() -> bool:
    """Whether this processor multiplies and adds with one rounding."""
    return bool(features().get("fma")) or platform.machine().lower() in ("aarch64", "arm64")


def vector_width() -> int:
    """Lanes of float64 in this processor's widest vectors."""
    have = features()
    return 8 if have.get("avx512f") else 4 if have.get("avx") else 2


def object_code(text: str, target: tuple[str, str, str] | None = None, assembly: bool = False) -> Any:
    """Object code of a module (or its assembly text), for this machine or a (triple, processor, features).

    Few passes are run: the graph has simplified what there was to simplify. LLVM's own choice of passes takes several times
    as long and makes no faster code.
    """
    _initialized()
    if target is None:
        target = host()
    else:
        llvm.initialize_all_targets()
        llvm.initialize_all_asmprinters()
    triple, cpu, flags = target
    module = llvm.parse_assembly(f'target triple = "{triple}"\n' + text)
    machine = llvm.Target.from_triple(triple).create_target_machine(
        cpu=cpu, features=flags, opt=2, reloc="pic", codemodel="small"
    )
    passes = llvm.create_new_module_pass_manager()
    passes.add_sroa_pass()
    passes.add_instruction_combine_pass()
    passes.add_simplify_cfg_pass()
    passes.run(module, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=1)))
    return machine.emit_assembly(module) if assembly else machine.emit_object(module)


@functools.cache
def _jit():
    _initialized()
    # JITLink keeps the sections of an object together: its code reaches its constants wherever the memory is
    return llvm.create_lljit_compiler(use_jit_link=True)


def load(code: bytes, names: tuple[str, ...]):
    """The object code linked into this process: a tracker that keeps it alive and gives addresses by name."""
    builder = llvm.JITLibraryBuilder().add_object_img(code).add_current_process()
    for name in names:
        builder.export_symbol(name)
    return builder.link(_jit(), f"dirax_kernel_{next(_numbers)}")


# ---------------------------------------------------------------------- cache on disk


def cache_folder() -> Path | None:
    """Where compiled kernels are kept: DIRAX_CACHE, else the user's cache folder; None when DIRAX_CACHE is "off"."""
    chosen = os.environ.get("DIRAX_CACHE")
    if chosen is not None:
        return None if chosen.lower() in ("off", "0", "") else Path(chosen) / "kernels"
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "dirax" / "kernels"


def kernel_key(*parts: object) -> str:
    """A digest of what determines the code: the given parts, this processor, the version of LLVM."""
    digest = hashlib.sha256()
    for part in (*parts, *host(), llvmlite.__version__, llvm.llvm_version_info):
        digest.update(repr(part).encode() + b"\0")
    return digest.hexdigest()


def read_cached(key: str) -> bytes | None:
    """The object code kept under a key; None if there is none or it was damaged."""
    folder = cache_folder()
    if folder is None:
        return None
    try:
        stored = (folder / key).read_bytes()
    except OSError:
        return None
    check, code = stored[:32], stored[32:]
    return code if hashlib.sha256(code).digest() == check else None


def write_cached(key: str, code: bytes) -> None:
    """Keep object code; a folder that cannot be written is no error."""
    folder = cache_folder()
    if folder is None:
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=folder)
        with os.fdopen(handle, "wb") as file:
            file.write(hashlib.sha256(code).digest() + code)
        os.replace(name, folder / key)
    except OSError:
        return
