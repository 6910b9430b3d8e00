"""The bounded values in requests, and the bodies of REST that several requests share."""

from typing import Annotated

import msgspec

from appliance.channel.answers.field_docs import doc

WHOLE = r"(?!\n)"  # follows `$`, because Python's `$` also matches before a final newline
LONGEST_REVISION = 10**15
DATED = "dated"
DATE = Annotated[str, msgspec.Meta(max_length=64)]  # RFC 3339, for a field with the extra `DATED`
Text = Annotated[str, msgspec.Meta(min_length=1, max_length=1 << 20)]
WholeText = Annotated[Text, doc("the whole text, as written")]
Signature = Annotated[
    str,
    doc(
        "the site's signature, where required: what `rosrv sign FILE --key KEY` writes to FILE.sig",
        max_length=8192,
    ),
]
MonitorName = Annotated[str, msgspec.Meta(min_length=1, max_length=256)]
FILE_NAME = r"^[A-Za-z0-9_][A-Za-z0-9_.+ -]{0,190}\.rv$"
FileName = Annotated[str, msgspec.Meta(max_length=200, pattern=FILE_NAME + WHOLE)]
DEFINITION = r"^[A-Za-z][A-Za-z0-9_]*/[A-Za-z][A-Za-z0-9_]*\.(msg|srv)$"
Definition = Annotated[str, msgspec.Meta(max_length=200, pattern=DEFINITION + WHOLE)]
LONGEST_TEXT = 1 << 20
FileText = Annotated[str, msgspec.Meta(max_length=LONGEST_TEXT)]
Definitions = Annotated[
    dict[Definition, FileText],
    doc(
        "definitions of message and service types that ROS does not ship, by `package/Type.msg`",
        max_length=10_000,
    ),
]
NOTE_LENGTH = 200
Note = Annotated[str, msgspec.Meta(max_length=NOTE_LENGTH)]
RevisionNote = Annotated[Note, doc("reason for the change, stored with the revision")]
Signatures = Annotated[
    dict[MonitorName, Signature], doc("signatures by the names of files and definitions", max_length=2000)
]
Revision = Annotated[Annotated[int, msgspec.Meta(ge=1, le=LONGEST_REVISION)] | None, doc("its number")]
_Number = Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]  # the channel takes no larger ones
GivenValue = bool | _Number | float | Annotated[str, msgspec.Meta(max_length=256)]
GivenOfMonitor = Annotated[dict[MonitorName, GivenValue], msgspec.Meta(min_length=1, max_length=100)]


SwitchSeconds = Annotated[
    Annotated[float, msgspec.Meta(gt=0, le=2_592_000)] | None,
    doc("with `enabled` false: enable it again automatically after this time"),
]


class Switch(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The wanted state of a monitor: exactly one of `enabled`, `shadow` and `held`."""

    enabled: Annotated[bool | None, doc("null: unchanged")] = None
    for_seconds: SwitchSeconds = None
    held: Annotated[bool | None, doc("false: resume its topics")] = None
    shadow: Annotated[
        bool | None,
        doc(
            "with true, put it into shadow mode, where its would-be actions are only recorded; with false, end"
            " shadow mode"
        ),
    ] = None

    def __post_init__(self) -> None:
        if [self.enabled, self.held, self.shadow].count(None) != 2 or self.held is True:
            raise ValueError("one of `enabled` (true or false), `shadow` (true or false) and `held` (false)")
        if self.for_seconds is not None and self.enabled is not False:
            raise ValueError("`for_seconds` goes with `enabled`: false")


class SwitchMany(Switch, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The wanted state of several monitors. Nothing changes if one of the names is unknown."""

    names: Annotated[list[MonitorName], doc("names of monitors", min_length=1, max_length=1000)]
