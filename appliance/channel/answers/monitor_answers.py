"""The monitors: their state and counters, and what a change of them did."""

from typing import Annotated

import msgspec

from appliance.channel.answers.field_docs import Moment, told

Tag = Annotated[
    str,
    told(
        "another after every change, switch and resumption; in quotes it is the ETag, and what If-Match takes"
    ),
]
RvState = tuple[int, int, list[tuple[str, str, int, int]]]


class MonitorState(msgspec.Struct, frozen=True):
    """A running monitor; counters since it was loaded or its relay began."""

    name: str
    file: Annotated[str, told("the specification file it stands in; a file may have several monitors")]
    enabled: Annotated[bool, told("what it does is done; false while it is in shadow mode")]
    held: Annotated[bool, told("blocks its topics until it is resumed")]
    failing: bool
    topics: list[str]
    services: list[str]
    events: int
    verdicts: int
    drops: int
    changes: int
    faults: int
    certificates: Annotated[
        list[str],
        told("of each property: whether its automaton was proved to be what is written, or why not"),
    ]
    trial: Annotated[bool, told("the same as `shadow`; deprecated")] = False
    would_drop: Annotated[int, told("messages that it would have dropped since it is in shadow mode")] = 0
    would_change: Annotated[int, told("the same of changes")] = 0
    missed: Annotated[
        int,
        told("messages that it was not given in shadow mode, or not to the end: its counts are not complete"),
    ] = 0
    slices: Annotated[
        int, told("bindings of its parameters that are monitored now; 0 of one without parameters")
    ] = 0
    slice_limit: Annotated[int, told("at most so many at a time; 0 of one without parameters")] = 0
    why_held: Annotated[str, told("why its state was lost, if it holds its topics for that")] = ""
    shadow: Annotated[
        bool, told("in shadow mode: given copies of messages, to record what it would have done")
    ] = False
    off_until: Annotated[Moment | None, told("disabled, and enabled again by itself then; null: no end")] = (
        None
    )


class Monitors(msgspec.Struct, frozen=True):
    """The specifications in force; `loaded` is seconds since the epoch."""

    revision: int
    tag: Tag
    who: str
    note: str
    loaded: Moment
    confirm_by: Annotated[Moment | None, told("when it goes back automatically unless confirmed")]
    folder: Annotated[str | None, told("what `reload` reads; null: no folder was given at start")]
    differs_from_folder: bool
    warnings: list[str]
    refused: Annotated[list[str], told("why the relay does not take them: everything is blocked then")]
    rv_state: Annotated[
        RvState, told("ROSRV's `getRVState`: ROSMaster's port, RVMaster's, and where topics are carried")
    ]
    site_keys: Annotated[list[str], told("with any, one of them must have signed what is loaded")]
    monitors: Annotated[list[MonitorState], told("in the order in which they see messages")]
    files: Annotated[dict[str, str] | None, told("with `texts=1`: specifications by file name")] = None
    definitions: Annotated[dict[str, str] | None, told("with `texts=1`: those that came with them")] = None
    signatures: Annotated[dict[str, str] | None, told("with `texts=1`: the site's, by the same names")] = None


class Tried(msgspec.Struct, frozen=True):
    """The effect that a load would have on the revision in force; `warnings` are lines, `monitors` the resulting
    monitors.
    """

    revision: int
    tag: str
    added: list[str]
    changed: list[str]
    removed: list[str]
    warnings: list[str]
    monitors: list[str]


class Replacement(msgspec.Struct, frozen=True):
    """The effect of a change of the specifications; `replaced` is the revision before, `warnings` are lines.

    `moved` are monitors that began in their initial state because another relay process has them now, `began` all that
    did: new ones, edited ones, and those whose messages have another definition. `kept` are files that a reload left in
    force although the folder does not have them.
    """

    revision: int
    tag: str
    replaced: int
    added: list[str]
    changed: list[str]
    removed: list[str]
    warnings: list[str]
    moved: list[str]
    began: list[str]
    kept: list[str]
    confirm_by: Moment | None


class MonitorsConfirmed(msgspec.Struct, frozen=True):
    """Whether there was something to confirm."""

    confirmed: bool
    revision: int
    tag: Tag


class MonitorRevision(msgspec.Struct, frozen=True):
    """Specifications that came into force; `loaded` is seconds since the epoch."""

    revision: int
    loaded: Moment
    who: str
    note: str
    in_force: bool
    names: Annotated[list[str], told("of its files")]


class MonitorRevisionList(msgspec.Struct, frozen=True):
    """The kept revisions, the newest first."""

    revisions: list[MonitorRevision]


class RevisionTexts(MonitorRevision, frozen=True):
    """A kept revision with its texts."""

    files: Annotated[dict[str, str], told("specifications by file name")]
    definitions: Annotated[dict[str, str], told("those that came with them")]
    signatures: Annotated[dict[str, str], told("the site's, by the names of files and definitions")]


class Switched(msgspec.Struct, frozen=True):
    """The monitors that were not so already."""

    names: list[str]
    revision: int
    tag: Tag
    began: Annotated[
        list[str], told("of those that are in shadow mode now or were: which are in their initial state")
    ] = []
