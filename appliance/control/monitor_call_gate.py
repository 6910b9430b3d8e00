"""Decide the service calls of monitors by the policy, as those of the appliance's own node on the loopback."""

import ipaddress
from collections.abc import Callable
from dataclasses import dataclass

from appliance.base import clock
from appliance.channel.messages import MonitorCallAnswered, MonitorCallWanted
from appliance.master.graph.graph import RosGraph
from appliance.master.graph.mediation import Mediation
from appliance.master.graph.registry import Incarnation, Kind, Registry
from appliance.master.reconcile.enactor import Enactor
from appliance.policy.policy import Policy
from appliance.policy.rights import decide, request_of, rights_of_call
from appliance.telemetry.audit_trail import NOT_RECORDED, Asker, AuditTrail

LOOPBACK = "127.0.0.1"
_CALL = "lookupService"


@dataclass(frozen=True, slots=True)
class MonitorCallGate:
    """Decides for the node `name`, which makes the calls, and grants them like those of another client.

    `port(provider, kind, service)` returns the port of a service on its relay.
    """

    registry: Registry
    graph: RosGraph
    enactor: Enactor
    policy: Callable[[], Policy]
    trail: AuditTrail
    mediation: Mediation
    port: Callable[[Incarnation, Kind, str], int]
    name: str

    async def answer(self, wanted: MonitorCallWanted) -> MonitorCallAnswered:
        """Decide, record and grant a call."""
        refused = await self._refused(wanted.service)
        provider = next(iter(self.registry.registered(Kind.SERVICE, wanted.service)), None)
        if not refused and provider is None:
            refused = "no node offers the service"
        if refused or provider is None:
            return MonitorCallAnswered(wanted.number, "", 0, "", refused)
        host = ipaddress.ip_address(LOOPBACK)
        self.enactor.carry_out(self.graph.service_granted(provider, wanted.service, host, self.name))
        port = self.port(provider, Kind.SERVICE, wanted.service)
        return MonitorCallAnswered(wanted.number, LOOPBACK, port, self.name, "")

    async def _refused(self, service: str) -> str:
        """Return why the call is denied; empty if it is allowed."""
        request = request_of(_CALL, ipaddress.ip_address(LOOPBACK), self.name, service)
        decision = decide(self.policy(), rights_of_call(request, _CALL))
        asker = Asker(LOOPBACK, self.name, clock.now_ns(), None)
        record = self.trail.decided(asker, _CALL, request.category.value, service, decision)
        if not decision.allowed:
            return f"denied: {decision.reason} [{record}]"
        if self.trail.strict and await self.trail.durable() is not None:
            return f"denied: {NOT_RECORDED}"
        if not self.mediation.carries_service(service):
            return "the relay does not carry the service"
        return ""
