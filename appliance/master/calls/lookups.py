"""The calls that ask about the graph, and RVMaster's own."""

import asyncio
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

from appliance.master.caller import Answer, Caller
from appliance.master.graph.enactor import Enactor
from appliance.master.graph.entries import key_of_stand_in
from appliance.master.graph.graph import Graph
from appliance.master.graph.registry import Incarnation, Kind, Registry
from appliance.master.reach.addresses import Addresses
from appliance.master.reach.faces import Faces
from appliance.master.reach.mediation import Mediation
from appliance.master.reach.relays import RelayControl
from appliance.master.rosmaster import RosMaster
from appliance.ros.uris import node_uri, service_uri
from appliance.ros.xmlrpc import Value

_ASK_AGAIN = (0.0, 0.01, 0.05, 0.2, 0.5, 0.0)  # seconds until ROSMaster is asked for a provider again


@dataclass(frozen=True, slots=True)
class LookupCalls:
    """Asks ROSMaster and answers with what stands for nodes and services.

    `port` is RVMaster's, `stop(reason)` ends the appliance. `unseen` is a publisher that `getSystemState` leaves out.
    """

    rosmaster: RosMaster
    registry: Registry
    graph: Graph
    enactor: Enactor
    faces: Faces
    relay: RelayControl
    mediation: Mediation
    addresses: Addresses
    port: int
    stop: Callable[[str], None]
    unseen: str | None = None

    async def lookup_node(self, caller: Caller, node: str) -> Answer:
        """`lookupNode(caller_id, node_name)` → the node's outer URI."""
        answer = await self.rosmaster.call("lookupNode", caller.caller_id, node)
        if answer[0] == 1:
            incarnation = self.faces.by_inner_uri(str(answer[2]))
            if incarnation is None or incarnation.name != node:
                return [-1, f"unknown node [{node}]", ""]
            told = self.addresses.told_to(caller.peer)
            answer[2] = incarnation.uri_for(told, hidden=self.mediation.stand_ins)
        return answer

    async def lookup_service(self, caller: Caller, service: str) -> Answer:
        """`lookupService(caller_id, service)` → the relay's port for it; the caller may then call it."""
        answer, incarnation = await self._provider(caller, service)
        if incarnation is not None:
            if self.mediation.carries_service(service):
                granted = self.graph.service_granted(incarnation, service, caller.peer.host, caller.caller_id)
                self.enactor.carry_out(granted)
                port = self.relay.port(incarnation, Kind.SERVICE, service)
                uri = service_uri(self.addresses.told_to(caller.peer), port)
            else:
                port = int(incarnation.registrations[Kind.SERVICE, service].detail)
                uri = service_uri(str(incarnation.host), port)
            answer[1], answer[2] = f"rosrpc URI: [{uri}]", uri
        return answer

    async def _provider(self, caller: Caller, service: str) -> tuple[Answer, Incarnation | None]:
        """ROSMaster's answer, and the provider that it names and the registry has.

        While a service gets another provider the two do not agree for a moment: ROSMaster's answer may be older than
        the registry, or newer, for answers overtake each other. A node asks once, so ROSMaster is asked until they do.
        """
        for pause in _ASK_AGAIN:
            answer = await self.rosmaster.call("lookupService", caller.caller_id, service)
            if answer[0] != 1:
                return answer, None
            incarnation = self.registry.by_key(key_of_stand_in(str(answer[2])))
            if incarnation is not None and (Kind.SERVICE, service) in incarnation.registrations:
                return answer, incarnation
            await asyncio.sleep(pause)
        return [-1, "no provider", ""], None

    async def get_system_state(self, caller: Caller) -> Answer:
        """`getSystemState(caller_id)` → `[publishers, subscribers, services]`."""
        answer = await self.rosmaster.call("getSystemState", caller.caller_id)
        if self.unseen is not None and answer[0] == 1:
            publishers, subscribers, services = cast(list[list[list[Value]]], answer[2])
            shown = [
                [topic, [name for name in cast(list[Value], names) if name != self.unseen]]
                for topic, names in publishers
            ]
            answer[2] = cast(Value, [[one for one in shown if one[1]], subscribers, services])
        return answer

    async def get_published_topics(self, caller: Caller, subgraph: str) -> Answer:
        """`getPublishedTopics(caller_id, subgraph)`."""
        return await self.rosmaster.call("getPublishedTopics", caller.caller_id, subgraph)

    async def get_topic_types(self, caller: Caller) -> Answer:
        """`getTopicTypes(caller_id)`."""
        return await self.rosmaster.call("getTopicTypes", caller.caller_id)

    async def get_uri(self, caller: Caller) -> Answer:
        """`getUri(caller_id)` → RVMaster's own, at the address the caller knows it by."""
        return [1, "", node_uri(self.addresses.told_to(caller.peer), self.port)]

    async def get_pid(self, _caller: Caller) -> Answer:
        """`getPid(caller_id)` → RVMaster's own."""
        return [1, "", os.getpid()]

    async def shutdown_master(self, caller: Caller, message: str) -> Answer:
        """`shutdown(caller_id, msg)`: ends the appliance, as it would end `roscore`."""
        self.stop(f"{caller.caller_id} on {caller.peer.text} called shutdown: {message}")
        return [1, "shutdown", 0]
