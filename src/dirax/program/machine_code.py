"""LLVM in this process: from IR text to object code, and from object code to addresses."""

import functools
import itertools
import platform
from collections.abc import Mapping
from typing import Any

import llvmlite
import llvmlite.binding as llvm

LINKED_TOGETHER = 64
"""Libraries after which a new linker begins: one keeps 9 kB of every library that it linked, until all of them are gone."""

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


def version() -> tuple[object, ...]:
    """What determines the code beside the IR text: this machine, and the version of LLVM."""
    return *host(), llvmlite.__version__, llvm.llvm_version_info


def has_fma() -> bool:
    """Whether this processor multiplies and adds with one rounding."""
    return bool(features().get("fma")) or platform.machine().lower() in ("aarch64", "arm64")


def vector_width() -> int:
    """Lanes of float64 in this processor's widest vectors."""
    have = features()
    return 8 if have.get("avx512f") else 4 if have.get("avx") else 2


@functools.cache
def _compiler(triple: str, cpu: str, flags: str, level: int) -> tuple[Any, Any, Any]:
    """(machine, passes, pass builder) for a target, made once: LLVM keeps some memory of each that was ever used.

    Few passes are run: the graph has simplified what there was to simplify. LLVM's own choice of passes takes several times
    as long and makes no faster code. Nor does it gain anything by the tables of one processor, whose instructions `flags` name
    all: those of AMD's ask for a second round of scheduling, which takes half of the time where a step has 10 000 operations.
    """
    _initialized()
    if (triple, cpu, flags) != host():
        llvm.initialize_all_targets()
        llvm.initialize_all_asmprinters()
    tuned = "x86-64" if flags and triple.startswith("x86_64") else cpu
    machine = llvm.Target.from_triple(triple).create_target_machine(
        cpu=tuned, features=flags, opt=level, reloc="pic", codemodel="small"
    )
    passes = llvm.create_new_module_pass_manager()
    if level:
        passes.add_simplify_cfg_pass()  # straight code is one block again
        passes.add_sroa_pass()
        passes.add_instruction_combine_pass()
        passes.add_simplify_cfg_pass()
    return machine, passes, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=1))


def object_code(text: str, target: tuple[str, str, str] | None = None, assembly: bool = False, level: int = 2) -> Any:
    """Object code of a module (or its assembly text), for this machine or a (triple, processor, features). Level 0 takes a third
    of the time and makes code that takes three times as long."""
    target = target or host()
    machine, passes, builder = _compiler(*target, level)
    module = llvm.parse_assembly(f'target triple = "{target[0]}"\n' + text, llvm.create_context())
    passes.run(module, builder)
    return machine.emit_assembly(module) if assembly else machine.emit_object(module)


@functools.lru_cache(maxsize=1)
def _jit(block: int):
    """The linker of this block of libraries; it lives as long as one of them."""
    _initialized()
    # JITLink keeps the sections of an object together: its code reaches its constants wherever the memory is
    return llvm.create_lljit_compiler(use_jit_link=True)


def load(code: bytes, names: tuple[str, ...], known: Mapping[str, int] | None = None):
    """The object code linked into this process: a tracker that keeps it alive and gives addresses by name; `known` are those of
    other functions that it calls."""
    builder = llvm.JITLibraryBuilder().add_object_img(code).add_current_process()
    for name in names:
        builder.export_symbol(name)
    for name, address in (known or {}).items():
        builder.import_symbol(name, address)
    number = next(_numbers)
    return builder.link(_jit(number // LINKED_TOGETHER), f"dirax_kernel_{number}")


def function(library: Any, name: str, signature: Any) -> Any:
    """A function of linked code, which keeps that code in memory: another thread may have linked it anew meanwhile."""
    made = signature(library[name])
    made.library, made.address = library, library[name]
    return made
