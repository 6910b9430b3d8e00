"""Find the live rights of hosts, such as publications, that a policy would end, for a reload and a dry run."""

import ipaddress
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

from appliance.policy.commands import CALLS
from appliance.policy.model import Address, Decision, Request
from appliance.policy.policy import Policy
from appliance.policy.rights import Right, decide, request_of, rights_to_keep
from roswire.parameter_tree import Tree, holds_others, standing_at


class LiveRight(NamedTuple):
    """A right that `call` gave for `resource`; `namespace`: a parameter that now contains other parameters."""

    host: Address
    caller_id: str
    call: str
    resource: str
    namespace: bool = False

    @classmethod
    def of(cls, fields: Mapping[str, Any]) -> Self:
        return cls(**{**fields, "host": ipaddress.ip_address(fields["host"])})

    def fields(self) -> dict[str, Any]:
        return {**self._asdict(), "host": str(self.host)}

    def requests(self) -> list[Request | Right]:
        asked: list[Request | Right] = [request_of(self.call, self.host, self.caller_id, self.resource)]
        if (touch := CALLS[self.call].touches) is not None:
            asked.insert(0, Right(Request(self.host, self.caller_id, touch, self.resource)))
        return asked


@dataclass(frozen=True, slots=True)
class Ending:
    """A live right that a policy would end; `what` is a word such as "publication"."""

    host: str
    caller_id: str
    what: str
    resource: str
    reason: str


def live_by(call: str, host: Address, caller_id: str, resource: str, tree: Tree) -> LiveRight:
    namespace = CALLS[call].touches is not None and holds_others(standing_at(tree, resource)[0])
    return LiveRight(host, caller_id, call, resource, namespace)


def may_keep(policy: Policy, live: LiveRight) -> Decision:
    request = request_of(live.call, live.host, live.caller_id, live.resource)
    return decide(policy, rights_to_keep(request, live.call, live.resource, namespace=live.namespace))


def lost_rights(policy: Policy, things: Iterable[LiveRight]) -> dict[Address, set[str]]:
    lost: dict[Address, set[str]] = {}
    kept: set[Address] = set()
    for live in things:
        if live.host in kept:
            continue
        if may_keep(policy, live).allowed:
            kept.add(live.host)
            lost.pop(live.host, None)
        else:
            lost.setdefault(live.host, set()).add(live.caller_id)
    return lost


def endings(policy: Policy, things: Iterable[LiveRight]) -> list[Ending]:
    decided = ((live, may_keep(policy, live)) for live in things)
    found = (
        Ending(str(live.host), live.caller_id, CALLS[live.call].gives, live.resource, decision.reason)
        for live, decision in decided
        if not decision.allowed
    )
    return list(dict.fromkeys(found))
