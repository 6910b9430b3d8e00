"""Check the parameters in answers and updates. They may contain more than the decision on the call covered."""

from collections.abc import Callable
from dataclasses import dataclass

from appliance.base import clock
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
    """Checks parameters by the policy in force, and records denials."""

    policy: Callable[[], Policy]
    trail: AuditTrail

    def hidden(self, caller: Caller, call: str, key: str, answer: Answer) -> str | None:
        """Return a denial text if the caller may not read the answer's value.

        The decision on the call used an earlier state of the parameters.
        """
        if answer[0] != 1 or not isinstance(answer[2], dict) or caller.own:
            return None
        decision = self._to_read(caller.peer.host, caller.caller_id, key, answer[2])
        return None if decision.allowed else self.recorded(caller, call, key, decision)

    def may_read_value(self, incarnation: Incarnation, key: str, value: Value) -> bool:
        """Return whether a subscriber may read a new value (an empty namespace if it was deleted); record a denial."""
        if incarnation.own:
            return True
        decision = self._to_read(incarnation.host, incarnation.name, key, value)
        if not decision.allowed:
            peer = Peer(incarnation.host, str(incarnation.host), incarnation.told)
            self.recorded(Caller(peer, incarnation.name, clock.now_ns()), "paramUpdate", key, decision)
        return decision.allowed

    def to_find(self, caller: Caller, key: str) -> Decision:
        request = Request(caller.peer.host, caller.caller_id, Category.READ, key)
        return decide_right(self.policy(), right_to_find(request))

    def recorded(self, caller: Caller, call: str, key: str, decision: Decision) -> str:
        record = self.trail.decided(caller.asker, call, Category.READ.value, key, decision)
        return denial_text(decision, record, self.policy().tell)

    def _to_read(self, host: Address, caller_id: str, key: str, value: Value) -> Decision:
        request = Request(host, caller_id, Category.READ, key)
        return decide_right(self.policy(), right_to_read(request, value))
