"""The policy: its revisions, and the effect of a change."""

from typing import Annotated

import msgspec

from appliance.channel.answers.field_docs import (
    FilePath,
    Moment,
    RevisionNote,
    RevisionNumber,
    RollbackDue,
    Who,
    doc,
)


class PolicyRevision(msgspec.Struct, frozen=True):
    """A policy that came into force; `loaded` is seconds since the epoch."""

    revision: RevisionNumber
    file: FilePath
    loaded: Moment
    who: Who
    note: RevisionNote
    in_force: Annotated[bool, doc("whether it is in force now")]


class PolicyRevisionList(msgspec.Struct, frozen=True):
    """The kept revisions, newest first."""

    revisions: Annotated[list[PolicyRevision], doc("newest first")]


class RevisionText(PolicyRevision, frozen=True):
    """A kept revision with its text, and the site's signature (empty if unsigned)."""

    text: Annotated[str, doc("the whole text, as written")]
    signature: Annotated[str, doc("signature with the site key, or empty if it is unsigned")]


class PolicyInForce(RevisionText, frozen=True, kw_only=True):
    """The policy in force. It rolls back at `confirm_by` (seconds since the epoch) unless confirmed."""

    policy_file: Annotated[str, doc("the file that `reload` reads")]
    differs_from_file: Annotated[bool, doc("whether the policy in force differs from its file")]
    warnings: Annotated[list[str], doc("valid lines that may not be intended")]
    confirm_by: Moment | None
    site_keys: Annotated[list[str], doc("if there are any, one of them must have signed what is loaded")]
    robot: Annotated[list[str], doc("addresses and networks of the group robot")]
    hosts: Annotated[dict[str, str], doc("address of each enrolled host, for host:NAME")]
    blocks: Annotated[
        dict[str, str],
        doc("hosts that an operator blocks, by address: the end of the reason of their denials"),
    ] = {}
    holders: Annotated[dict[str, str], doc("address of the host that holds each group of [Authority]")] = {}
    approved: Annotated[list[list[str]], doc("approvals that last: host, category, name")] = []
    own: Annotated[
        list[str],
        doc(
            "other addresses of the robot's machine, which are in the group robot unless the policy names them"
        ),
    ] = []
    now: Annotated[
        float | None,
        doc(
            "the time that decides rights with a time, in seconds since the epoch, or null if the clock is not set"
        ),
    ] = None
    ended: Annotated[list[float], doc("ends of rights that have passed, in seconds since the epoch")] = []
    lasting: Annotated[list[float], doc("ends of rights that have not passed by the age clock")] = []


class PolicyKnown(PolicyInForce, frozen=True):
    """A revision, with everything needed to compare it with another text.

    `cases` are the policy's tests, or None; `cases_error` is the reason if they cannot be read.
    """

    cases_file: str
    cases: str | None
    cases_error: str | None


class Loaded(msgspec.Struct, frozen=True):
    """A policy came into force and replaced the revision `replaced`."""

    revision: RevisionNumber
    replaced: Annotated[int, doc("previous revision")]
    warnings: Annotated[list[str], doc("valid lines that may not be intended")]
    revoked: Annotated[int, doc("number of registrations and connections that were revoked")]
    confirm_by: RollbackDue


class PolicyConfirmed(msgspec.Struct, frozen=True):
    """Whether there was something to confirm."""

    confirmed: Annotated[bool, doc("whether there was something to confirm")]
    revision: RevisionNumber


class Why(msgspec.Struct, frozen=True, kw_only=True):
    """The explanation of a record; for a denial also the change of the policy that would allow it."""

    lines: Annotated[
        list[str],
        doc("explanation for people: who acted, the events and values that caused it, with files and lines"),
    ]
    grant: Annotated["Granted | None", doc("for a denial: the smallest change that would allow the request")]
    refusal: Annotated[
        str, doc("for a denial: why no change of the policy would allow the request; else empty")
    ]


class Granted(msgspec.Struct, frozen=True, kw_only=True):
    """The smallest change of the policy in force that grants a denied request of a record. Nothing is changed."""

    revision: Annotated[int, doc("revision of the policy that the change is for")]
    reason: Annotated[str, doc("reason in the record")]
    added: Annotated[
        list[str],
        doc(
            "a line for each missing right, or none if the policy allows the request, and something else denied it"
        ),
    ]
    diff: Annotated[list[str], doc("lines of the unified diff")]
    text: Annotated[str, doc("the whole changed policy, ready to be loaded")]
    findings: Annotated[list[str], doc("why it would be rejected: the test cases that it fails")]
    tool: Annotated[
        str, doc("the stock tool that was denied, such as rostopic, or empty if it is not one")
    ] = ""
    tool_needs: Annotated[
        list[str], doc("the lines that this tool also needs, which `?tool=1` adds to the change")
    ] = []
