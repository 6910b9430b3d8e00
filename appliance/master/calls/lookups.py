"""Answer calls about the graph and about RVMaster."""

import os
from collections.abc import Callable
from dataclasses import dataclass

from appliance.master.calls.call import Caller
from appliance.master.endpoints.node_ports import AdvertisedAddresses
from appliance.master.endpoints.relay_control import RelayControl
from appliance.master.graph.graph import RosGraph
from appliance.master.graph.registry import Kind, Registry
from appliance.master.rosmaster import Answer
from roswire.uris import node_uri, service_uri
from roswire.xmlrpc import Value


@dataclass(frozen=True, slots=True)
class LookupCalls:
    """The lookup calls, answered from the registry even while the ROS master is away.

    `getSystemState` omits the publisher `unseen`.
    """

    registry: Registry
    graph: RosGraph
    relay: RelayControl
    addresses: AdvertisedAddresses
    port: int
    stop: Callable[[str], None]
    unseen: str | None = None

    async def lookup_node(self, caller: Caller, node: str) -> Answer:
        """`lookupNode(caller_id, node_name)` → the node's outer URI."""
        holder = self.registry.holder(node)
        if holder is None:
            return [-1, f"unknown node [{node}]", ""]
        told = self.addresses.address_for(caller.peer)
        return [1, "node api", holder.uri_for(told, hidden=self.relay.stand_ins)]

    async def lookup_service(self, caller: Caller, service: str) -> Answer:
        """`lookupService(caller_id, service)` → the relay's port for it; the caller may then call it."""
        provider = next(iter(self.registry.registrants(Kind.SERVICE, service)), None)
        if provider is None:
            return [-1, "no provider", ""]
        if provider.of_monitors or self.relay.carries_service(service):
            self.graph.service_granted(provider, service, caller.peer.host, caller.caller_id)
            port = self.relay.port(provider, Kind.SERVICE, service)
            uri = service_uri(self.addresses.address_for(caller.peer), port)
        else:
            port = int(provider.registrations[Kind.SERVICE, service].detail)
            uri = service_uri(str(provider.host), port)
        return [1, f"rosrpc URI: [{uri}]", uri]

    async def get_system_state(self, _caller: Caller) -> Answer:
        """`getSystemState(caller_id)` → `[publishers, subscribers, services]`."""
        shown: dict[Kind, list[Value]] = {Kind.PUBLICATION: [], Kind.SUBSCRIPTION: [], Kind.SERVICE: []}
        for kind, resource, holders in self.registry.resources():
            names: list[Value] = [
                pid.name for pid in holders if kind is not Kind.PUBLICATION or pid.name != self.unseen
            ]
            if kind in shown and names:
                shown[kind].append([resource, names])
        return [1, "current system state", list(shown.values())]

    async def get_published_topics(self, _caller: Caller, subgraph: str) -> Answer:
        """`getPublishedTopics(caller_id, subgraph)` → `[[topic, type], …]`: the published topics below it."""
        below = f"{subgraph.rstrip('/')}/" if subgraph else ""
        topics: list[Value] = [
            [topic, self.registry.type_of(topic)]
            for kind, topic, _holders in self.registry.resources()
            if kind is Kind.PUBLICATION and topic.startswith(below)
        ]
        return [1, "current topics", topics]

    async def get_topic_types(self, _caller: Caller) -> Answer:
        """`getTopicTypes(caller_id)`."""
        return [1, "current system state", [[topic, told] for topic, told in self.registry.types()]]

    async def get_uri(self, caller: Caller) -> Answer:
        """`getUri(caller_id)` → RVMaster's own URI, at the address by which the caller knows it."""
        return [1, "", node_uri(self.addresses.address_for(caller.peer), self.port)]

    async def get_pid(self, _caller: Caller) -> Answer:
        """`getPid(caller_id)` → RVMaster's own."""
        return [1, "", os.getpid()]

    async def shutdown_master(self, caller: Caller, message: str) -> Answer:
        """`shutdown(caller_id, msg)`: ends the appliance, as it would end `roscore`."""
        self.stop(f"{caller.caller_id} on {caller.peer.text} called shutdown: {message}")
        return [1, "shutdown", 0]
