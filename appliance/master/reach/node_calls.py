"""The outer face: the node API that other nodes and tools call, answered as if the appliance were not there.

`caller.target` is the incarnation the call is for. Only `getPid` and `shutdown` are carried to the node; the rest is
answered from the registry and the relay. A `getPid` that the node does not answer breaks off as the node's own
connection would: `rosnode` takes that for a node it cannot reach and goes on, and ends at an answer that is an error.
The node that publishes for monitors is control itself: its process is control's. `publisherUpdate` and `paramUpdate`
are not in the table: only a master sends those, so from anybody else they are denied like any unknown call.
"""

import os
from typing import TYPE_CHECKING, cast

from appliance.master.calls.arguments import MESSAGE, PROTOCOLS, TOPIC
from appliance.master.calls.call import Answer, Call, Caller, Identity
from appliance.master.graph.registry import Incarnation, Kind
from appliance.master.reach.relays import tcpros_port
from appliance.ros.uris import node_uri
from appliance.ros.xmlrpc import Value
from appliance.rpc.client import CallFailedError
from appliance.rpc.server import NoAnswerError
from appliance.specifications.allocation import TOPIC as TOPIC_CONNECTION

if TYPE_CHECKING:
    from appliance.master.core import Master


async def request_topic(master: "Master", caller: Caller, arguments: tuple[object, ...]) -> Answer:
    """`requestTopic(caller_id, topic, protocols)` → the relay's port; the grant is installed first."""
    target = _target(caller)
    topic, protocols = str(arguments[0]), cast(list[list[Value]], arguments[1])
    if (Kind.PUBLICATION, topic) not in target.registrations:
        return [-1, f"Not a publisher of [{topic}]", []]
    names = [one[0] for one in protocols if one]
    if "TCPROS" not in names:
        offered = ", ".join(str(one)[:40] for one in names) or "nothing"
        return [0, f"only TCPROS is carried through the appliance; the subscriber offers {offered}", []]
    own = target.own or master.gate.is_own_subscriber(caller, topic)  # who has no way but the relay
    if not own and not master.mediation.carries_topic(topic):
        return await _negotiated_directly(master, target, topic, caller)
    master.relay.grant_topic(target, topic, caller.peer.host, caller.caller_id)
    address = master.addresses.told_to(caller.peer)
    port = master.relay.port(target, Kind.PUBLICATION, topic)
    return [1, f"ready on {address}:{port}", ["TCPROS", address, port]]


async def _negotiated_directly(master: "Master", target: Incarnation, topic: str, caller: Caller) -> Answer:
    """The node's own TCPROS port at its peer address; the host in its answer is never followed."""
    try:
        answer = await master.liveness.client(target).call(
            "requestTopic", caller.caller_id, topic, [["TCPROS"]]
        )
        port = tcpros_port(answer)
    except CallFailedError:
        master.liveness.look_at(target)
        return [0, f"{target.name} does not answer", []]
    return [1, f"ready on {target.host}:{port}", ["TCPROS", str(target.host), port]]


async def get_pid(master: "Master", caller: Caller, _arguments: tuple[object, ...]) -> Answer:
    """`getPid(caller_id)`: asked of the node."""
    target = _target(caller)
    if target.of_monitors:
        return [1, "", os.getpid()]
    try:
        answer = await master.liveness.client(target).call("getPid", caller.caller_id)
    except CallFailedError as error:
        master.liveness.look_at(target)
        raise NoAnswerError from error
    if isinstance(answer, list) and len(answer) == 3:
        return answer
    return [0, f"{target.name} answered with something that is not [code, message, pid]", -1]


async def shutdown(master: "Master", caller: Caller, arguments: tuple[object, ...]) -> Answer:
    """`shutdown(caller_id, msg)`: carried to the node, which often dies before it answers."""
    target = _target(caller)
    if target.of_monitors:
        return [
            0,
            f"{target.name} publishes for the appliance's monitors; `rosrv monitor` takes those back",
            0,
        ]
    message = str(arguments[0])
    try:
        await master.liveness.client(target).call("shutdown", caller.caller_id, message)
    except CallFailedError:
        master.liveness.look_at(target)
    return [1, "shutdown", 0]


async def get_name(_master: "Master", caller: Caller, _arguments: tuple[object, ...]) -> Answer:
    """`getName(caller_id)`."""
    return [1, "", _target(caller).name]


async def get_uri(master: "Master", caller: Caller, _arguments: tuple[object, ...]) -> Answer:
    """`getUri(caller_id)` → the outer URI."""
    return [1, "", _target(caller).outer_uri(master.addresses.told_to(caller.peer))]


