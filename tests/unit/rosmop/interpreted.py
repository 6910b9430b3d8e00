"""Monitors whose functions the interpreter runs, beside those that run generated code: both do the same."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from appliance.rosmop.compile.module import Module
from appliance.rosmop.compile.specification import Compiled
from appliance.rosmop.engine import MonitorSet
from appliance.rosmop.outcomes import Fault, Outcome
from appliance.rosmop.runtime.context import Context, Turn
from tests.unit.rosmop.interpreter import Interpreter


class _Interpreted(Module):
    """Knows where faults of the interpreter were, by the sites of the generated code."""

    def __init__(self, module: Module, interpreter: Interpreter) -> None:
        super().__init__()
        self.sites = module.sites
        self._interpreter = interpreter

    def place_of(self, error: Exception) -> tuple[int, Mapping[str, Any]]:
        """The site of a fault, and the variables there."""
        fault = self._interpreter.fault
        return (fault.site, fault.variables) if error is fault.error else (-1, {})

    def has_begun(self, line: int, error: Exception) -> bool:
        """Whether the event had happened."""
        return error is self._interpreter.fault.error and self._interpreter.fault.happened


def interpreted(compiled: Compiled) -> Compiled:
    """The same set of specifications with the interpreter in the place of generated code, and a state of its own."""
    turn, measures = Turn(), compiled.namespace["__rv__"]
    contexts = {one.context: Context(one.name, turn, measures) for one in compiled.specifications}
    namespace: dict[str, Any] = {**contexts}
    interpreter = Interpreter(compiled.functions, namespace, contexts, compiled.messages)
    events = {event.function for one in compiled.specifications for event in one.events}
    keys = {event.key for one in compiled.specifications for event in one.events}
    for name in compiled.functions:
        run = interpreter.key if name in keys else interpreter.event if name in events else interpreter.action
        namespace[name] = partial(run, name)
    return replace(
        compiled, namespace=namespace, turn=turn, module=_Interpreted(compiled.module, interpreter)
    )


def beside(monitors: MonitorSet) -> MonitorSet:
    """The set of the interpreter that belongs to one of generated code; not started."""
    return MonitorSet(interpreted(monitors.compiled), monitors.files, monitors.on_fault, monitors.patience)


def check_same(one: Outcome, other: Outcome) -> None:
    """Fail if generated code (the first) and the interpreter came to different outcomes."""
    assert _told(one) == _told(other)
    for fault, interpreted_fault in zip(one.faults, other.faults, strict=True):
        told = repr(sorted(fault.values.items()))
        known = {name: interpreted_fault.values.get(name) for name in fault.values}
        assert told == repr(sorted(known.items()))  # the interpreter may know more variables
    for before, other_before in zip(one.before, other.before, strict=True):
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
