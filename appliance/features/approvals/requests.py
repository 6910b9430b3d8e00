"""Define the requests of operators' tools about approvals, and their answers."""

from typing import Annotated, Literal

import msgspec

from appliance.channel.admin import AdminRequest, WaitingRequest
from appliance.channel.answers.field_docs import doc
from appliance.channel.rest_operation import Body, parameter, rest

SHORTEST, LONGEST = 1.0, 3600.0
WITHHELD = "withheld"
_PROBLEMS = {
    404: "No call has this number any longer.",
    422: "The approval cannot last so long, or another operator has answered the call.",
}
Number = Annotated[int, parameter("number of the held call", ge=1, le=10**15, examples=[48213])]


class Approval(msgspec.Struct, frozen=True):
    """A held call, or an approval."""

    number: Annotated[int, doc("its number, for `rosrv approve`")]
    state: Annotated[
        Literal["waits", "approved", "lease", "refused"],
        doc("waits: for an operator; approved: for one call; lease: for all calls of this name"),
    ]
    host: Annotated[str, doc("address of the host")]
    caller_id: Annotated[str, doc("the node that called first; not verified")]
    category: Annotated[
        Literal["publish", "call", "write"], doc("publish a topic, call a service, write a parameter")
    ]
    resource: Annotated[str, doc("the topic, service or parameter")]
    type: Annotated[str, doc("type of the service; empty for a topic or a parameter")]
    sha256: Annotated[
        str,
        doc("hash of the arguments, `withheld` for viewers, or empty if the approval is for any arguments"),
    ]
    arguments: Annotated[
        str,
        doc(
            "first 4096 bytes of the arguments as the service would get them, in hexadecimal; empty for viewers"
        ),
    ]
    size: Annotated[
        int, doc("bytes of all arguments; if they are more, an approval is for bytes that are not shown")
    ]
    left_seconds: Annotated[float, doc("until it ends")]
    who: Annotated[str, doc("the operator who approved or refused it")]


class Approvals(msgspec.Struct, frozen=True):
    """All held calls and approvals."""

    approvals: Annotated[list[Approval], doc("in the order of their numbers")]


@rest("viewer", "GET", "/v1/approvals", name="approvals")
class ApprovalsWanted(AdminRequest[Approvals], frozen=True, tag="approvals"):
    """The calls that wait for an approval, and the valid approvals."""


@rest(
    "operator", "POST", "/v1/approvals/{number}/approve", name="approve", problems=_PROBLEMS,
    body=Body(
        "ApprovalTime",
        "How long the approval lasts; by default one call of a service, or 60 s for a topic or a parameter.",
    ),
)  # fmt: skip
class ApproveCall(WaitingRequest[Approval], frozen=True, tag="approve"):
    """Approve a held call, once or for some time."""

    number: Number
    seconds: Annotated[
        Annotated[float, msgspec.Meta(ge=SHORTEST, le=LONGEST)] | None,
        doc("for all calls of the same host and name in this time, with any arguments"),
    ] = None
    waits: Annotated[
        bool,
        doc(
            "approve only a call that still waits; otherwise also one that is approved, or that the same person refused"
        ),
    ] = False


@rest("operator", "POST", "/v1/approvals/{number}/refuse", name="approval_refuse", problems=_PROBLEMS)
class RefuseCall(WaitingRequest[Approval], frozen=True, tag="approval refuse"):
    """Refuse a held call, or end an approval."""

    number: Number


REQUESTS = (ApprovalsWanted, ApproveCall, RefuseCall)
