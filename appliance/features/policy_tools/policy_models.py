"""Structs of `/v1/policy` besides control's answers."""

from typing import Annotated, Literal

import msgspec

from appliance.api.front.problems import Finding
from appliance.channel.answers.field_docs import Moment, doc
from appliance.channel.rest_bodies import Text
from appliance.policy.model import Category

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
    caller_id: Annotated[str, doc("the client's name, or empty if it gave none")]
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


class RuleText(msgspec.Struct, frozen=True):
    """A rule and its place in a file."""

    section: str
    key: str
    file: str
    line: int


class RuleUsed(msgspec.Struct, frozen=True):
    """A rule that grants something, and its use. The hosts are the words of the rule."""

    rule: RuleText
    state: Annotated[
        Literal["used", "unused", "unknown"],
        doc(
            "`unknown`: the uses may be among records that the log removed, only counts, or that were not read"
        ),
    ]
    used: Annotated[int, doc("number of uses")]
    unused_hosts: Annotated[list[str], doc("without a use")]
    unknown_hosts: Annotated[list[str], doc("perhaps without a use")]


class PolicyUses(msgspec.Struct, frozen=True):
    """The uses of the rules of the policy in force since a time. Registrations that live now count as uses."""

    revision: int
    since: Moment
    whole: Annotated[bool, doc("whether all records since that time were read")]
    rules: list[RuleUsed]


class LostRule(msgspec.Struct, frozen=True):
    """A rule about the resource that does not decide."""

    rule: RuleText
    would: Literal["allow", "deny"]
    why: str


class Explained(msgspec.Struct, frozen=True, kw_only=True):
    """The decision of a request with its reason; `node` is the right to the node's name, if it is also needed."""

    host: str
    caller_id: str
    category: str
    resource: str
    decision: Decided
    rule: RuleText | None
    reason: str
    told: Annotated[
        str | None, doc("text of the answer to a denied host ([Options] tell), or null if it is allowed")
    ]
    through: Annotated[list[str], doc("words of the rule that match the host")]
    limit: Annotated[
        str, doc("the limit on allowed messages, and its line of [Limits], or empty if there is none")
    ]
    lost: list[LostRule]
    node: Annotated["Explained | None", doc("the node name that the host gives, if the action needs a node")]
    command: Annotated[
        "Explained | None",
        doc("the rule for the command that does it: `lookupService`, `getParam`, `setParam`"),
    ]
    allowed: Annotated[bool, doc("the decision on the whole call")]


class Question(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A request to explain; `text` is another policy than the one in force."""

    host: Annotated[str, doc("an address, or `robot`", min_length=1, max_length=100)]
    node: Annotated[str, msgspec.Meta(max_length=256)] = ""
    category: Category
    resource: Annotated[str, msgspec.Meta(min_length=1, max_length=256)]
    text: Annotated[str, msgspec.Meta(max_length=1 << 20)] | None = None


class Draft(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The text on which the tests run, or null for the policy in force."""

    text: Text | None = None


class Case(msgspec.Struct, frozen=True, kw_only=True):
    """A test case: the expected and the present decision; `line` and `column` are its place in `file`."""

    file: str
    line: int
    column: int
    host: str
    caller_id: str
    category: str
    resource: str
    expected: Literal["allow", "deny", "ask"]
    decision: Decided
    reason: str
    passed: bool


class Tested(msgspec.Struct, frozen=True, kw_only=True):
    """The test cases of the policy, at most a thousand; none if the file does not exist."""

    file: str
    exists: bool
    passed: int
    failed: int
    cases: Annotated[list[Case], doc("failed cases first")]