async def get_master_uri(master: "Master", caller: Caller, _arguments: tuple[object, ...]) -> Answer:
    """`getMasterUri(caller_id)` → RVMaster's."""
    uri = node_uri(master.addresses.told_to(caller.peer), master.port)
    return [1, uri, uri]


async def get_subscriptions(_master: "Master", caller: Caller, _arguments: tuple[object, ...]) -> Answer:
    """`getSubscriptions(caller_id)` → `[[topic, type], …]`."""
    return [1, "subscriptions", _typed(_target(caller), Kind.SUBSCRIPTION)]


async def get_publications(_master: "Master", caller: Caller, _arguments: tuple[object, ...]) -> Answer:
    """`getPublications(caller_id)` → `[[topic, type], …]`."""
    return [1, "publications", _typed(_target(caller), Kind.PUBLICATION)]


async def get_bus_info(master: "Master", caller: Caller, _arguments: tuple[object, ...]) -> Answer:
    """`getBusInfo(caller_id)` → `[[id, other end, direction, transport, topic, connected, text], …]`."""
    target, address = _target(caller), master.addresses.told_to(caller.peer)
    rows: list[Value] = []
    for connection in master.relay.connections.values():
        if connection.kind != TOPIC_CONNECTION:
            continue
        if connection.key == target.key:
            port = master.relay.port(target, Kind.PUBLICATION, connection.resource)
            text = f"TCPROS connection on port {port} to [{connection.host}]"
            rows.append(
                [connection.number, connection.caller_id, "o", "TCPROS", connection.resource, True, text]
            )
        if connection.caller_id == target.name and connection.host == str(target.host):
            publisher = master.registry.by_key(connection.key)
            if publisher is not None:
                uri = publisher.outer_uri(address)
                port = master.relay.port(publisher, Kind.PUBLICATION, connection.resource)
                text = f"TCPROS connection to [{address}:{port}]"
                rows.append([connection.number, uri, "i", "TCPROS", connection.resource, True, text])
    return [1, "bus info", rows]


async def get_bus_stats(master: "Master", caller: Caller, _arguments: tuple[object, ...]) -> Answer:
    """`getBusStats(caller_id)` → `[publications, subscriptions, services]`, from the relay's counters."""
    target = _target(caller)
    connections = [one for one in master.relay.connections.values() if one.kind == TOPIC_CONNECTION]
    published: list[Value] = []
    for topic in target.resources(Kind.PUBLICATION):
        traffic = master.relay.traffic.get((target.key, topic))
        size, count = (traffic.bytes, traffic.messages) if traffic is not None else (0, 0)
        rows: list[Value] = [
            [one.number, size, count, True]
            for one in connections
            if one.key == target.key and one.resource == topic
        ]
        published.append([topic, size, rows])
    subscribed: list[Value] = []
    for topic in target.resources(Kind.SUBSCRIPTION):
        rows = []
        for one in connections:
            if one.resource == topic and one.caller_id == target.name and one.host == str(target.host):
                traffic = master.relay.traffic.get((one.key, topic))
                rows.append([one.number, traffic.bytes if traffic is not None else 0, -1, True])
        subscribed.append([topic, rows])
    return [1, "", [published, subscribed, []]]


def _target(caller: Caller) -> Incarnation:
    if caller.target is None:
        raise RuntimeError("a call of the node API was made without a target")
    return caller.target


def _typed(target: Incarnation, kind: Kind) -> list[Value]:
    return [[one.resource, one.detail] for one in target.registrations.values() if one.kind is kind]


NODE_CALLS: dict[str, Call] = {
    call.name: call
    for call in (
        Call(
            "requestTopic",
            request_topic,
            (TOPIC, PROTOCOLS),
            denial=[],
            identity=Identity.NODE,
            resource=0,
        ),
        Call("getPid", get_pid, denial=-1, reads=True),
        Call("shutdown", shutdown, (MESSAGE,)),
        Call("getName", get_name, denial="", reads=True),
        Call("getUri", get_uri, denial="", reads=True),
        Call("getMasterUri", get_master_uri, denial="", reads=True),
        Call("getSubscriptions", get_subscriptions, denial=[], reads=True),
        Call("getPublications", get_publications, denial=[], reads=True),
        Call("getBusInfo", get_bus_info, denial=[], reads=True),
        Call("getBusStats", get_bus_stats, denial=[[], [], []], reads=True),
    )
}
