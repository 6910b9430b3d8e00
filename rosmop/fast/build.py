"""Build sets: certify, serialize, and translate to machine code."""

from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

from rosmop.certify.properties import DEFECT, certificates_of
from rosmop.certify.steps import StepDiffersError, check_steps
from rosmop.fast.abi import CompiledModule, SetPart
from rosmop.fast.batch_codegen import WasmModule, written_of
from rosmop.fast.load import load_part
from rosmop.fast.serialization import decode, encode, encoded_part
from rosmop.fast.wasm_instance import WasmError, translate
from rosmop.fast.wasm_runner import WasmFastPath
from rosmop.form.compiled import Compiled
from rosmop.form.findings import Diagnostic, SpecificationError
from rosmop.run.engine import MonitorSet


class CertifiedSet(NamedTuple):
    """A set whose properties are certified, as bytes, with a line for each property by specification."""

    certificates: dict[str, list[str]]
    data: bytes


def certify(compiled: Compiled) -> CertifiedSet:
    """Certify and serialize a set without its warnings; equal sets give equal bytes.

    Raises `SpecificationError` if an automaton differs from its formula, which is a defect.
    """
    certificates, wrong = certificates_of(compiled.specifications)
    if wrong:
        raise SpecificationError(wrong)
    return CertifiedSet(certificates, encode(replace(compiled, warnings=())))


def require_loadable(data: bytes) -> None:
    """Build and load the module as a relay does. Raises the errors of `parts_of`."""
    names = tuple(specification.name for specification in _set(data).specifications)
    for part in parts_of(data, [(names, ())]):
        compiled, fast = load_part(part)
        MonitorSet.of(compiled, fast=fast)


def parts_of(data: bytes, wanted: Iterable[tuple[Collection[str], Collection[str]]]) -> Iterator[bytes]:
    """Yield independent parts of a certified set: for each, the specifications in it, and those in shadow mode.

    Raises `SpecificationError` if its module cannot be built, which is a defect, and `msgspec.ValidationError` if
    `data` is not a set.
    """
    whole = _set(data)
    for names, shadows in wanted:
        try:
            yield _part(data, tuple(names), tuple(shadows))
        except (StepDiffersError, WasmError) as error:
            raise SpecificationError(_defects(whole, names) or _defect(whole, names, error)) from error


_set = lru_cache(maxsize=1)(decode)


@lru_cache(maxsize=1)  # a relay that has all specifications runs the part of `require_loadable`
def _part(data: bytes, names: tuple[str, ...], shadows: tuple[str, ...]) -> bytes:
    return encoded_part(part_of(_set(data), names, shadows))


def _defects(whole: Compiled, names: Collection[str]) -> list[Diagnostic]:
    defects = []
    for group in whole.groups(names):
        try:
            part_of(whole, group, ())
        except (StepDiffersError, WasmError) as error:
            defects += _defect(whole, group, error)
    return defects


def _defect(whole: Compiled, names: Collection[str], error: Exception) -> list[Diagnostic]:
    first = next(specification for specification in whole.specifications if specification.name in names)
    how = "differs from its automata" if isinstance(error, StepDiffersError) else "cannot be run"
    return [Diagnostic(first.position, "error", f"the code of {first.name} {how}: {error}; {DEFECT}")]


def part_of(compiled: Compiled, names: Collection[str], shadows: Collection[str]) -> SetPart:
    """Return the specifications `names` as an independent part, with `shadows` in shadow mode.

    Raises `StepDiffersError` if the steps of the module differ from the automata, and `WasmError` if the module is
    invalid; both are defects.
    """
    alone = compiled.alone(names)
    acting = alone.without(shadows)
    module = written_of(acting)
    check_steps(acting, module)
    return SetPart(alone, _translate(module))


def fast_path_of(compiled: Compiled) -> WasmFastPath:
    return WasmFastPath(_translate(written_of(compiled)))


def _translate(module: WasmModule) -> CompiledModule:
    return CompiledModule(
        code=translate(module.code, module.memory), memory=module.memory, frames=module.frames,
        effects=module.effects, feeds=module.feeds, cells=module.cells, throttles=module.throttles,
        lines=module.lines, said=module.said, senders=module.senders,
    )  # fmt: skip
