"""List the rights that a call needs. Only this module knows which rules must grant a call:

1. the action itself: access to a topic or service, or the call as a command;
2. the command that carries out the action, if `COMMAND_FOR` lists one;
3. for a call about a parameter: read or write access to the parameter, to everything below it, and to the parameter
   that it replaces;
4. for a call that makes a node part of the graph: the node's name.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

from appliance.policy.commands import CALLS
from appliance.policy.model import Address, Category, Decision, Request
from appliance.policy.policy import Policy
from appliance.policy.sections import PARAMETERS
from roswire.parameter_tree import Tree, holds_others, standing_at
from roswire.xmlrpc import Value

_NODE_CATEGORIES = {call.category for call in CALLS.values() if call.node} - {Category.COMMAND}
COMMAND_FOR = {Category.CALL: "lookupService", Category.READ: "getParam", Category.WRITE: "setParam"}
"""The commands by which a node calls a service, or reads and writes a parameter."""


class Right(NamedTuple):
    """A question to the policy.

    `namespace`: the parameter contains other parameters. `alone`: the question excludes those.
    """

    request: Request
    namespace: bool = False
    alone: bool = False

    def __str__(self) -> str:
        """Return `write /arm/**` for a namespace (`read /**` for all), `write /arm` for one parameter, `node /it`."""
        name = self.request.resource
        return f"{self.request.category} {name.rstrip('/') + '/**' if self.namespace else name}"


def request_of(call: str, host: Address, caller_id: str, resource: str) -> Request:
    category = CALLS[call].category
    return Request(host, caller_id, category, call if category is Category.COMMAND else resource)


def rights_of_call(
    request: Request, call: str, key: str | None = None, *, value: Value = None, tree: Tree | None = None
) -> list[Right]:
    row = CALLS[call]
    if key is None or row.touches is None:
        return rights_of(request)
    there, in_the_way = standing_at(tree or {}, key)
    told = holds_others(there) and not row.silent
    touched = [Right(_of(request, row.touches, key), namespace=told or holds_others(value))]
    if value is not None and in_the_way is not None:
        touched.append(Right(_of(request, row.touches, in_the_way), alone=True))
    return rights_of(request, touched)


def rights_to_keep(request: Request, call: str, resource: str, *, namespace: bool) -> list[Right]:
    touch = CALLS[call].touches
    return rights_of(request, [] if touch is None else [Right(_of(request, touch, resource), namespace)])


def rights_of(request: Request, touched: Iterable[Right] = ()) -> list[Right]:
    """Return all rights that an action needs; `touched` are its rights to parameters."""
    rights = [Right(request)]
    if (command := COMMAND_FOR.get(request.category)) is not None:
        rights.append(Right(_of(request, Category.COMMAND, command)))
    rights += touched
    if needs_node(request):
        rights.append(Right(_of(request, Category.NODE, request.caller_id)))
    return rights


def right_to_read(request: Request, value: Value) -> Right:
    return Right(request, namespace=holds_others(value))


def right_to_find(request: Request) -> Right:
    """Return the right to learn that a parameter exists, without anything below it."""
    return Right(request, alone=True)


def needs_node(request: Request) -> bool:
    if request.category is Category.COMMAND:
        return CALLS[request.resource].node
    return request.category in _NODE_CATEGORIES


def decide(policy: Policy, rights: Iterable[Right]) -> Decision:
    """Return the first of the lowest-ranked decisions, so a denial before a missing approval.

    Each right that asks needs its own approval.
    """
    first, *others = rights
    verdict = decide_right(policy, first)
    for right in others:
        if verdict.rank == 0:
            break
        category = right.request.category
        if category in PARAMETERS and category not in policy.present:
            continue  # without the section, all access to parameters is allowed
        decision = decide_right(policy, right)
        if (decision.allowed, decision.rank) < (verdict.allowed, verdict.rank):
            verdict = replace(decision, needs=str(right))
    return verdict


def decide_right(policy: Policy, right: Right) -> Decision:
    if right.request.category in PARAMETERS and not right.alone:
        return policy.decide_parameter(right.request, namespace=right.namespace)
    return policy.decide(right.request)


def asks_to_call(policy: Policy, host: Address, service: str) -> bool:
    return policy.decide(Request(host, "", Category.CALL, service)).asks is not None


def _of(request: Request, category: Category, resource: str) -> Request:
    return Request(request.host, request.caller_id, category, resource)
