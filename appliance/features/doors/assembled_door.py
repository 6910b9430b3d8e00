"""Assemble the parts of a door that all its clients share."""

from collections.abc import Awaitable, Callable

from msgspec import Raw

from appliance.features.doors.client_requests import CallOfService
from appliance.features.doors.door_memory import ClientMemory
from appliance.features.doors.door_node import DoorNode, present_time
from appliance.features.doors.known_types import KnownTypes
from appliance.features.doors.lookout import HostsOf, Lookout
from appliance.features.doors.message_writer import Now
from appliance.features.doors.rosapi import MasterSight, Rosapi
from roswire.node import RosNode


def assembled_door(
    node: RosNode,
    types: KnownTypes,
    *,
    most_topics: int,
    calls: ClientMemory,
    hosts: HostsOf,
    now: Callable[[], Now] = present_time,
) -> tuple[DoorNode, Lookout]:
    def answer(request: CallOfService) -> Awaitable[Raw] | None:
        return rosapi.answer(request)

    sight = MasterSight(node, now)
    door = DoorNode(node, types, answer, most_topics=most_topics, calls=calls, hosts=hosts)
    lookout = Lookout(sight, types, door, hosts)
    rosapi = Rosapi(sight, types, lookout)
    return door, lookout
