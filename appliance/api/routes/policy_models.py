"""Structs of `/v1/policy` besides control's answers."""

from typing import Annotated, Literal

import msgspec

from appliance.api.front.problems import Finding
from appliance.channel.answers.field_docs import Moment, doc

Decided = Literal["allow", "deny", "would deny", "ask"]


class Change(msgspec.Struct, frozen=True):
    """Something that is registered now and would be decided differently."""

    host: str
    caller_id: str
    category: str
    resource: str
    now: Decided
    then: Decided
    reason: Annotated[str, doc("of the new policy")]


class Ended(msgspec.Struct, frozen=True):
    """Something live, such as a connection, that the policy ends."""

    host: str
    caller_id: Annotated[str, doc("empty: the client gave no name")]
    what: Literal["publication", "subscription", "service", "call", "parameter"]
    resource: str
    reason: str


class Report(msgspec.Struct, frozen=True, kw_only=True):
    """The effect of a new policy; `loaded` is false after a dry run, in which values that only a load finds are
    null.
    """

    loaded: bool
    revision: Annotated[int, doc("in force now")]
    replaced: int | None = None
    revoked: Annotated[int | None, doc("number of registrations and connections that were revoked")] = None
    confirm_by: Moment | None = None
    warnings: list[Finding]
    changes: list[Change]
    ends: Annotated[list[Ended], doc("live registrations and connections that end with the change")]
