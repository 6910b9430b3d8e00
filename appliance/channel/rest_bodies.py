"""The bodies of REST requests; the rows in `channel/admin.py` refer to them. An unknown field is an error."""

from typing import Annotated

import msgspec

from appliance.channel.answers.field_docs import doc

WHOLE = r"(?!\n)"  # follows `$`, because Python's `$` also matches before a final newline
LONGEST_REVISION = 10**15
Text = Annotated[str, msgspec.Meta(min_length=1, max_length=1 << 20)]
Signature = Annotated[
    str,
    doc(
        "the site's signature, where required: what `rosrv sign FILE --key KEY` writes to FILE.sig",
        max_length=8192,
    ),
]
MonitorName = Annotated[str, msgspec.Meta(min_length=1, max_length=256)]
FileName = Annotated[
    str, msgspec.Meta(max_length=200, pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,190}\.rv$" + WHOLE)
]
Definition = Annotated[
    str,
    msgspec.Meta(max_length=200, pattern=r"^[A-Za-z][A-Za-z0-9_]*/[A-Za-z][A-Za-z0-9_]*\.(msg|srv)$" + WHOLE),
]
FileText = Annotated[str, msgspec.Meta(max_length=1 << 20)]
Definitions = Annotated[
    dict[Definition, FileText],
    doc(
        "definitions of message and service types that ROS does not ship, by `package/Type.msg`",
        max_length=1000,
    ),
]
Note = Annotated[str, doc("reason for the change, stored with the revision", max_length=200)]
Signatures = Annotated[
    dict[MonitorName, Signature], doc("signatures by the names of files and definitions", max_length=2000)
]
GivenNanoMoment = Annotated[
    Annotated[int, msgspec.Meta(ge=0, le=(1 << 63) - 1)] | Annotated[str, msgspec.Meta(max_length=64)] | None,
    doc("RFC 3339, or nanoseconds since the epoch"),
]


_Number = Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]  # the channel takes no larger ones
GivenValue = bool | _Number | float | Annotated[str, msgspec.Meta(max_length=256)]
GivenOfMonitor = Annotated[dict[MonitorName, GivenValue], msgspec.Meta(min_length=1, max_length=100)]


class PolicyText(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A new policy."""

    text: Annotated[Text, doc("the whole text, as written")]
    note: Annotated[str, doc("reason for the change, stored with the revision", max_length=200)] = ""
    signature: Signature = ""


class Rollback(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The revision to return to, or null for the revision before the present one."""

    revision: Annotated[Annotated[int, msgspec.Meta(ge=1, le=LONGEST_REVISION)] | None, doc("its number")] = (
        None
    )


class NewSpecifications(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Specifications to add; they replace those in files of the same name."""

    files: Annotated[
        dict[FileName, FileText], doc("texts by the name of the file", min_length=1, max_length=1000)
    ]
    definitions: Definitions = {}
    note: Note = ""
    signatures: Signatures = {}
    given: Annotated[
        dict[MonitorName, GivenOfMonitor],
        doc("constants and topics that are given to monitors, by monitor and name", max_length=1000),
    ] = {}


class GivenValues(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """New values of constants that are given to a monitor, by name."""

    values: Annotated[GivenOfMonitor, doc("in the units of the text, within the ranges of the text")]


class NewText(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The new text of the file that contains a monitor."""

    text: Annotated[str, doc("the whole text, as written", min_length=1, max_length=1 << 20)]
    definitions: Definitions = {}
    note: Note = ""
    signature: Signature = ""
    signatures: Annotated[Signatures, doc("signatures of the definitions")] = {}


class Switch(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The wanted state of a monitor: exactly one of `enabled`, `shadow` and `held`."""

    enabled: Annotated[bool | None, doc("null: unchanged")] = None
    for_seconds: Annotated[
        Annotated[float, msgspec.Meta(gt=0, le=2_592_000)] | None,
        doc("with `enabled` false: enable it again automatically after this time"),
    ] = None
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
