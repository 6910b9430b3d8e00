"""The calls that ask about the graph, and RVMaster's own."""

import asyncio
import os
from typing import TYPE_CHECKING, cast

from appliance.master.calls.call import Answer, Caller
from appliance.master.calls.registration import key_of_stand_in
from appliance.master.graph.registry import Incarnation, Kind
from appliance.ros.uris import node_uri, service_uri
from appliance.ros.xmlrpc import Value

if TYPE_CHECKING:
    from appliance.master.core import Master


_ASK_AGAIN = (0.0, 0.01, 0.05, 0.2, 0.5, 0.0)  # seconds until ROSMaster is asked for a provider again


async def lookup_node(master: "Master", caller: Caller, arguments: tuple[object, ...]) -> Answer:
    """`lookupNode(caller_id, node_name)` → the node's outer URI."""
    answer = await master.rosmaster.call("lookupNode", caller.caller_id, str(arguments[0]))
    if answer[0] == 1:
        incarnation = master.faces.by_inner_uri(str(answer[2]))
        if incarnation is None or incarnation.name != arguments[0]:
            return [-1, f"unknown node [{arguments[0]}]", ""]
        told = master.addresses.told_to(caller.peer)
        answer[2] = incarnation.uri_for(told, hidden=master.mediation.stand_ins)
    return answer


async def lookup_service(master: "Master", caller: Caller, arguments: tuple[object, ...]) -> Answer:
    """`lookupService(caller_id, service)` → the relay's port for it; the caller may then call it."""
    service = str(arguments[0])
    answer, incarnation = await _provider(master, caller, service)
    if incarnation is not None:
        if master.mediation.carries_service(service):
            master.relay.grant_service(incarnation, service, caller.peer.host, caller.caller_id)
            port = master.relay.port(incarnation, Kind.SERVICE, service)
            uri = service_uri(master.addresses.told_to(caller.peer), port)
        else:
            port = int(incarnation.registrations[Kind.SERVICE, service].detail)
            uri = service_uri(str(incarnation.host), port)
        answer[1], answer[2] = f"rosrpc URI: [{uri}]", uri
    return answer


async def _provider(master: "Master", caller: Caller, service: str) -> tuple[Answer, Incarnation | None]:
    """ROSMaster's answer, and the provider that it names and the registry has.

    While a service gets another provider the two do not agree for a moment: ROSMaster's answer may be older than the
    registry, or newer, for answers overtake each other. A node asks once, so ROSMaster is asked until they do.
    """
    for pause in _ASK_AGAIN:
        answer = await master.rosmaster.call("lookupService", caller.caller_id, service)
        if answer[0] != 1:
            return answer, None
        incarnation = master.registry.by_key(key_of_stand_in(str(answer[2])))
        if incarnation is not None and (Kind.SERVICE, service) in incarnation.registrations:
            return answer, incarnation
        await asyncio.sleep(pause)
    return [-1, "no provider", ""], None


async def get_system_state(master: "Master", caller: Caller, _arguments: tuple[object, ...]) -> Answer:
    """`getSystemState(caller_id)` → `[publishers, subscribers, services]`."""
    answer = await master.rosmaster.call("getSystemState", caller.caller_id)
    if master.hide_publisher and answer[0] == 1:
        publishers, subscribers, services = cast(list[list[list[Value]]], answer[2])
        shown = [[topic, _others(master, cast(list[Value], names))] for topic, names in publishers]
        answer[2] = cast(Value, [[one for one in shown if one[1]], subscribers, services])
    return answer


def _others(master: "Master", names: list[Value]) -> list[Value]:
    return [name for name in names if name != master.publish_as]


async def get_published_topics(master: "Master", caller: Caller, arguments: tuple[object, ...]) -> Answer:
    """`getPublishedTopics(caller_id, subgraph)`."""
    return await master.rosmaster.call("getPublishedTopics", caller.caller_id, str(arguments[0]))


async def get_topic_types(master: "Master", caller: Caller, _arguments: tuple[object, ...]) -> Answer:
    """`getTopicTypes(caller_id)`."""
    return await master.rosmaster.call("getTopicTypes", caller.caller_id)


async def get_uri(master: "Master", caller: Caller, _arguments: tuple[object, ...]) -> Answer:
    """`getUri(caller_id)` → RVMaster's own, at the address the caller knows it by."""
    return [1, "", node_uri(master.addresses.told_to(caller.peer), master.port)]


async def get_pid(_master: "Master", _caller: Caller, _arguments: tuple[object, ...]) -> Answer:
    """`getPid(caller_id)` → RVMaster's own."""
    return [1, "", os.getpid()]


async def shutdown_master(master: "Master", caller: Caller, arguments: tuple[object, ...]) -> Answer:
    """`shutdown(caller_id, msg)`: ends the appliance, as it would end `roscore`."""
    message = str(arguments[0])
    master.stop(f"{caller.caller_id} on {caller.peer.text} called shutdown: {message}")
    return [1, "shutdown", 0]
