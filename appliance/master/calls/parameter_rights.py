"""Who may be told which parameters, asked again where an answer or an update brings more than a decision looked at."""

import time
from collections.abc import Callable
from dataclasses import dataclass

from appliance.master.caller import Answer, Caller
from appliance.master.calls.call import denial_text
from appliance.master.graph.registry import Incarnation
from appliance.policy.model import Address, Category, Decision, Request
from appliance.policy.policy import Policy
from appliance.policy.rights import decide_right, right_to_find, right_to_read
from appliance.rpc.server import Peer
from appliance.telemetry.audit_trail import AuditTrail
from roswire.xmlrpc import Value


@dataclass(frozen=True, slots=True)
class ParameterRights:
    """Asks the policy that `policy()` returns at that moment, and records what it denies."""

    policy: Callable[[], Policy]
    trail: AuditTrail

    def hidden(self, caller: Caller, call: str, key: str, answer: Answer) -> str | None:
        """What a caller is told in the place of a namespace that he may not read; None when there is nothing to hide.

        It was decided before, by what was there then; the answer has what is there now.
        """
        if answer[0] != 1 or not isinstance(answer[2], dict) or caller.own:
            return None
        decision = self._to_read(caller.peer.host, caller.caller_id, key, answer[2])
        return None if decision.allowed else self.recorded(caller, call, key, decision)

    def may_be_told(self, incarnation: Incarnation, key: str, value: Value) -> bool:
        """Whether a node that subscribed to `key`, or to something above it, may read its new value.

        The value of a parameter that was deleted is an empty namespace.
        """
        if incarnation.own:
            return True
        decision = self._to_read(incarnation.host, incarnation.name, key, value)
        if not decision.allowed:
            peer = Peer(incarnation.host, str(incarnation.host), incarnation.told)
            self.recorded(Caller(peer, incarnation.name, time.monotonic_ns()), "paramUpdate", key, decision)
        return decision.allowed

    def to_find(self, caller: Caller, key: str) -> Decision:
        """Whether a caller may learn that there is a parameter of this name."""
        request = Request(caller.peer.host, caller.caller_id, Category.READ, key)
        return decide_right(self.policy(), right_to_find(request))

    def recorded(self, caller: Caller, call: str, key: str, decision: Decision) -> str:
        """Record a decision on a parameter; what is told of it."""
        record = self.trail.decided(caller.asker, call, Category.READ.value, key, decision)
        return denial_text(decision, record, self.policy().tell)

    def _to_read(self, host: Address, caller_id: str, key: str, value: Value) -> Decision:
        request = Request(host, caller_id, Category.READ, key)
        return decide_right(self.policy(), right_to_read(request, value))
