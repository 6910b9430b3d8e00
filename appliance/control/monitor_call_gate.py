"""Decide the service calls of monitors by the policy, as those of a client at the appliance's own address.

Relays connect to themselves, so this is the address that they listen on, which the serving relay sees.
"""

import ipaddress
from collections.abc import Callable
from dataclasses import dataclass

from appliance.base import clock
from appliance.channel.messages import MonitorCallAnswered, MonitorCallWanted
from appliance.master.endpoints.relay_control import RelayControl
from appliance.master.graph.graph import RosGraph
from appliance.master.graph.registry import Kind, Registry
from appliance.policy.model import plain_address
from appliance.policy.policy import Policy
from appliance.policy.rights import decide, request_of, rights_of_call
from appliance.telemetry.audit_trail import NOT_RECORDED, Asker, AuditTrail

_CALL = "lookupService"


def own_host(listen: str) -> str:
    address = plain_address(listen)
    return "127.0.0.1" if address.is_unspecified else str(address)


@dataclass(frozen=True, slots=True)
class MonitorCallGate:
    """Decides for the node `name` at `host`, which makes the calls."""

    registry: Registry
    graph: RosGraph
    flush: Callable[[], None]
    policy: Callable[[], Policy]
    trail: AuditTrail
    relay: RelayControl
    name: str
    host: str

    async def answer(self, wanted: MonitorCallWanted) -> MonitorCallAnswered:
        refused = await self._refused(wanted.service)
        provider = next(iter(self.registry.registrants(Kind.SERVICE, wanted.service)), None)
        if not refused and provider is None:
            refused = "no node offers the service"
        if refused or provider is None:
            return MonitorCallAnswered(wanted.number, "", 0, "", refused)
        host = ipaddress.ip_address(self.host)
        self.graph.service_granted(provider, wanted.service, host, self.name)
        self.flush()  # the relay has the grant before this answer
        port = self.relay.port(provider, Kind.SERVICE, wanted.service)
        return MonitorCallAnswered(wanted.number, self.host, port, self.name, "")

    async def _refused(self, service: str) -> str:
        request = request_of(_CALL, ipaddress.ip_address(self.host), self.name, service)
        decision = decide(self.policy().without_groups(), rights_of_call(request, _CALL))
        asker = Asker(self.host, self.name, clock.now_ns(), None)
        record = self.trail.decided(asker, _CALL, request.category.value, service, decision)
        if not decision.allowed:
            return f"denied: {decision.reason} [{record}]"
        if decision.asks is not None:
            return f"denied: {decision.reason}, for which a monitor cannot wait [{record}]"
        if self.trail.strict and await self.trail.durable() is not None:
            return f"denied: {NOT_RECORDED}"
        if not self.relay.carries_service(service):
            return "the relay does not carry the service"
        return ""
