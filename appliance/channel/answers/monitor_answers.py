"""The monitors: their state and counters, and what a change of them did."""

import re
from collections.abc import Iterable
from typing import Annotated, Any, Literal

import msgspec

from appliance.channel.answers.field_docs import (
    FromOne,
    Moment,
    Name,
    RevisionNote,
    RevisionNumber,
    RollbackDue,
    Who,
    doc,
)

Tag = Annotated[
    str,
    doc("changes with every load, switch and resumption; in quotes it is the ETag, which If-Match takes"),
]
_PLACE = re.compile(r":([0-9]{1,9}+):([0-9]{1,9}+): (error|warning): ")
RvState = tuple[int, int, list[tuple[str, str, int, int]]]


class GivenState(msgspec.Struct, frozen=True):
    """A constant or a topic that is given to a monitor."""

    name: Name
    kind: Annotated[str, doc("`int`, `double`, `bool` or `topic`")]
    value: Annotated[bool | int | float | str, doc("the value in force, in the unit")]
    unit: Annotated[str, doc("the unit of the values, as the text of the specification has it")]
    default: Annotated[
        bool | int | float | str, doc("the value in the text of the specification, in the unit")
    ]
    least: Annotated[
        int | float | None, doc("the least value, in the unit, or null if it is not a number")
    ] = None
    most: Annotated[
        int | float | None, doc("the greatest value, in the unit, or null if it is not a number")
    ] = None


class MonitorReadout(msgspec.Struct, frozen=True):
    """The variables of a monitor, as its relay has them now or had them when it last answered."""

    name: Name
    values: Annotated[
        dict[str, Any],
        doc(
            "by name; long values are cut and the rest is counted (`… 344 more`), NaN and infinity are strings, times"
            " are seconds"
        ),
    ]
    ages: Annotated[
        dict[str, float | None],
        doc(
            "seconds since the last message of each event whose age the specification uses, or null if there was none"
        ),
    ]
    age_seconds: Annotated[
        float | None, doc("seconds since the relay answered, or null if it has not answered since the load")
    ]
    why_old: Annotated[str, doc("why the values are not the present ones; empty if they are")] = ""
    now_seconds: Annotated[
        float | None, doc("the present time of the monitors' clock, for values that are times since 1970")
    ] = None


class MonitorState(msgspec.Struct, frozen=True):
    """A running monitor; its counters start when it is loaded or its relay starts."""

    name: Name
    file: Annotated[str, doc("the specification file that defines it; a file may have several monitors")]
    enabled: Annotated[bool, doc("its actions take effect; false while it is in shadow mode")]
    held: Annotated[bool, doc("blocks its topics until it is resumed")]
    failing: Annotated[bool, doc("whether its actions fault; such messages are dropped or pass (`on_fault`)")]
    topics: Annotated[list[str], doc("topics of its events")]
    services: Annotated[list[str], doc("services of its events")]
    events: Annotated[int, doc("number of events that it received")]
    verdicts: Annotated[int, doc("number of verdicts of its properties")]
    drops: Annotated[int, doc("number of messages that it dropped")]
    changes: Annotated[int, doc("number of messages that it changed")]
    faults: Annotated[int, doc("number of actions that failed")]
    certificates: Annotated[
        list[str],
        doc("for each property: whether its automaton is proved equal to the formula, or why not"),
    ]
    would_drop: Annotated[int, doc("messages that it would have dropped since shadow mode began")] = 0
    would_change: Annotated[int, doc("messages that it would have changed since shadow mode began")] = 0
    missed: Annotated[
        int,
        doc("messages that it did not get, or did not finish, in shadow mode: its counts are incomplete"),
    ] = 0
    slices: Annotated[int, doc("bindings of its parameters that are monitored now; 0 without parameters")] = 0
    slice_limit: Annotated[int, doc("maximum number of slices at a time; 0 without parameters")] = 0
    why_held: Annotated[str, doc("why its state was lost, if it holds its topics because of that")] = ""
    shadow: Annotated[
        bool, doc("in shadow mode: it gets copies of messages, and its would-be actions are recorded")
    ] = False
    off_until: Annotated[Moment | None, doc("when it is enabled again automatically, or null if never")] = (
        None
    )
    given: Annotated[list[GivenState], doc("constants and topics that are given to it")] = []
    confirm_by: Annotated[
        Moment | None, doc("when it returns to shadow mode unless confirmed, or null if it stays as it is")
    ] = None
    lasting: Annotated[
        Literal["on", "shadow", "off"], doc("its state without a switch that ends automatically")
    ] = "on"
    error: Annotated[str, doc("the error of its file, because of which it does nothing; else empty")] = ""


