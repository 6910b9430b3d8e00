import functools
from collections.abc import Mapping
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from rosmop.check.sources import compiled_from
from rosmop.form.findings import Diagnostic, SpecificationError
from rosmop.run.engine import MonitorSet
from rosmop.run.execution import OnFault
from rosmop.run.outcomes import Outcome
from rosmop.run.timers import Patience
from rosmop.runtime.action_context import BUDGET
from roswire.definitions import Definitions
from roswire.standard import standard_definitions

STORE: Any = get_typestore(Stores.ROS1_NOETIC)
PAINTBALL = "uint8 NONE=0\nuint8 SINGLE_SHOT=1\nHeader header\nuint8 trigger\n"


@functools.cache
def definitions() -> Definitions:
    return standard_definitions().merge(
        Definitions.from_files({"landshark_msgs/PaintballTrigger.msg": PAINTBALL})
    )


def message(kind: str, **fields: object) -> bytes:
    return bytes(STORE.serialize_ros1(_value(_long(kind), _tree(fields)), _long(kind)))


def fields(kind: str, data: bytes) -> Any:
    return STORE.deserialize_ros1(data, _long(kind))


def _tree(flat: Mapping[str, object]) -> dict[str, object]:
    nested: dict[str, object] = {}
    for path, value in flat.items():
        at = nested
        *above, last = path.split("__")
        for step in above:
            at = at.setdefault(step, {})  # type: ignore[assignment]  # the dicts are nested
        at[last] = value
    return nested


def _long(kind: str) -> str:
    package, _, name = kind.partition("/")
    return f"{package}/msg/{name}"


def _value(kind: str, given: object) -> Any:
    if not isinstance(given, dict):
        return given
    import numpy as np  # noqa: PLC0415  only for the other library's arrays

    parts = {}
    for name, (node, detail) in STORE.fielddefs[kind][1]:
        value = given.get(name)
        if node == Nodetype.BASE:
            parts[name] = value if value is not None else {"string": "", "bool": False}.get(detail[0], 0)
        elif node == Nodetype.NAME:
            parts[name] = (
                value if value is not None and not isinstance(value, dict) else _value(detail, value or {})
            )
        else:
            inner, length = detail
            items = value if value is not None else [0] * length
            if inner[0] == Nodetype.NAME:
                parts[name] = [_value(inner[1], item) for item in items]
            elif inner[1][0] == "string":
                parts[name] = list(items)
            else:
                parts[name] = np.array(items, dtype=np.dtype(inner[1][0]))
    return STORE.types[kind](**parts)


def load(
    text: str, on_fault: OnFault = "drop", patience: Patience = lambda: lambda: False, **others: str
) -> MonitorSet:
    sources = {"x.rv": text, **{f"{name}.rv": other for name, other in others.items()}}
    monitors = MonitorSet.of(compiled_from(sources, definitions()), on_fault, patience)
    monitors.start(0)
    return monitors


def action(body: str, *, before: str = "") -> str:
    """Return a specification with an action on `/t`, where `x` is the data of a `std_msgs/Int32`."""
    return f"s() {{ {before} event e(int x) /t std_msgs/Int32 '{{data:x}}' {{ {body} }} }}"


def act(body: str, *, before: str = "", data: int = 0, most: int = BUDGET) -> Outcome:
    """Run an action, with at most this number of instructions."""
    text = action(body, before=before)
    told = message("std_msgs/Int32", data=data)
    monitors = load(text)
    monitors.monitor("s").context.most = most
    return monitors.process("/t", told, 1_500_000_000)


def shown(expression: str, *, conversion: str = "%s", before: str = "", data: int = 0) -> str:
    outcome = act(f'ROS_INFO("{conversion}", {expression});', before=before, data=data)
    if outcome.faults:
        return f"fault: {outcome.faults[0].text}"
    return outcome.log[0].text


def refused(text: str) -> list[Diagnostic]:
    try:
        MonitorSet.of(compiled_from({"x.rv": text}, definitions()))
    except SpecificationError as error:
        return [finding for finding in error.findings if finding.severity == "error"]
    raise AssertionError("the specification was accepted")


def refused_action(body: str, *, before: str = "") -> list[Diagnostic]:
    text = f"s() {{ {before}\nevent e(int x) /t std_msgs/Int32 '{{data:x}}' {{\n{body}\n}} }}"
    return refused(text)
