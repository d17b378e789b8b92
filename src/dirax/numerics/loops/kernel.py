"""Kernel: a compiled function of loops, called with NumPy's arrays, or within what JAX compiles for a CPU."""

import ctypes
import functools
import hashlib
import re
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import llvmlite.binding as llvm
import llvmlite.ir as ir
import numpy as np

from dirax.numerics.loops.compiler import argument_kinds, module_of

POINTER = ir.IntType(8).as_pointer()
DTYPES = {"f8": np.float64, "i4": np.int32, "i8": np.int64}
FRAME_EXTENSION, FRAME_OPERANDS, FRAME_RESULTS = 8, 72, 112
BUFFER_DATA = 24
EXTENSION_METADATA, METADATA_VERSION = 24, 24
"""Offsets in the structures of XLA's foreign-function interface (`xla/ffi/api/c_api.h`, which comes with JAX)."""

SPENT = "nanoseconds"
"""The name of the number in a kernel's module that counts its time."""


class Kernel:
    """A function of arrays alone, in the part of Python that `compiler.py` compiles; the last `results` of them it fills.

    Compiled when it is first called; `constants` are values of names in it.
    """

    level = 3
    """How much LLVM optimizes."""

    def __init__(self, function: Callable, results: int, **constants: int):
        self.function, self.results, self.constants, self.entry = function, results, constants, function.__name__
        self.kinds = list(argument_kinds(function).values())
        self.name = "_".join(["dirax", function.__name__, *(f"{k}{v}" for k, v in sorted(constants.items()))])

    def __call__(self, *arrays: np.ndarray) -> None:
        """With NumPy's arrays, contiguous and of the right types; fills the last ones."""
        for array, kind in zip(arrays, self.kinds, strict=True):
            if array.dtype != DTYPES[kind] or not array.flags.c_contiguous:
                raise TypeError(f"{self.name} takes contiguous arrays of {self.kinds}, but {array.dtype} was given for {kind}.")
        self._call(*(array.ctypes.data for array in arrays))

    def in_jax(self, results: Sequence[jax.ShapeDtypeStruct], *arrays: Any) -> Any:
        """The results as JAX's arrays, on a CPU, also under `jax.vmap`."""
        self._registered  # noqa: B018  (once)
        return jax.ffi.ffi_call(self.name, list(results), vmap_method="sequential")(*arrays)

    def by(self, xp: Any, results: Sequence[tuple[tuple[int, ...], Any]], *arrays: Any) -> Sequence[Any]:
        """The results, of these shapes and types, by NumPy or by JAX, whichever module `xp` is."""
        if xp is not np:
            return self.in_jax([jax.ShapeDtypeStruct(*one) for one in results], *arrays)
        filled = [np.empty(*one) for one in results]
        self(*map(np.ascontiguousarray, arrays), *filled)
        return filled

    @property
    def seconds(self) -> float:
        """How long it has run within what JAX compiled, since it was compiled."""
        if "_engine" not in self.__dict__:
            return 0.0
        return ctypes.c_int64.from_address(self._engine.get_global_value_address(SPENT)).value * 1e-9

    def module(self) -> Any:
        """The function as LLVM has it, with what XLA calls."""
        made = module_of(self.function, self.constants)
        _write_handler(made, made.get_global(self.entry), self.results)
        return llvm.parse_assembly(str(made))

    @functools.cached_property
    def _engine(self) -> Any:
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        parsed = self.module()
        features = llvm.get_host_cpu_features().flatten()
        machine = llvm.Target.from_default_triple().create_target_machine(
            cpu=llvm.get_host_cpu_name(), features=features, opt=3, jit=True
        )
        options = llvm.create_pipeline_tuning_options(speed_level=self.level)
        builder = llvm.create_pass_builder(machine, options)
        builder.getModulePassManager().run(parsed, builder)
        engine = llvm.create_mcjit_compiler(parsed, machine)
        engine.finalize_object()
        return engine

    @functools.cached_property
    def _call(self) -> Any:
        kind = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * len(self.kinds))
        return kind(self._engine.get_function_address(self.entry))

    @functools.cached_property
    def _registered(self) -> Any:
        new = ctypes.pythonapi.PyCapsule_New
        new.restype, new.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
        capsule = new(self._engine.get_function_address("handler"), None, None)
        jax.ffi.register_ffi_target(self.name, capsule, platform="cpu")
        return capsule


