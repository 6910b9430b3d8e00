"""Carry out the calls that register and unregister topics, services, and subscriptions to parameters.

A registration is on disk before its node gets the answer. A ROS 1 node never registers twice, and control and the ROS
master may die at the same time.
"""

from dataclasses import dataclass

from appliance.master.caller import Answer, ApiUri, Caller
from appliance.master.calls.call import Attempt
from appliance.master.calls.gate import CallGate
from appliance.master.calls.parameter_rights import ParameterRights
from appliance.master.endpoints.proxy_endpoints import ProxyEndpoints
from appliance.master.endpoints.relay_control import RelayControl
from appliance.master.graph.graph import RosGraph
from appliance.master.graph.mediation import Mediation
from appliance.master.graph.registry import Durable, Incarnation, Kind, Registry
from appliance.master.graph.revocation import CALLS
from appliance.master.reconcile.arrivals import Arrivals, EvictionGuard
from appliance.master.reconcile.enactor import Enactor
from appliance.master.reconcile.entries import NO_SERVICE, stand_in
from appliance.master.rosmaster import RosMaster


@dataclass(frozen=True, slots=True)
class RegistrationCalls:
    """Forward registering calls to the ROS master with the node's inner URI. Accepted calls change the graph."""

    rosmaster: RosMaster
    registry: Registry
    graph: RosGraph
    enactor: Enactor
    faces: ProxyEndpoints
    arrivals: Arrivals
    relay: RelayControl
    mediation: Mediation
    gate: CallGate
    rights: ParameterRights

    async def register_publisher(
        self, caller: Caller, topic: str, topic_type: str, caller_api: ApiUri
    ) -> Answer:
        """`registerPublisher(caller_id, topic, topic_type, caller_api)` → the subscribers' (outer) URIs."""
        with await self._registering(caller, caller_api) as node:
            inner = self.faces.inner_uri(node)
            answer = await self.rosmaster.call(
                "registerPublisher", caller.caller_id, topic, topic_type, inner
            )
            if answer[0] == 1:
                self.enactor.carry_out(self.graph.registered(node, Kind.PUBLICATION, topic, topic_type))
                hidden = self.mediation.hides_publishers(topic)
                answer[2] = list(self.registry.uris_for(node, Kind.SUBSCRIPTION, topic, hidden=hidden))
            return answer

    async def register_subscriber(
        self, caller: Caller, topic: str, topic_type: str, caller_api: ApiUri
    ) -> Answer:
        """`registerSubscriber(caller_id, topic, topic_type, caller_api)` → the publishers' (outer) URIs."""
        with await self._registering(caller, caller_api) as node:
            inner = self.faces.inner_uri(node)
            answer = await self.rosmaster.call(
                "registerSubscriber", caller.caller_id, topic, topic_type, inner
            )
            if answer[0] == 1:
                self.enactor.carry_out(self.graph.registered(node, Kind.SUBSCRIPTION, topic, topic_type))
                answer[2] = list(self.graph.list_for(node, topic))
            return answer

    async def register_service(
        self, caller: Caller, service: str, service_api: ApiUri, caller_api: ApiUri
    ) -> Answer:
        """`registerService(caller_id, service, service_api, caller_api)`."""
        with await self._registering(caller, caller_api) as node:
            inner = self.faces.inner_uri(node)
            answer = await self.rosmaster.call(
                "registerService", caller.caller_id, service, stand_in(node), inner
            )
            if answer[0] == 1:
                self.enactor.carry_out(
                    self.graph.registered(node, Kind.SERVICE, service, str(service_api.uri.port))
                )
            return answer

    async def subscribe_param(self, caller: Caller, caller_api: ApiUri, key: str) -> Answer:
        """`subscribeParam(caller_id, caller_api, key)`."""
        with await self._registering(caller, caller_api) as node:
            told = (caller.caller_id, self.faces.inner_uri(node), key)
            answer = await self.rosmaster.call("subscribeParam", *told)
            hidden = self.rights.hidden(caller, "subscribeParam", key, answer)
            if hidden is not None:
                await self.rosmaster.call("unsubscribeParam", *told)
                return [0, hidden, 0]
            if answer[0] == 1:
                self.enactor.carry_out(self.graph.registered(node, Kind.PARAMETER, key, ""))
            return answer

    async def unregister_publisher(self, caller: Caller, topic: str, caller_api: ApiUri) -> Answer:
        """`unregisterPublisher(caller_id, topic, caller_api)`."""
        return await self._unregister(caller, Kind.PUBLICATION, topic, caller_api)

    async def unregister_subscriber(self, caller: Caller, topic: str, caller_api: ApiUri) -> Answer:
        """`unregisterSubscriber(caller_id, topic, caller_api)`."""
        return await self._unregister(caller, Kind.SUBSCRIPTION, topic, caller_api)

    async def unregister_service(self, caller: Caller, service: str, service_api: ApiUri) -> Answer:
        """`unregisterService(caller_id, service, service_api)`: the caller's node is found by what it offers."""
        port = service_api.uri.port
        provider = next(
            (
                holder
                for holder in self.registry.registered(Kind.SERVICE, service)
                if holder.name == caller.caller_id
                # The URI has the node's own port, or the port that lookupService returned (`rosnode cleanup`).
                and (
                    holder.registrations[Kind.SERVICE, service].detail == str(port)
                    or self.relay.port(holder, Kind.SERVICE, service) == port
                )
            ),
            None,
        )
        uri = stand_in(provider) if provider is not None else NO_SERVICE
        answer = await self.rosmaster.call("unregisterService", caller.caller_id, service, uri)
        _speak_as_asked(answer, uri, service_api)
        if answer[0] == 1 and provider is not None:
            self.enactor.carry_out(self.graph.unregistered(provider, Kind.SERVICE, service))
        return answer

    async def unsubscribe_param(self, caller: Caller, caller_api: ApiUri, key: str) -> Answer:
        """`unsubscribeParam(caller_id, caller_api, key)`."""
        node = self.arrivals.known(caller, caller_api)
        inner = self.faces.inner_uri(node) if node is not None else self.faces.unassigned_uri()
        answer = await self.rosmaster.call("unsubscribeParam", caller.caller_id, inner, key)
        if answer[0] == 1 and node is not None:
            self.enactor.carry_out(self.graph.unregistered(node, Kind.PARAMETER, key))
        return answer

    async def _unregister(self, caller: Caller, kind: Kind, topic: str, caller_api: ApiUri) -> Answer:
        node = self.arrivals.known(caller, caller_api) or self._by_lookup_uri(caller, caller_api)
        inner = self.faces.inner_uri(node) if node is not None else self.faces.unassigned_uri()
        answer = await self.rosmaster.call(CALLS[kind][1], caller.caller_id, topic, inner)
        _speak_as_asked(answer, inner, caller_api)
        if answer[0] == 1 and node is not None:
            self.enactor.carry_out(self.graph.unregistered(node, kind, topic))
        return answer

    def _by_lookup_uri(self, caller: Caller, api: ApiUri) -> Incarnation | None:
        """Return the node whose lookupNode URI is in the call, as `rosnode cleanup` on the node's host sends it."""
        holder = self.registry.holder(caller.caller_id)
        meant = holder is not None and (holder.host, holder.outer_port) == (caller.peer.host, api.uri.port)
        return holder if meant else None

    async def _registering(self, caller: Caller, api: ApiUri) -> EvictionGuard:
        """Return a guard that prevents the eviction of the registering incarnation.

        If the host is at its limit, a new incarnation replaces an unused or lost incarnation of the host.
        """
        evicted = self.gate.to_make_room(caller, api)
        if evicted is not None:
            self.enactor.carry_out(self.graph.forgotten(evicted))
        return EvictionGuard(await self.arrivals.incarnation_for(caller, api))


def given_up(registry: Registry, denied: Attempt) -> list[Durable]:
    """Forget a withdrawn registration that its node unregisters, although this call is denied."""
    kind, caller = denied.call.kind, denied.caller
    asked = next(argument for argument in denied.arguments if isinstance(argument, ApiUri))
    kept: list[Durable] = []
    for incarnation in registry.all():
        shelved = None if kind is None else incarnation.shelf.get((kind, denied.resource))
        if shelved is None or (incarnation.name, incarnation.host) != (caller.caller_id, caller.peer.host):
            continue
        by_port = shelved.kind is Kind.SERVICE and shelved.detail == str(asked.uri.port)
        if by_port or incarnation.api_text == asked.text:
            kept += registry.unshelve(incarnation, shelved.kind, shelved.resource)
    return kept


def _speak_as_asked(answer: Answer, told: str, asked: ApiUri) -> None:
    """Replace the inner URI in the ROS master's text by the caller's URI."""
    answer[1] = str(answer[1]).replace(told, asked.text)
