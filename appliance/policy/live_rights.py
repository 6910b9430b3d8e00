"""What hosts have because a call gave it to them, and what of it a policy would end.

A reload (`master/graph/revocation`) and a dry run ask the same question about the same things: may the host make the
call that gave it, now and under this policy? What that needs, `policy/rights` knows.
"""

import ipaddress
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

from appliance.policy.model import Address, Decision, Request
from appliance.policy.policy import Policy
from appliance.policy.rights import decide, request_of, rights_to_keep, touch_of
from roswire.parameter_tree import Tree, holds_others, standing_at

# What each call gives, in the words of a dry run. A node that asks for a topic has subscribed to it.
_GIVEN = {
    "registerPublisher": "publication",
    "registerSubscriber": "subscription",
    "requestTopic": "subscription",
    "registerService": "service",
    "lookupService": "call",
    "subscribeParam": "parameter",
}


class Live(NamedTuple):
    """Something that a host has: `call` gave it, about `resource`.

    `namespace`: it is a parameter that holds others now.
    """

    host: Address
    caller_id: str
    call: str
    resource: str
    namespace: bool = False

    @classmethod
    def of(cls, fields: Mapping[str, Any]) -> Self:
        """From `fields`."""
        return cls(**{**fields, "host": ipaddress.ip_address(fields["host"])})

    def fields(self) -> dict[str, Any]:
        """For another process."""
        return {**self._asdict(), "host": str(self.host)}

    def requests(self) -> list[Request]:
        """What a person would ask about it: the deed, and the parameter that it is about."""
        asked = [request_of(self.call, self.host, self.caller_id, self.resource)]
        touch = touch_of(self.call)
        return asked if touch is None else [Request(self.host, self.caller_id, touch, self.resource), *asked]


@dataclass(frozen=True, slots=True)
class Ending:
    """Something live that a policy would end: `what` of the caller, about `resource`."""

    host: str
    caller_id: str
    what: str
    resource: str
    reason: str


def live_by(call: str, host: Address, caller_id: str, resource: str, tree: Tree) -> Live:
    """What this call gave, while `tree` are the parameters."""
    namespace = touch_of(call) is not None and holds_others(standing_at(tree, resource)[0])
    return Live(host, caller_id, call, resource, namespace)


def may_keep(policy: Policy, live: Live) -> Decision:
    """Whether a policy leaves it to the host."""
    request = request_of(live.call, live.host, live.caller_id, live.resource)
    return decide(policy, rights_to_keep(request, live.call, live.resource, namespace=live.namespace))


def endings(policy: Policy, things: Iterable[Live]) -> list[Ending]:
    """What of it the policy would end, each thing once."""
    decided = ((live, may_keep(policy, live)) for live in things)
    found = (
        Ending(str(live.host), live.caller_id, _GIVEN[live.call], live.resource, decision.reason)
        for live, decision in decided
        if not decision.allowed
    )
    return list(dict.fromkeys(found))