class WrittenKernel(Kernel):
    """The same of LLVM's text, a function `entry` of pointers to numbers of these `kinds`, the last of them `results`."""

    level = 1

    def __init__(self, text: str, entry: str, kinds: Sequence[str], results: int):
        self.text, self.entry, self.results, self.kinds = text, entry, results, list(kinds)
        self.name = f"dirax_{entry}_{hashlib.sha256(text.encode()).hexdigest()[:24]}"  # what XLA keeps on disk refers to it

    def module(self) -> Any:
        """The text, with what XLA calls."""
        handler = ir.Module()
        kind = ir.FunctionType(ir.VoidType(), [ir.DoubleType().as_pointer()] * len(self.kinds))
        _write_handler(handler, ir.Function(handler, kind, self.entry), self.results)
        made = llvm.parse_assembly(self.text)
        made.link_in(llvm.parse_assembly(str(handler)))
        return made


@functools.cache
def _interface_version() -> tuple[int, int]:
    """The version of XLA's foreign-function interface that the installed JAX has."""
    try:
        header = (Path(jax.ffi.include_dir()) / "xla/ffi/api/c_api.h").read_text()
        major, minor = (re.search(rf"XLA_FFI_API_{part} (\d+)", header) for part in ("MAJOR", "MINOR"))
        return (int(major[1]), int(minor[1])) if major and minor else (0, 3)
    except OSError:
        return 0, 3


def _write_handler(module: ir.Module, kernel: Any, count: int) -> None:
    """What XLA calls: says the version of the interface where it is asked, else hands the arrays to the kernel, which fills the
    last `count`."""
    i32 = ir.IntType(32)
    handler = ir.Function(module, ir.FunctionType(POINTER, [POINTER]), "handler")
    (frame,) = handler.args
    b = ir.IRBuilder(handler.append_basic_block())
    at = lambda base, offset, kind: b.bitcast(b.gep(base, [ir.Constant(ir.IntType(64), offset)]), kind.as_pointer())
    pointer = lambda base, offset: b.load(at(base, offset, POINTER))
    null = ir.Constant(POINTER, None)
    extension = pointer(frame, FRAME_EXTENSION)
    asked, called = b.append_basic_block(), b.append_basic_block()
    b.cbranch(b.icmp_unsigned("!=", extension, null), asked, called)
    b.position_at_end(asked)
    metadata = pointer(extension, EXTENSION_METADATA)
    for place, number in enumerate(_interface_version()):
        b.store(ir.Constant(i32, number), at(metadata, METADATA_VERSION + 4 * place, i32))
    b.ret(null)
    b.position_at_end(called)
    given, results = pointer(frame, FRAME_OPERANDS), pointer(frame, FRAME_RESULTS)
    inputs, values = len(kernel.args) - count, []
    for k, argument in enumerate(kernel.args):
        buffer = pointer(given, 8 * k) if k < inputs else pointer(results, 8 * (k - inputs))
        values.append(b.bitcast(pointer(buffer, BUFFER_DATA), argument.type))
    begun = _nanoseconds(b)
    b.call(kernel, values)
    spent: Any = ir.GlobalVariable(module, ir.IntType(64), SPENT)
    spent.initializer = ir.Constant(ir.IntType(64), 0)
    b.atomic_rmw("add", spent, b.sub(_nanoseconds(b), begun), "monotonic")
    b.ret(null)


def _nanoseconds(b: Any) -> Any:
    """The time of the system's steady clock; 0 where it has none."""
    i64, clock = ir.IntType(64), getattr(time, "CLOCK_MONOTONIC", None)
    if clock is None:
        return ir.Constant(i64, 0)
    kind = ir.FunctionType(ir.IntType(32), [ir.IntType(32), i64.as_pointer()])
    call = b.module.globals.get("clock_gettime") or ir.Function(b.module, kind, "clock_gettime")
    with b.goto_entry_block():
        now = b.alloca(i64, 2)
    b.call(call, [ir.Constant(ir.IntType(32), clock), now])
    seconds, rest = (b.load(b.gep(now, [ir.Constant(i64, i)])) for i in range(2))
    return b.add(b.mul(seconds, ir.Constant(i64, 10**9)), rest)
