"""Run the same monitors by the interpreter only, as a reference for modules."""

from collections.abc import Mapping
from dataclasses import replace

import msgspec

from rosmop.form import nodes
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import Fault, Outcome


def sent(functions: Mapping[str, nodes.Function]) -> dict[str, nodes.Function]:
    return msgspec.msgpack.decode(msgspec.msgpack.encode(functions), type=dict[str, nodes.Function])


def beside(monitors: MonitorSet) -> MonitorSet:
    """Return the monitors from the form as it is sent, with their own state and without a module; not started."""
    compiled = replace(monitors.compiled, functions=sent(monitors.compiled.functions))
    return MonitorSet(compiled, monitors.on_fault, monitors.patience)


def check_same(outcome: Outcome, other: Outcome) -> None:
    assert _told(outcome) == _told(other)
    for fault, other_fault in zip(outcome.faults, other.faults, strict=True):
        assert repr(sorted(fault.values.items())) == repr(sorted(other_fault.values.items()))
    for before, other_before in zip(outcome.before, other.before, strict=True):
        check_same(before, other_before)


def _told(outcome: Outcome) -> list[object]:
    return [
        bytes(outcome.buffer),
        outcome.result,
        outcome.time,
        outcome.timer,
        list(outcome.events),
        list(outcome.verdicts),
        list(outcome.published),
        list(outcome.log),
        [_fault(fault) for fault in outcome.faults],
        None if outcome.fatal is None else _fault(outcome.fatal),
        outcome.reason,
        list(outcome.changed_by),
        outcome.dropped_by,
        len(outcome.before),
    ]


def _fault(fault: Fault) -> tuple[object, ...]:
    return fault.monitor, fault.position, fault.text
