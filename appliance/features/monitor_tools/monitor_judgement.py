"""Compile the specifications in force from their texts, to describe and draw them."""

from typing import Annotated, NamedTuple

import msgspec

from appliance.channel.answers.field_docs import FromOne, Name, RevisionNumber, Sentence, doc
from appliance.channel.answers.monitor_answers import Finding, Monitors, MonitorState, Tag
from rosmop.check.sources import compiled_from
from rosmop.logics.picture import dot_of, svg_of
from rosmop.run.engine import MonitorSet
from roswire.definitions import Definitions
from roswire.standard import standard_definitions

# Structs of `/v1/monitors` besides control's answers.


class EventShown(msgspec.Struct, frozen=True, kw_only=True):
    """An event of a specification: on a topic, in a service's request or response, or a timer (`every`, in seconds)."""

    name: Name
    line: FromOne
    topic: Annotated[str | None, doc("its name")]
    type: Annotated[str | None, doc("package/Type, as ROS has it")]
    part: Annotated[str | None, doc("for a service: request or response")]
    every: Annotated[float | None, doc("interval in seconds, or null if it is not periodic")]


class PropertyShown(msgspec.Struct, frozen=True, kw_only=True):
    """A property of a specification; `drawn`: `…/picture` shows its automaton."""

    logic: Annotated[str, doc("logic of the formula")]
    formula: Annotated[str, doc("the formula as written")]
    categories: Annotated[list[str], doc("possible categories of the property, in the words of its logic")]
    handled: Annotated[list[str], doc("categories that have a handler")]
    drawn: Annotated[bool, doc("whether there is a picture of its automaton")]


class Described(NamedTuple):
    """The contents of a specification; `uses` are the monitors whose variables it uses; `hold` is its modifier."""

    events: list[EventShown]
    properties: list[PropertyShown]
    uses: list[str]
    hold: bool


class Happened(msgspec.Struct, frozen=True, kw_only=True):
    """An action of a monitor, in the audit log under this sequence; `count` is the number of equal ones."""

    sequence: Annotated[int, doc("sequence number in the audit log")]
    time: Annotated[str, doc("RFC 3339, UTC, nanoseconds")]
    event: Annotated[str, doc("its stable name")]
    resource: Annotated[str | None, doc("topic, service, parameter, node or call")]
    reason: Sentence
    category: Annotated[str | None, doc("the events of the verdict")]
    count: Annotated[int | None, doc("number of further equal entries, or null if there are none")]


class Monitor(MonitorState, frozen=True, kw_only=True):
    """A monitor with its source text."""

    revision: RevisionNumber
    tag: Tag
    text: Annotated[str, doc("text of its whole file")]
    alphabet: Annotated[list[EventShown], doc("its events")]
    properties: Annotated[list[PropertyShown], doc("properties that it checks")]
    warnings: Annotated[list[Finding], doc("name of its file")]
    uses: Annotated[list[str], doc("monitors whose variables it uses")]
    hold: Annotated[bool, doc("declared `hold`: blocks its topics after a restart of the relay")]


class History(msgspec.Struct, frozen=True):
    """The latest actions of a monitor, newest first."""

    name: Name
    happened: Annotated[list[Happened], doc("events, newest first")]
    cursor: Annotated[str | None, doc("cursor of the next page, or null on the last page")]


class Compiler:
    """Compiles specifications, and keeps the last result for repeated queries."""

    def __init__(self) -> None:
        self._last: tuple[int, MonitorSet] | None = None

    def _set(self, loaded: Monitors) -> MonitorSet:
        if self._last is None or self._last[0] != loaded.revision:
            self._last = (loaded.revision, _compile(loaded))
        return self._last[1]

    def describe(self, loaded: Monitors, name: str) -> Described:
        """Return the description of a monitor. Raises `KeyError`."""
        monitor = self._set(loaded).monitor(name)
        events = [
            EventShown(
                name=event.name,
                line=event.position.line,
                topic=event.topic,
                type=event.service_type or event.type,
                part=event.part,
                every=None if event.period_ns is None else event.period_ns / 1e9,
            )
            for event in monitor.code.events
        ]
        properties = [
            PropertyShown(
                logic=running.code.property.logic,
                formula=running.code.property.formula.strip(),
                categories=list(running.code.property.categories),
                handled=list(running.code.order),
                drawn=dot_of([running.code.property]) is not None,
            )
            for running in monitor.properties
        ]
        return Described(events, properties, sorted(monitor.code.uses), monitor.code.hold)

    def picture(self, loaded: Monitors, name: str) -> str | None:
        """Return a monitor's picture, or None if no automaton is finite. Raises `KeyError`."""
        monitor = self._set(loaded).monitor(name)
        return svg_of([code.property for code in monitor.code.properties])


def _compile(loaded: Monitors) -> MonitorSet:
    known = standard_definitions().merge(Definitions.from_files(loaded.definitions or {}))
    return MonitorSet.of(compiled_from(loaded.files or {}, known, topics=loaded.topics or {}))
