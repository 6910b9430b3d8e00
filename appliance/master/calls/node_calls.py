"""Answer the node API on a proxy endpoint. Other nodes and tools call the endpoint as if it were the node.

Only `getPid`, `shutdown`, and `requestTopic` for unrelayed topics are forwarded to the node. If the node does not
answer `getPid`, the connection is reset: `rosnode` skips such a node, but stops at an error.
"""

import os
from collections import defaultdict
from dataclasses import dataclass

from appliance.master.calls.call import (
    MESSAGE,
    PROTOCOLS,
    TOPIC,
    Caller,
    CallVerb,
    NotServedError,
    RosCall,
    method,
)
from appliance.master.calls.gate import CallGate
from appliance.master.endpoints.delivery import NodeApiClient
from appliance.master.endpoints.node_ports import AdvertisedAddresses
from appliance.master.endpoints.relay_control import RelayControl, tcpros_port
from appliance.master.endpoints.traffic import Traffic
from appliance.master.graph.graph import RosGraph
from appliance.master.graph.registry import Incarnation, Kind, Registry
from appliance.master.reconcile.liveness import Liveness
from appliance.master.rosmaster import Answer
from appliance.rpc.server import NoAnswerError
from appliance.rpc.xmlrpc_client import CallFailedError
from appliance.specifications.allocation import TOPIC as TOPIC_CONNECTION
from roswire.uris import node_uri
from roswire.xmlrpc import Value

_NOTHING = Traffic()


@dataclass(frozen=True, slots=True)
class NodeCalls:
    """The node API of `caller.target`. `port` is RVMaster's port."""

    registry: Registry
    graph: RosGraph
    relay: RelayControl
    addresses: AdvertisedAddresses
    nodes: NodeApiClient
    liveness: Liveness
    gate: CallGate
    port: int

    async def request_topic(self, caller: Caller, topic: str, protocols: list[list[Value]]) -> Answer:
        """`requestTopic(caller_id, topic, protocols)` → the relay's port; the grant is installed first."""
        target = _target(caller)
        if (Kind.PUBLICATION, topic) not in target.registrations:
            return [-1, f"Not a publisher of [{topic}]", []]
        names = [protocol[0] for protocol in protocols if protocol]
        if "TCPROS" not in names:
            offered = ", ".join(str(name)[:40] for name in names) or "nothing"
            raise NotServedError(f"the appliance relays only TCPROS; the subscriber offers {offered}")
        own = target.own or self.gate.is_own_subscriber(caller, topic)  # always connected through the relay
        if not own and not self.relay.carries_topic(topic):
            return await self._negotiate_directly(target, topic, caller)
        self.graph.topic_granted(target, topic, caller.peer.host, caller.caller_id)
        address = self.addresses.address_for(caller.peer)
        port = self.relay.port(target, Kind.PUBLICATION, topic)
        return [1, f"ready on {address}:{port}", ["TCPROS", address, port]]

    async def _negotiate_directly(self, target: Incarnation, topic: str, caller: Caller) -> Answer:
        """Return the node's own port, at its peer address; the host in the node's answer is ignored."""
        try:
            answer = await self.nodes.call(target, "requestTopic", caller.caller_id, topic, [["TCPROS"]])
            port = tcpros_port(answer)
        except CallFailedError:
            self.liveness.look_at(target)
            return [0, f"{target.name} does not answer", []]
        return [1, f"ready on {target.host}:{port}", ["TCPROS", str(target.host), port]]

    async def get_pid(self, caller: Caller) -> Answer:
        """`getPid(caller_id)` → the node's process id, from the node."""
        target = _target(caller)
        if target.of_monitors:
            return [1, "", os.getpid()]
        try:
            answer = await self.nodes.call(target, "getPid", caller.caller_id)
        except CallFailedError as error:
            self.liveness.look_at(target)
            raise NoAnswerError from error
        if isinstance(answer, list) and len(answer) == 3:
            return answer
        return [0, f"{target.name} answered with something that is not [code, message, pid]", -1]

    async def shutdown(self, caller: Caller, message: str) -> Answer:
        """`shutdown(caller_id, msg)`: sent to the node, which often ends before it answers."""
        target = _target(caller)
        if target.of_monitors:
            text = f"{target.name} publishes for the appliance's monitors; remove these with `rosrv monitor`"
            raise NotServedError(text)
        try:
            await self.nodes.call(target, "shutdown", caller.caller_id, message)
        except CallFailedError:
            self.liveness.look_at(target)
        return [1, "shutdown", 0]

    async def get_name(self, caller: Caller) -> Answer:
        return [1, "", _target(caller).name]

    async def get_uri(self, caller: Caller) -> Answer:
        """`getUri(caller_id)` → the URI of the proxy endpoint."""
        return [1, "", _target(caller).outer_uri(self.addresses.address_for(caller.peer))]

    async def get_master_uri(self, caller: Caller) -> Answer:
        """`getMasterUri(caller_id)` → RVMaster's."""
        uri = node_uri(self.addresses.address_for(caller.peer), self.port)
        return [1, uri, uri]

    async def get_subscriptions(self, caller: Caller) -> Answer:
        """`getSubscriptions(caller_id)` → `[[topic, type], …]`."""
        return [1, "subscriptions", _typed(_target(caller), Kind.SUBSCRIPTION)]

    async def get_publications(self, caller: Caller) -> Answer:
        """`getPublications(caller_id)` → `[[topic, type], …]`."""
        return [1, "publications", _typed(_target(caller), Kind.PUBLICATION)]

    async def get_bus_info(self, caller: Caller) -> Answer:
        """`getBusInfo(caller_id)` → `[[id, other end, direction, transport, topic, connected, text], …]`."""
        target, address = _target(caller), self.addresses.address_for(caller.peer)
        rows: list[Value] = []
        for connection in self.relay.carried.connections.values():
            if connection.kind != TOPIC_CONNECTION:
                continue
            if connection.key == target.key:
                port = self.relay.port(target, Kind.PUBLICATION, connection.resource)
                text = f"TCPROS connection on port {port} to [{connection.host}]"
                rows.append(
                    [connection.number, connection.caller_id, "o", "TCPROS", connection.resource, True, text]
                )
            if connection.caller_id == target.name and connection.host == str(target.host):
                publisher = self.registry.by_key(connection.key)
                if publisher is not None:
                    uri = publisher.outer_uri(address)
                    port = self.relay.port(publisher, Kind.PUBLICATION, connection.resource)
                    text = f"TCPROS connection to [{address}:{port}]"
                    rows.append([connection.number, uri, "i", "TCPROS", connection.resource, True, text])
        return [1, "bus info", rows]

    async def get_bus_stats(self, caller: Caller) -> Answer:
        """`getBusStats(caller_id)` → `[publications, subscriptions, services]`, from the relay's counters."""
        target, traffic, host = _target(caller), self.relay.carried.traffic, str(_target(caller).host)
        sent: defaultdict[str, list[Value]] = defaultdict(list)
        received: defaultdict[str, list[Value]] = defaultdict(list)
        for connection in self.relay.carried.connections.values():
            if connection.kind != TOPIC_CONNECTION:
                continue
            number, topic = connection.number, connection.resource
            carried = traffic.get((connection.key, topic), _NOTHING)
            if connection.key == target.key:
                sent[topic].append([number, carried.bytes, carried.messages, True])
            if (connection.caller_id, connection.host) == (target.name, host):
                received[topic].append([number, carried.bytes, -1, True])
        published: list[Value] = [
            [topic, traffic.get((target.key, topic), _NOTHING).bytes, sent[topic]]
            for topic in target.resources(Kind.PUBLICATION)
        ]
        subscribed: list[Value] = [[topic, received[topic]] for topic in target.resources(Kind.SUBSCRIPTION)]
        return [1, "", [published, subscribed, []]]