class Monitors(msgspec.Struct, frozen=True):
    """The specifications in force; `loaded` is seconds since the epoch."""

    revision: RevisionNumber
    tag: Tag
    who: Who
    note: RevisionNote
    loaded: Moment
    confirm_by: RollbackDue
    folder: Annotated[
        str | None, doc("the folder that `reload` reads, or null if none was given at the start")
    ]
    differs_from_folder: Annotated[bool, doc("whether the specifications in force differ from their folder")]
    warnings: Annotated[list[str], doc("found when they were loaded")]
    refused: Annotated[
        list[str], doc("why the relay rejects the specifications: all topics are blocked then")
    ]
    rv_state: Annotated[
        RvState,
        doc("ROSRV's `getRVState`: ports of the ROS master and of RVMaster, and the addresses of topics"),
    ]
    site_keys: Annotated[list[str], doc("if there are any, one of them must have signed what is loaded")]
    monitors: Annotated[list[MonitorState], doc("in the order in which they see messages")]
    files: Annotated[dict[str, str] | None, doc("with `texts=1`: specifications by file name")] = None
    definitions: Annotated[
        dict[str, str] | None, doc("with `texts=1`: type definitions that were loaded with them")
    ] = None
    signatures: Annotated[
        dict[str, str] | None, doc("with `texts=1`: the site's signatures, by the same names")
    ] = None
    topics: Annotated[
        dict[str, dict[str, str]] | None,
        doc("with `texts=1`: topics that replace those given in the texts, by monitor and name"),
    ] = None
    on_fault: Annotated[
        Literal["drop", "pass"], doc("whether a message at which a monitor faults is dropped or passes")
    ] = "drop"
    slices: Annotated[int, doc("maximum number of slices of a monitor with parameters")] = 100_000


class GivenSet(msgspec.Struct, frozen=True):
    """Everything that is given to a monitor, after a change; `changed` names what the change set."""

    name: Name
    changed: Annotated[list[str], doc("constants and topics that the change set")]
    given: Annotated[list[GivenState], doc("constants and topics that are given to it")]
    revision: RevisionNumber
    tag: Tag


class Finding(msgspec.Struct, frozen=True):
    """One thing wrong with a text that was sent; `line` and `column` count from 1."""

    file: Name
    line: FromOne
    column: FromOne
    severity: Annotated[str, doc("error or warning")]
    text: Annotated[str, doc("the error and what to do")]

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}: {self.severity}: {self.text}"


def findings_of(texts: Iterable[str]) -> list[Finding]:
    """Return the findings in texts about specifications; those without a place are left out."""
    found = ((text, _PLACE.search(text)) for text in texts)
    return [
        Finding(one[: at.start()], int(at[1]), int(at[2]), at[3], one[at.end() :]) for one, at in found if at
    ]


class Replacement(msgspec.Struct, frozen=True):
    """The effect of a change of the specifications; `replaced` is the revision before, `warnings` are lines.

    `moved` are monitors that began in their initial state because another relay process has them now, `began` all that
    did: new ones, edited ones, and those whose messages have another definition. `kept` are files that a reload left in
    force although the folder does not have them.
    """

    revision: RevisionNumber
    tag: Annotated[str, doc("changes with every change; If-Match takes it in quotes")]
    replaced: Annotated[int, doc("previous revision")]
    added: Annotated[list[str], doc("files that were not there before")]
    changed: Annotated[list[str], doc("files whose text changed")]
    removed: Annotated[list[str], doc("files that no longer exist")]
    warnings: Annotated[list[str], doc("valid lines that may not be intended")]
    moved: Annotated[list[str], doc("monitors that began because another relay process has them now")]
    began: Annotated[list[str], doc("monitors that began in their initial state")]
    kept: Annotated[list[str], doc("files that a reload left in force although the folder lacks them")]
    confirm_by: Moment | None
    disabled: Annotated[list[str], doc("loaded monitors that do nothing until they are enabled")] = []
    shadow: Annotated[list[str], doc("loaded monitors in shadow mode")] = []
    held: Annotated[
        dict[str, str], doc("loaded monitors that hold their topics until they are resumed, and why")
    ] = {}


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

    def in_lines(self) -> Replacement:
        """Return the form that guards and the command line print."""
        fields = {name: getattr(self, name) for name in Replacement.__struct_fields__}
        return Replacement(**fields | {"warnings": [*map(str, self.warnings)]})


class MonitorsConfirmed(msgspec.Struct, frozen=True):
    """Whether there was something to confirm."""

    confirmed: Annotated[bool, doc("whether there was something to confirm")]
    revision: RevisionNumber
    tag: Tag


class MonitorRevision(msgspec.Struct, frozen=True):
    """Specifications that came into force; `loaded` is seconds since the epoch."""

    revision: RevisionNumber
    loaded: Moment
    who: Who
    note: RevisionNote
    in_force: Annotated[bool, doc("whether it is in force now")]
    names: Annotated[list[str], doc("names of its files")]


class MonitorRevisionList(msgspec.Struct, frozen=True):
    """The kept revisions, newest first."""

    revisions: Annotated[list[MonitorRevision], doc("newest first")]


class RevisionTexts(MonitorRevision, frozen=True):
    """A kept revision with its texts."""

    files: Annotated[dict[str, str], doc("specifications by file name")]
    definitions: Annotated[dict[str, str], doc("type definitions that were loaded with them")]
    signatures: Annotated[dict[str, str], doc("the site's signatures, by the names of files and definitions")]


class Switched(msgspec.Struct, frozen=True):
    """The monitors whose state changed."""

    names: Annotated[list[str], doc("names of monitors")]
    revision: RevisionNumber
    tag: Tag
    began: Annotated[
        list[str], doc("monitors that entered or left shadow mode and are in their initial state")
    ] = []
    until: Annotated[Moment | None, doc("when they are enabled again automatically, or null if never")] = None
    confirm_by: Annotated[
        Moment | None, doc("when they return to shadow mode unless confirmed, or null if they stay in force")
    ] = None
