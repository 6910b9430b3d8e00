"""The rights that a call needs; only this module knows which rules must grant it.

RVMaster's gate, the revocation of live rights, `explain`, the cases beside a policy, `diff` and `learn` all use it, so
that none of them can allow what another denies. `rights_of_call` returns the rights of a whole call, `rights_of` those
of a deed that a person names (`publish /cmd_vel`), `decide` makes one decision of them.

A right is a question to one section. A call needs all of these:

1. the deed itself: a topic, a service, or the call as a command;
2. the command that carries it out, if commands for such deeds have rules (`COMMAND_FOR`);
3. for a call about a parameter: reading or writing it, what is below it, and what it replaces;
4. for a call that makes a node part of the graph: the node's name.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

from appliance.policy.commands import CALLS, policy_call
from appliance.policy.model import Address, Category, Decision, Request
from appliance.policy.policy import Policy
from appliance.policy.sections import PARAMETERS
from roswire.parameter_tree import Tree, holds_others, standing_at
from roswire.xmlrpc import Value

_NODE_CATEGORIES = {call.category for call in CALLS.values() if call.node} - {Category.COMMAND}
COMMAND_FOR = {Category.CALL: "lookupService", Category.READ: "getParam", Category.WRITE: "setParam"}
"""The command with which a node calls a service, reads and writes a parameter."""


class Right(NamedTuple):
    """One question to the policy.

    `namespace`: the parameter is known to hold others; `alone`: the question leaves out what is below it.
    """

    request: Request
    namespace: bool = False
    alone: bool = False

    def __str__(self) -> str:
        """`write /arm/**` for a namespace (`read /**` for all), `write /arm` for one parameter, `node /it`."""
        name = self.request.resource
        return f"{self.request.category} {name.rstrip('/') + '/**' if self.namespace else name}"


def request_of(call: str, host: Address, caller_id: str, resource: str) -> Request:
    """Return the request as which a call is decided: about this topic or service, or else a command."""
    category = policy_call(call).category
    return Request(host, caller_id, category, call if category is Category.COMMAND else resource)


def rights_of_call(
    request: Request, call: str, key: str | None = None, *, value: Value = None, tree: Tree | None = None
) -> list[Right]:
    """Return all rights that this call needs; `tree` has the present parameters.

    The call is decided as `request`; `key` and `value` are a parameter's.
    """
    row = policy_call(call)
    if key is None or row.touches is None:
        return rights_of(request)
    there, in_the_way = standing_at(tree or {}, key)
    told = holds_others(there) and not row.silent
    touched = [Right(_of(request, row.touches, key), namespace=told or holds_others(value))]
    if value is not None and in_the_way is not None:
        touched.append(Right(_of(request, row.touches, in_the_way), alone=True))
    return rights_of(request, touched)


def rights_to_keep(request: Request, call: str, resource: str, *, namespace: bool) -> list[Right]:
    """Return all rights needed to keep what this call gave; `namespace`: a parameter that holds others."""
    touch = policy_call(call).touches
    return rights_of(request, [] if touch is None else [Right(_of(request, touch, resource), namespace)])


def rights_of(request: Request, touched: Iterable[Right] = ()) -> list[Right]:
    """Return all rights that a deed needs, with those on what it touches."""
    rights = [Right(request)]
    if (command := COMMAND_FOR.get(request.category)) is not None:
        rights.append(Right(_of(request, Category.COMMAND, command)))
    rights += touched
    if needs_node(request):
        rights.append(Right(_of(request, Category.NODE, request.caller_id)))
    return rights


def right_to_read(request: Request, value: Value) -> Right:
    """Return the right to learn that a parameter has this value."""
    return Right(request, namespace=holds_others(value))


def right_to_find(request: Request) -> Right:
    """Return the right to learn that a parameter of this name exists, and nothing of those below it."""
    return Right(request, alone=True)


def needs_node(request: Request) -> bool:
    """Whether the deed makes a node part of the graph, so that `[Nodes]` decides as well."""
    if request.category is Category.COMMAND:
        return policy_call(request.resource).node
    return request.category in _NODE_CATEGORIES


def decide(policy: Policy, rights: Iterable[Right]) -> Decision:
    """Return one decision on all rights: the first denial, else the first audit-only pass, else that of the deed."""
    first, *others = rights
    verdict = decide_right(policy, first)
    for right in others:
        if not verdict.allowed:
            break
        category = right.request.category
        if category in PARAMETERS and not policy.has_section(category):
            continue  # without the section, parameters are free
        decision = decide_right(policy, right)
        if not decision.allowed or (decision.would_deny and not verdict.would_deny):
            verdict = replace(decision, needs=str(right))
    return verdict


def decide_right(policy: Policy, right: Right) -> Decision:
    """Return the answer to one question."""
    if right.request.category in PARAMETERS and not right.alone:
        return policy.decide_parameter(right.request, namespace=right.namespace)
    return policy.decide(right.request)


def _of(request: Request, category: Category, resource: str) -> Request:
    return Request(request.host, request.caller_id, category, resource)
