"""Guards that run in the product's own engine. Each text is compiled once for a process: that takes 0.1 s."""

import functools
from collections.abc import Callable, Mapping, Sequence

from rosbags.typesys import get_types_from_msg

from appliance.features.guards.presets import DRIVER_CHECK, Guard, Preset, preset_named, text_of
from rosmop.check.sources import compiled_from
from rosmop.fast.abi import SetPart
from rosmop.fast.build import certify, parts_of
from rosmop.fast.serialization import decoded_part
from rosmop.fast.wasm_runner import WasmFastPath
from rosmop.run.engine import MonitorSet
from rosmop.tests.acting import STORE
from roswire.definitions import Definitions
from roswire.standard import standard_definitions
from tests.support.sources import ROOT

Change = Callable[[str], str]
Value = bool | int | float | str
MONITORS = ROOT / "monitors"
_TRIGGER = "landshark_msgs/PaintballTrigger.msg"
DEFINITIONS = standard_definitions().merge(
    Definitions.from_files({_TRIGGER: (MONITORS / "msg" / _TRIGGER).read_text(encoding="utf-8")})
)
"""The types of the guards, and those of the shipped monitors."""
for _kind in ("AckermannDrive", "AckermannDriveStamped"):
    STORE.register(
        get_types_from_msg(DEFINITIONS.message(f"ackermann_msgs/{_kind}").text, f"ackermann_msgs/msg/{_kind}")
    )


def unchanged(text: str) -> str:
    return text


def part_with(
    preset: str,
    types: Mapping[str, str],
    values: Mapping[str, Value],
    change: Change = unchanged,
    *,
    before: Sequence[str] = (),
    behind: Sequence[str] = (),
) -> tuple[SetPart, dict[str, Value]]:
    """Return the part of a guard with the name `guard`, and the values that the running guard has to be given.

    The other values are in its text. So guards that differ only in given values share one compilation. `change` makes
    another text of it. The part also has the guards of the texts `before` and `behind` it.
    """
    in_text = tuple(
        (name, str(value).lower() if isinstance(value, bool) else str(value))
        for name, value in values.items()
        if name in _loaded_values(preset)
    )
    given = {name: value for name, value in values.items() if name not in _loaded_values(preset)}
    text = change(_text(preset, tuple(types.items()), in_text))
    return part_of(*before, text, *behind), given


@functools.lru_cache(maxsize=512)
def part_of(*texts: str) -> SetPart:
    """Return the part with the guards of these texts, in this order."""
    sources = {f"guard{number or ''}.rv": text for number, text in enumerate(texts)}
    compiled = compiled_from(sources, DEFINITIONS, lints=False)
    [part] = parts_of(certify(compiled).data, [([one.name for one in compiled.specifications], ())])
    return decoded_part(part)


def on_its_module(part: SetPart) -> MonitorSet:
    """Return the monitors as a relay runs them."""
    return MonitorSet.of(part.compiled, fast=WasmFastPath(part.module))


def interpreted(part: SetPart) -> MonitorSet:
    return MonitorSet.of(part.compiled)


@functools.cache
def named(preset: str) -> Preset:
    return DRIVER_CHECK if preset == DRIVER_CHECK.name else preset_named(preset)


@functools.cache
def _loaded_values(preset: str) -> frozenset[str]:
    return frozenset(parameter.name for parameter in named(preset).parameters if parameter.loads)


@functools.cache
def _text(preset: str, types: tuple[tuple[str, str], ...], values: tuple[tuple[str, str], ...]) -> str:
    return text_of(Guard("guard", named(preset), types=dict(types), values=dict(values)))
