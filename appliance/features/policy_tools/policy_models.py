"""Structs of `/v1/policy` besides control's answers."""

from typing import Annotated, Literal

import msgspec

from appliance.channel.answers.field_docs import (
    Address,
    FilePath,
    FromOne,
    Moment,
    Resource,
    RevisionNumber,
    Sentence,
    doc,
)
from appliance.channel.answers.monitor_answers import Finding
from appliance.channel.rest_bodies import Text
from appliance.policy.model import Category

Decided = Literal["allow", "deny", "would deny", "ask"]


class Change(msgspec.Struct, frozen=True):
    """Something that is registered now and would be decided differently."""

    host: Address
    caller_id: Annotated[str, doc("the name the node gave: a claim")]
    category: Annotated[str, doc("what kind of request")]
    resource: Resource
    now: Annotated[Decided, doc("decision by the policy in force")]
    then: Annotated[Decided, doc("decision by the new policy")]
    reason: Annotated[str, doc("of the new policy")]


class Ended(msgspec.Struct, frozen=True):
    """Something live, such as a connection, that the policy ends."""

    host: Address
    caller_id: Annotated[str, doc("the client's name, or empty if it gave none")]
    what: Annotated[Literal["publication", "subscription", "service", "call", "parameter"], doc("its kind")]
    resource: Resource
    reason: Sentence


class Report(msgspec.Struct, frozen=True, kw_only=True):
    """The effect of a new policy; `loaded` is false after a dry run, in which values that only a load finds are
    null.
    """

    loaded: Annotated[bool, doc("false after a dry run: nothing was changed")]
    revision: Annotated[int, doc("in force now")]
    replaced: Annotated[int | None, doc("previous revision")] = None
    revoked: Annotated[int | None, doc("number of registrations and connections that were revoked")] = None
    confirm_by: Moment | None = None
    warnings: Annotated[list[Finding], doc("valid lines that may not be intended")]
    changes: Annotated[
        list[Change], doc("live registrations and connections that would be decided differently")
    ]
    ends: Annotated[list[Ended], doc("live registrations and connections that end with the change")]


class RuleText(msgspec.Struct, frozen=True):
    """A rule and its place in a file."""

    section: Annotated[str, doc("of the policy")]
    key: Annotated[str, doc("key of the rule, as written")]
    file: FilePath
    line: FromOne


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
    ended_hosts: Annotated[list[str], doc("whose right has ended, used or not")] = []


class PolicyUses(msgspec.Struct, frozen=True):
    """The uses of the rules of the policy in force since a time. Registrations that live now count as uses."""

    revision: RevisionNumber
    since: Moment
    whole: Annotated[bool, doc("whether all records since that time were read")]
    rules: Annotated[list[RuleUsed], doc("rules, with what each has matched")]


class LostRule(msgspec.Struct, frozen=True):
    """A rule about the resource that does not decide."""

    rule: RuleText
    would: Annotated[Literal["allow", "deny"], doc("decision that it would make")]
    why: Annotated[str, doc("why it does not decide")]


class Explained(msgspec.Struct, frozen=True, kw_only=True):
    """The decision of a request with its reason; `node` is the right to the node's name, if it is also needed."""

    host: Address
    caller_id: Annotated[str, doc("the name the node gave: a claim")]
    category: Annotated[str, doc("what kind of request")]
    resource: Resource
    decision: Annotated[Decided, doc("the decision")]
    rule: Annotated[RuleText | None, doc("the deciding rule, or null if there is none")]
    reason: Sentence
    told: Annotated[
        str | None, doc("text of the answer to a denied host ([Options] tell), or null if it is allowed")
    ]
    through: Annotated[list[str], doc("words of the rule that match the host")]
    limit: Annotated[
        str, doc("the limit on allowed messages, and its line of [Limits], or empty if there is none")
    ]
    carried: Annotated[
        str, doc("whether [Authority] lets messages to this topic through now, or empty if no group has it")
    ] = ""
    lost: Annotated[list[LostRule], doc("matching rules that are overruled")]
    node: Annotated["Explained | None", doc("the node name that the host gives, if the action needs a node")]
    command: Annotated[
        "Explained | None",
        doc("the rule for the command that does it: `lookupService`, `getParam`, `setParam`"),
    ]
    allowed: Annotated[bool, doc("the decision on the whole call")]


class Question(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A request to explain; `text` is another policy than the one in force."""

    host: Annotated[str, doc("an address, or `robot`", min_length=1, max_length=100)]
    node: Annotated[str, doc("its name", max_length=256)] = ""
    category: Category
    resource: Annotated[str, doc("topic, service, parameter, node or call", min_length=1, max_length=256)]
    text: Annotated[
        Annotated[str, msgspec.Meta(max_length=1 << 20)] | None, doc("the whole text, as written")
    ] = None


class Draft(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The text on which the tests run, or null for the policy in force."""

    text: Annotated[Text | None, doc("the whole text, as written")] = None


class Case(msgspec.Struct, frozen=True, kw_only=True):
    """A test case: the expected and the present decision; `line` and `column` are its place in `file`."""

    file: FilePath
    line: FromOne
    column: FromOne
    host: Address
    caller_id: Annotated[str, doc("the name the node gave: a claim")]
    category: Annotated[str, doc("what kind of request")]
    resource: Resource
    expected: Annotated[Literal["allow", "deny", "ask"], doc("decision that the case expects")]
    decision: Annotated[Decided, doc("the decision")]
    reason: Sentence
    passed: Annotated[bool, doc("whether the decision is the expected one")]


class Tested(msgspec.Struct, frozen=True, kw_only=True):
    """The test cases of the policy, at most a thousand; none if the file does not exist."""

    file: FilePath
    exists: Annotated[bool, doc("whether the file exists")]
    passed: Annotated[int, doc("number of cases that are decided as expected")]
    failed: Annotated[int, doc("number of cases that are decided otherwise")]
    cases: Annotated[list[Case], doc("failed cases first")]
