"""What `/v1/monitors` takes and gives besides what RVMaster answers."""

from typing import Annotated

import msgspec

from appliance.api.policy_models import Signature
from appliance.api.problems import Finding
from appliance.channel.answers.field_docs import Moment, told
from appliance.channel.answers.monitor_answers import MonitorState, Tag

_WHOLE = r"(?!\n)"  # after `$`, which Python finds before a last newline, too
Name = Annotated[str, msgspec.Meta(min_length=1, max_length=256)]
FileName = Annotated[
    str, msgspec.Meta(max_length=200, pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,190}\.rv$" + _WHOLE)
]
Definition = Annotated[
    str,
    msgspec.Meta(
        max_length=200, pattern=r"^[A-Za-z][A-Za-z0-9_]*/[A-Za-z][A-Za-z0-9_]*\.(msg|srv)$" + _WHOLE
    ),
]
Text = Annotated[str, msgspec.Meta(max_length=1 << 20)]
Definitions = Annotated[
    dict[Definition, Text],
    told(
        "definitions of messages and services that ROS does not ship, by `package/Type.msg`", max_length=1000
    ),
]
Note = Annotated[str, told("kept with the revision: why", max_length=200)]
Signatures = Annotated[dict[Name, Signature], told("by the names of files and definitions", max_length=2000)]


class EventShown(msgspec.Struct, frozen=True, kw_only=True):
    """An event of a specification: on a topic, in a service's request or response, or `every` so many seconds."""

    name: str
    line: int
    topic: str | None
    type: str | None
    part: Annotated[str | None, told("of a service: request or response")]
    every: Annotated[float | None, told("so many seconds; null: not this way")]


class PropertyShown(msgspec.Struct, frozen=True, kw_only=True):
    """A property of a specification; `drawn`: `…/picture` shows its automaton."""

    logic: str
    formula: str
    categories: list[str]
    handled: list[str]
    drawn: bool


class Happened(msgspec.Struct, frozen=True, kw_only=True):
    """Something a monitor did, as it is in the audit log under this sequence; `count`: more of the same."""

    sequence: int
    time: Annotated[str, told("RFC 3339, UTC, nanoseconds")]
    event: str
    resource: str | None
    reason: str
    category: Annotated[str | None, told("of a verdict")]
    count: int | None


class Monitor(MonitorState, frozen=True, kw_only=True):
    """A monitor with the text it was made of."""

    revision: int
    tag: Tag
    text: Annotated[str, told("of its whole file")]
    alphabet: Annotated[list[EventShown], told("its events")]
    properties: list[PropertyShown]
    warnings: Annotated[list[Finding], told("of its file")]
    uses: Annotated[list[str], told("monitors whose variables it uses")]
    hold: Annotated[bool, told("declared `hold`: blocks its topics after a restart of the relay")]


class History(msgspec.Struct, frozen=True):
    """What a monitor did last, the newest first."""

    name: str
    happened: list[Happened]
    cursor: Annotated[str | None, told("of the next page; null: there is none")]


class NewSpecifications(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Specifications to add, or to put in the place of those in files of the same name."""

    files: Annotated[
        dict[FileName, Text], told("texts by the name of the file", min_length=1, max_length=1000)
    ]
    definitions: Definitions = {}
    note: Note = ""
    signatures: Signatures = {}


class NewText(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The new text of the file that a monitor stands in."""

    text: Annotated[str, msgspec.Meta(min_length=1, max_length=1 << 20)]
    definitions: Definitions = {}
    note: Note = ""
    signature: Signature = ""
    signatures: Annotated[Signatures, told("of the definitions")] = {}


class Replaced(msgspec.Struct, frozen=True, kw_only=True):
    """What a change did, or after a dry run (`loaded` false) would do; `replaced` is the revision before."""

    loaded: bool
    revision: Annotated[int, told("in force now")]
    tag: Tag
    replaced: int | None = None
    added: list[str]
    changed: list[str]
    removed: list[str]
    warnings: list[Finding]
    monitors: Annotated[list[str], told("those that there are (would be), in order")]
    moved: Annotated[
        list[str], told("monitors that began anew because another relay process has them now")
    ] = []
    began: Annotated[
        list[str], told("all monitors that are in their initial state by this change, new ones among them")
    ] = []
    kept: Annotated[
        list[str], told("files that a reload left in force although the folder does not have them")
    ] = []
    confirm_by: Annotated[Moment | None, told("when it goes back by itself unless confirmed")] = None


class Switch(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is to become of a monitor: exactly one of `enabled`, `shadow` and `held` (or `trial`)."""

    enabled: bool | None = None
    for_seconds: Annotated[
        Annotated[float, msgspec.Meta(gt=0, le=2_592_000)] | None,
        told("with `enabled` false: enable it again by itself after this time"),
    ] = None
    held: Annotated[bool | None, told("false: let its topics go on")] = None
    shadow: Annotated[
        bool | None,
        told("true: shadow mode, it only records what it would have done; false: from there into force"),
    ] = None
    trial: Annotated[bool | None, told("the same as `shadow`; deprecated")] = None

    def __post_init__(self) -> None:
        """Raises `ValueError`."""
        if [self.enabled, self.held, self.shadow, self.trial].count(None) != 3 or self.held is True:
            raise ValueError("one of `enabled` (true or false), `shadow` (true or false) and `held` (false)")
        if self.for_seconds is not None and self.enabled is not False:
            raise ValueError("`for_seconds` goes with `enabled`: false")


class SwitchMany(Switch, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The same for several monitors at once: all of them, or none when there is an unknown name."""

    names: Annotated[list[Name], msgspec.Meta(min_length=1, max_length=1000)]
