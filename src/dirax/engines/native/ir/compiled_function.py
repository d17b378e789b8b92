"""Graph outputs as a compiled function on NumPy arrays, entry by entry."""

import ctypes
from collections.abc import Sequence

import numpy as np

from dirax.engines.native.ir.emitter import Body, Emitter, Module
from dirax.engines.native.ir.lower import Region
from dirax.engines.native.shared import addresses, declare_shared
from dirax.program import machine_code as llvm
from dirax.program.graph import Graph


def function_module(graph: Graph, inputs: Sequence[int], outputs: Sequence[int], width: int, fma: bool) -> str:
    """IR of `evaluate(inputs, outputs, count)`: rows of `width` entries, inputs (count, inputs, width)."""
    module = Module(fma)
    declare_shared(module)
    body = Body(module)
    e = Emitter(body, width)
    with body.loop(0, "%count") as i:
        region = Region(e, graph)
        first = body.put(f"mul i64 {i}, {len(inputs)}")
        source = body.at(e.real, "%inputs", first)
        for k, node in enumerate(inputs):
            region.bind(node, body.load(e.real, body.at(e.real, source, k)))
        region.require(outputs)
        last = body.put(f"mul i64 {i}, {len(outputs)}")
        target = body.at(e.real, "%outputs", last)
        for k, node in enumerate(outputs):
            value = region.value(node)
            if graph.is_boolean(node):
                value = e.select(value, e.const(1.0), e.const(0.0))
            body.store(e.real, value, body.at(e.real, target, k))
    body.line("ret void")
    module.define("define void @evaluate(ptr noalias %inputs, ptr noalias %outputs, i64 %count)", body)
    return module.text()


def loaded(graph: Graph, inputs: Sequence[int], outputs: Sequence[int], width: int = 1):
    """The compiled `evaluate(inputs, outputs, count)`, called with addresses."""
    text = function_module(graph, inputs, outputs, width, llvm.has_fma())
    library = llvm.load(llvm.object_code(text), ("evaluate",), addresses())
    call = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64)(library["evaluate"])
    call.library = library  # type: ignore[attr-defined]  # keeps the code alive
    return call


def compiled(graph: Graph, inputs: Sequence[int], outputs: Sequence[int], width: int = 1):
    """A function (inputs, entries) → (outputs, entries) that runs the compiled graph."""
    call = loaded(graph, inputs, outputs, width)

    def run(values: np.ndarray) -> np.ndarray:
        entries = values.shape[1]
        padded = np.concatenate([values, np.repeat(values[:, :1], -entries % width, axis=1)], axis=1)
        rows = padded.shape[1] // width
        packed = np.ascontiguousarray(padded.reshape(len(inputs), rows, width).swapaxes(0, 1), dtype=np.float64)
        out = np.empty((rows, len(outputs), width))
        call(packed.ctypes.data, out.ctypes.data, rows)
        return out.swapaxes(0, 1).reshape(len(outputs), -1)[:, :entries]

    return run
