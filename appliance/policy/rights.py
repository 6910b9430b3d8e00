"""What a call needs: the one place that knows which rules must grant it.

RVMaster's gate, the revocation of what is live, `explain`, the cases beside a policy, `diff` and `learn` all ask here,
so that none of them can allow what another denies. `rights_of_call` has the rights of a whole call, `rights_of` those
of a deed that a person names (`publish /cmd_vel`), `decide` makes one decision of them.

A right is a question to one section. All must be granted:

1. the deed itself: a topic, a service, or the call as a command;
2. the command that carries it out, where that has a rule of its own (`COMMAND_FOR`);
3. for a call that is about a parameter, reading or writing that, with what is below it and what it takes the place of;
4. for what makes a node part of the graph, its name.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

from appliance.policy.model import Address, Category, Decision, Request
from appliance.policy.policy import Policy
from appliance.policy.sections import PARAMETERS
from roswire.parameter_tree import Tree, holds_others, standing_at
from roswire.xmlrpc import Value

_CATEGORIES = {
    "registerPublisher": Category.PUBLISH,
    "unregisterPublisher": Category.PUBLISH,
    "registerSubscriber": Category.SUBSCRIBE,
    "unregisterSubscriber": Category.SUBSCRIBE,
    "requestTopic": Category.SUBSCRIBE,
    "registerService": Category.OFFER,
    "unregisterService": Category.OFFER,
    "lookupService": Category.CALL,
}
_TOUCHES = {
    "getParam": Category.READ,
    "hasParam": Category.READ,
    "subscribeParam": Category.READ,
    "unsubscribeParam": Category.READ,
    "setParam": Category.WRITE,
    "deleteParam": Category.WRITE,
}
COMMAND_FOR = {Category.CALL: "lookupService", Category.READ: "getParam", Category.WRITE: "setParam"}
"""The command with which a node calls a service, reads and writes a parameter."""

_NODE_CATEGORIES = frozenset({Category.PUBLISH, Category.SUBSCRIBE, Category.OFFER})
_NODE_COMMANDS = frozenset({"subscribeParam", "unsubscribeParam"})
_TELLS_NOTHING = frozenset({"unsubscribeParam"})


class Right(NamedTuple):
    """One question to the policy.

    `namespace`: the parameter is known to hold others; `alone`: it is asked without what is below it.
    """

    request: Request
    namespace: bool = False
    alone: bool = False

    def __str__(self) -> str:
        """`write /arm/**` for a namespace (`read /**` for all), `write /arm` for what is asked alone, `node /it`."""
        name = self.request.resource
        return f"{self.request.category} {name.rstrip('/') + '/**' if self.namespace else name}"


def category_of(call: str) -> Category:
    """What kind of thing a call is decided and recorded as."""
    return _CATEGORIES.get(call, Category.COMMAND)


def touch_of(call: str) -> Category | None:
    """How a call touches a parameter, if it is about one."""
    return _TOUCHES.get(call)


def request_of(call: str, host: Address, caller_id: str, resource: str) -> Request:
    """What a call about this topic or service is decided and recorded as: if it is about neither, as a command."""
    category = category_of(call)
    return Request(host, caller_id, category, call if category is Category.COMMAND else resource)


def rights_of_call(
    request: Request, call: str, key: str | None = None, *, value: Value = None, tree: Tree | None = None
) -> list[Right]:
    """Everything that this call needs, while `tree` are the parameters.

    `request` is what it is decided as; `key` and `value` are a parameter's.
    """
    if key is None or call not in _TOUCHES:
        return rights_of(request)
    there, in_the_way = standing_at(tree or {}, key)
    told = holds_others(there) and call not in _TELLS_NOTHING
    touched = [Right(_of(request, _TOUCHES[call], key), namespace=told or holds_others(value))]
    if value is not None and in_the_way is not None:
        touched.append(Right(_of(request, _TOUCHES[call], in_the_way), alone=True))
    return rights_of(request, touched)


def rights_to_keep(request: Request, call: str, resource: str, *, namespace: bool) -> list[Right]:
    """Everything that keeping what this call gave needs; `namespace`: a parameter that holds others."""
    touch = _TOUCHES.get(call)
    return rights_of(request, [] if touch is None else [Right(_of(request, touch, resource), namespace)])


def rights_of(request: Request, touched: Iterable[Right] = ()) -> list[Right]:
    """Everything that a deed needs, with what it touches."""
    rights = [Right(request)]
    if (command := COMMAND_FOR.get(request.category)) is not None:
        rights.append(Right(_of(request, Category.COMMAND, command)))
    rights += touched
    if needs_node(request):
        rights.append(Right(_of(request, Category.NODE, request.caller_id)))
    return rights


def right_to_read(request: Request, value: Value) -> Right:
    """The right to be told that a parameter has this value."""
    return Right(request, namespace=holds_others(value))


def right_to_find(request: Request) -> Right:
    """The right to be told that a parameter of this name is there, and nothing of what is below it."""
    return Right(request, alone=True)


def needs_node(request: Request) -> bool:
    """Whether the deed makes a node part of the graph, so that `[Nodes]` decides as well."""
    if request.category is Category.COMMAND:
        return request.resource in _NODE_COMMANDS
    return request.category in _NODE_CATEGORIES


def decide(policy: Policy, rights: Iterable[Right]) -> Decision:
    """All must be granted: the first that is not, or that only audit-only mode lets pass, is the answer."""
    first, *others = rights
    verdict = decide_right(policy, first)
    for right in others:
        if not verdict.allowed:
            break
        category = right.request.category
        if category in PARAMETERS and not policy.has_section(category):
            continue  # a section that is not there leaves parameters free
        decision = decide_right(policy, right)
        if not decision.allowed or (decision.would_deny and not verdict.would_deny):
            verdict = replace(decision, needs=str(right))
    return verdict


def decide_right(policy: Policy, right: Right) -> Decision:
    """The answer to one question."""
    if right.request.category in PARAMETERS and not right.alone:
        return policy.decide_parameter(right.request, namespace=right.namespace)
    return policy.decide(right.request)


def _of(request: Request, category: Category, resource: str) -> Request:
    return Request(request.host, request.caller_id, category, resource)
