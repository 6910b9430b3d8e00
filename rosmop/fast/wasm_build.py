"""Builds the module of a set: writes it as WebAssembly and translates it to machine code."""

from collections.abc import Collection
from dataclasses import fields

from rosmop.certify.steps import check_steps
from rosmop.fast.abi import CompiledModule, SetPart
from rosmop.fast.batch_codegen import WasmModule, written_of
from rosmop.fast.wasm_instance import translated
from rosmop.fast.wasm_runner import WasmFastPath
from rosmop.form.compiled import Compiled


def part_of(compiled: Compiled, names: Collection[str], shadows: Collection[str]) -> SetPart:
    """Return the part of a set with these specifications, independent of the rest. `shadows` are in shadow mode.

    Raises `StepDiffersError` if the steps of the module differ from the automata, which is a defect.
    """
    alone = compiled.alone(names)
    acting = alone.without(shadows)
    module = written_of(acting)
    check_steps(acting, module)
    return SetPart(alone, _translated(module))


def fast_path_of(compiled: Compiled) -> WasmFastPath:
    """Return the fast path of all specifications of a set, for `MonitorSet`."""
    return WasmFastPath(_translated(written_of(compiled)))


def _translated(module: WasmModule) -> CompiledModule:
    parts = {part.name: getattr(module, part.name) for part in fields(CompiledModule)}
    return CompiledModule(**parts | {"code": translated(module.code, module.memory)})