def _target(caller: Caller) -> Incarnation:
    if caller.target is None:
        raise RuntimeError("a call of the node API was made without a target")
    return caller.target


def _typed(target: Incarnation, kind: Kind) -> list[Value]:
    return [
        [registration.resource, registration.detail]
        for registration in target.registrations.values()
        if registration.kind is kind
    ]


NODE_CALLS: dict[str, RosCall[NodeCalls]] = {
    call.name: call
    for call in (
        RosCall(
            "requestTopic",
            method(NodeCalls.request_topic, TOPIC, PROTOCOLS),
            CallVerb.CONNECT,
            Kind.PUBLICATION,
            [],
        ),
        RosCall("getPid", method(NodeCalls.get_pid), CallVerb.READ, denial=-1),
        RosCall("shutdown", method(NodeCalls.shutdown, MESSAGE), CallVerb.DO),
        RosCall("getName", method(NodeCalls.get_name), CallVerb.READ, denial=""),
        RosCall("getUri", method(NodeCalls.get_uri), CallVerb.READ, denial=""),
        RosCall("getMasterUri", method(NodeCalls.get_master_uri), CallVerb.READ, denial=""),
        RosCall("getSubscriptions", method(NodeCalls.get_subscriptions), CallVerb.READ, denial=[]),
        RosCall("getPublications", method(NodeCalls.get_publications), CallVerb.READ, denial=[]),
        RosCall("getBusInfo", method(NodeCalls.get_bus_info), CallVerb.READ, denial=[]),
        RosCall("getBusStats", method(NodeCalls.get_bus_stats), CallVerb.READ, denial=[[], [], []]),
    )
}
