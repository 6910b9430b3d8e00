"""Describe the outcome of a message, a tick or a deadline, and its causes, as data for a record, for the CLI and for
REST.

The data are limited in size, and use the words of the specification. `who` names the source of a message.
"""

import datetime
from collections.abc import Callable, Mapping
from typing import Any

from rosmop.run.outcomes import DROPPED, SEQ, EventOccurrence, Fault, Outcome, Verdict, named
from rosmop.run.subformulas import deciding

_EACH_END = 5
"""The number of first events, and of last events, that are listed; the events between are only counted."""

Who = Callable[[int], Mapping[str, Any]]


def of_drop(outcome: Outcome, who: Who) -> dict[str, Any]:
    """Return the causes of the drop of the message, with the position of the statement."""
    return {
        **({"at": [str(outcome.dropped_at)]} if outcome.dropped_at is not None else {}),
        **({"values": dict(outcome.fatal.values)} if outcome.fatal is not None else {}),
        **_led(outcome, who, outcome.handling.get(DROPPED)),
    }


def of_change(outcome: Outcome, who: Who) -> dict[str, Any]:
    """Return the causes of the change of the message, with the positions of the statements."""
    return {
        "changed_by": list(outcome.changed_by),
        "at": [str(position) for position in outcome.changed_at],
        **_led(outcome, who),
    }


def of_published(outcome: Outcome, number: int, who: Who) -> dict[str, Any]:
    """Return the causes of a published message, with the position of the statement."""
    message = outcome.published[number]
    position = outcome.sites[message.site].position
    return {"type": message.type, "at": [str(position)], **_led(outcome, who, outcome.handling.get(number))}


def of_fault(outcome: Outcome, fault: Fault, who: Who) -> dict[str, Any]:
    """Return the causes of the fault, its position, and the values of variables there."""
    where = fault.position
    return {
        "file": where.file,
        "line": where.line,
        "column": where.column,
        "text": fault.text,
        "values": dict(fault.values),
        "at": [str(where)],
        **_led(outcome, who),
    }


def of_verdict(outcome: Outcome, verdict: Verdict, who: Who) -> dict[str, Any]:
    """Return the causes of the verdict, with the position of its property."""
    return {
        "property": verdict.property,
        "logic": verdict.logic,
        "category": verdict.category,
        **({"binding": dict(verdict.binding)} if verdict.binding else {}),
        "at": [str(verdict.source.origin)],
        **_led(outcome, who),
        **why_of(verdict, who),
    }


def _led(outcome: Outcome, who: Who, handled: Verdict | None = None) -> dict[str, Any]:
    """Return the events (or the timer), the conditions with the compared values, and the verdict whose handler
    acted.
    """
    return {
        "events": list(outcome.events),
        **({"timer": outcome.timer} if outcome.timer is not None else {}),
        **({"conditions": outcome.conditions} if outcome.looked else {}),
        **({"handler": named(handled), **why_of(handled, who)} if handled is not None else {}),
    }


def why_of(verdict: Verdict, who: Who) -> dict[str, Any]:
    """Return the field `why` of a verdict; empty if the explanation was not requested or is unknown."""
    why = verdict.why
    if why is None:
        return {}
    events = [_event(verdict, event, who) for event in why.events]
    between = len(events) - 2 * _EACH_END
    said: dict[str, Any] = {"events": events}
    if between > 0:
        said = {"events": [*events[:_EACH_END], *events[-_EACH_END:]], "left_out": between}
    said["fewest"] = why.fewest
    if why.since is not None:
        said["since"] = moment(why.since)
    decided = deciding(verdict.source, why)
    if decided:
        said["decided"] = decided
    return {"why": said}


def moment(time_ns: int) -> str:
    """Return a time in UTC, with microseconds."""
    return datetime.datetime.fromtimestamp(time_ns / 1e9, datetime.UTC).isoformat(timespec="microseconds")


def _event(verdict: Verdict, happened: EventOccurrence, who: Who) -> dict[str, Any]:
    event: dict[str, Any] = {"event": verdict.source.events[happened.event], "time": moment(happened.time)}
    event |= {"state": happened.state} if happened.state else {}
    event |= who(happened.sender.source) if happened.sender.source else {}
    return event | ({"seq": happened.sender.number} if happened.sender.kind == SEQ else {})
