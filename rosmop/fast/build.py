"""Build sets: certify the properties, serialize a set, and translate its modules to machine code."""

from collections.abc import Collection, Iterable, Iterator
from typing import NamedTuple

from rosmop.certify.properties import DEFECT, certificates_of
from rosmop.certify.steps import StepDiffersError, check_steps
from rosmop.fast.abi import CompiledModule, SetPart
from rosmop.fast.batch_codegen import WasmModule, written_of
from rosmop.fast.serialization import decoded, encoded, encoded_part
from rosmop.fast.wasm_instance import translated
from rosmop.fast.wasm_runner import WasmFastPath
from rosmop.form.compiled import Compiled
from rosmop.form.findings import SpecificationError


class ModuleDefectError(Exception):
    """The module of a set is wrong, which is a defect of the compiler; the text is for the user."""


class CertifiedSet(NamedTuple):
    """A set whose properties are certified: for each specification a line for each property, and the set as bytes."""

    certificates: dict[str, list[str]]
    data: bytes


def certified(compiled: Compiled) -> CertifiedSet:
    """Certify the properties of a set, and serialize it; equal sets give equal bytes.

    Raises `SpecificationError` if an automaton differs from its formula, which is a defect.
    """
    certificates, wrong = certificates_of(compiled.specifications)
    if wrong:
        raise SpecificationError(wrong)
    return CertifiedSet(certificates, encoded(compiled))


def parts_of(data: bytes, wanted: Iterable[tuple[Collection[str], Collection[str]]]) -> Iterator[bytes]:
    """Yield the parts of a certified set as bytes: for each, the specifications in it, and those in shadow mode.

    Each part is independent of the rest; `rosmop.fast.load` loads it. Raises `ModuleDefectError`, and
    `msgspec.ValidationError` if `data` is not a set.
    """
    whole = decoded(data)
    for names, shadows in wanted:
        try:
            part = part_of(whole, names, shadows)
        except StepDiffersError as error:
            raise ModuleDefectError(
                f"the code of a step differs from its automaton: {error}; {DEFECT}"
            ) from error
        yield encoded_part(part)


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
    return CompiledModule(
        code=translated(module.code, module.memory), memory=module.memory, frames=module.frames,
        effects=module.effects, feeds=module.feeds, cells=module.cells, throttles=module.throttles,
        lines=module.lines, said=module.said,
    )  # fmt: skip
