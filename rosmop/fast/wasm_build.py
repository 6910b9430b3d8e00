"""The module of a set: written as WebAssembly and translated for this machine, by who has compiled the set."""

from collections.abc import Collection
from dataclasses import fields

from rosmop.certify.steps import check_steps
from rosmop.fast.abi import FeedModule, Part
from rosmop.fast.batch_codegen import WrittenModule, written
from rosmop.fast.wasm_instance import translated
from rosmop.fast.wasm_runner import WasmFastPath
from rosmop.form.compiled import Compiled
from rosmop.form.specification_groups import groups
from rosmop.runtime.values import Values


def part_of(compiled: Compiled, names: Collection[str], trials: Collection[str]) -> Part:
    """What runs these specifications, of which some are on `trials`: the same whatever else is in the set.

    Raises `StepDiffersError` where the module does something else than the automata: that is a defect.
    """
    alone = compiled.alone(names)
    acting = alone.without(trials)
    module = _written(acting)
    check_steps(acting, module)
    return Part(alone, _translated(module))


def fast_path_of(compiled: Compiled) -> WasmFastPath:
    """Return the fast path of all of these specifications, for `MonitorSet`."""
    return WasmFastPath(_translated(_written(compiled)))


def _written(compiled: Compiled) -> WrittenModule:
    components = [group.component for group in groups(compiled.specifications)]
    return written(compiled.functions, components, Values(compiled.messages), compiled.stamped)


def _translated(module: WrittenModule) -> FeedModule:
    parts = {part.name: getattr(module, part.name) for part in fields(FeedModule)}
    return FeedModule(**parts | {"code": translated(module.code, module.memory)})
