"""Structs of `/v1/monitors` besides control's answers."""

from typing import Annotated, NamedTuple

import msgspec

from appliance.api.front.problems import Finding
from appliance.channel.answers.field_docs import FromOne, Name, RevisionNumber, RollbackDue, Sentence, doc
from appliance.channel.answers.monitor_answers import MonitorState, Tag


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


class Replaced(msgspec.Struct, frozen=True, kw_only=True):
    """The effect of a change or, if `loaded` is false, of its dry run; `replaced` is the previous revision."""

    loaded: Annotated[bool, doc("false after a dry run: nothing was changed")]
    revision: Annotated[int, doc("in force now")]
    tag: Tag
    replaced: Annotated[int | None, doc("previous revision")] = None
    added: Annotated[list[str], doc("files that were not there before")]
    changed: Annotated[list[str], doc("files whose text changed")]
    removed: Annotated[list[str], doc("files that no longer exist")]
    warnings: Annotated[list[Finding], doc("valid lines that may not be intended")]
    monitors: Annotated[list[str], doc("the resulting monitors, in order")]
    moved: Annotated[
        list[str], doc("monitors in their initial state because they moved to another relay process")
    ] = []
    began: Annotated[
        list[str],
        doc("all monitors that are in their initial state because of this change, including new ones"),
    ] = []
    kept: Annotated[
        list[str], doc("files that a reload left in force although the folder does not have them")
    ] = []
    confirm_by: RollbackDue = None
    disabled: Annotated[list[str], doc("loaded monitors that do nothing until they are enabled")] = []
    shadow: Annotated[list[str], doc("loaded monitors in shadow mode")] = []
    held: Annotated[
        dict[str, str], doc("loaded monitors that hold their topics until they are resumed, and why")
    ] = {}
