"""A type is the one of its topic or service. A guest that names another type changes nothing for others."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest

from roswire.definitions import Definitions
from roswire.node import MessageType, RosNode, ServiceType
from roswire.standard import standard_definitions
from roswire.tcpros import Body
from tests.support.features.doors.door_world import DoorWorld, WebSocketClient, door_world

pytestmark = pytest.mark.anyio
OWN = {"my/State.msg": "int8 level\nint8 mode", "my/Set.srv": "bool on\n---\nbool done"}
FORGED = "int64 forged"


def standard() -> Definitions:
    return standard_definitions().merge(Definitions.from_files(OWN))


async def publishes(robot: RosNode, topic: str, name: str, text: str = "") -> Any:
    definitions = Definitions.from_full_text(name, text) if text else standard()
    return await robot.advertise(topic, MessageType.of(definitions, name), latched=False, queue=10)


async def call(client: WebSocketClient, service: str, args: Any = None) -> Any:
    client.send({"op": "call_service", "service": service, "args": args or {}, "id": service})
    while (frame := await client.next()).get("op") != "service_response":
        pass
    return frame


@asynccontextmanager
async def guest_world(topic: str, name: str) -> AsyncIterator[tuple[DoorWorld, WebSocketClient, RosNode]]:
    """Yield a door whose client has heard a forged type of a guest, also as a viewer does."""
    async with door_world() as world:
        world.types.define(Definitions.from_files(OWN))
        guest = await world.robot("10.0.0.66", "/guest")
        robot = await world.robot("10.0.0.3", "/robot")
        forged = await publishes(guest, topic, name, FORGED)
        world.master.answers["getSystemState"] = [[[topic, ["/guest"]]], [], []]
        world.master.answers["getTopicTypes"] = [[topic, name]]
        client = await world.client()
        client.send({"op": "subscribe", "topic": topic})
        await asyncio.sleep(1)
        forged.publish(bytes(8))
        assert (await client.next())["msg"] == {"forged": 0}
        await world.lookout.look()
        await asyncio.sleep(2)
        yield world, client, robot


async def calls_a_service_of_ros(_world: DoorWorld, client: WebSocketClient, robot: RosNode) -> None:
    heard: list[bytes] = []

    async def answer(body: bytes) -> bytes:
        heard.append(body)
        return b"\x01\0\0\0\0"

    await robot.offer("/set", ServiceType.of(standard(), "std_srvs/SetBool"), answer)
    answered = await call(client, "/set", {"data": True})
    assert (answered["result"], heard) == (True, [b"\x01"])
    assert answered["values"] == {"success": True, "message": ""}


async def offers_a_service(world: DoorWorld, client: WebSocketClient, robot: RosNode) -> None:
    client.send({"op": "advertise_service", "service": "/ask", "type": "std_srvs/SetBool"})
    await asyncio.sleep(1)
    md5sum = standard().service_md5sum("std_srvs/SetBool")
    calling = asyncio.ensure_future(robot.call_service("/ask", md5sum, b"\x01", 5.0))
    asked = await client.next()
    assert asked["args"] == {"data": True}
    values = {"success": True, "message": ""}
    client.send(
        {"op": "service_response", "service": "/ask", "id": asked["id"], "values": values, "result": True}
    )
    assert await calling == b"\x01\0\0\0\0"
    assert world.master.services["/ask"]


async def publishes_a_type_of_ros(world: DoorWorld, client: WebSocketClient, robot: RosNode) -> None:
    heard: list[Body] = []
    await robot.subscribe(
        "/cmd",
        lambda body, _header: heard.append(body),
        MessageType.of(standard(), "geometry_msgs/Twist"),
    )
    twist = {"linear": {"x": 1.0}}
    client.send({"op": "advertise", "topic": "/cmd", "type": "geometry_msgs/Twist", "will": twist})
    await asyncio.sleep(1)
    client.send({"op": "publish", "topic": "/cmd", "msg": twist})
    await asyncio.sleep(1)
    client.writer.close()
    await asyncio.sleep(5)
    assert [len(body) for body in heard] == [48, 48]  # the message and the will
    assert heard[0] == heard[1] and world.door


async def publishes_a_type_of_the_operator(
    _world: DoorWorld, client: WebSocketClient, robot: RosNode
) -> None:
    heard: list[Body] = []
    await robot.subscribe("/to_state", lambda body, _header: heard.append(body))
    client.send({"op": "advertise", "topic": "/to_state", "type": "my/State"})
    await asyncio.sleep(1)
    client.send({"op": "publish", "topic": "/to_state", "msg": {"level": 3, "mode": 4}})
    await asyncio.sleep(1)
    assert heard == [b"\x03\x04"]


async def reads_details(_world: DoorWorld, client: WebSocketClient, _robot: RosNode) -> None:
    for name, fields in {
        "geometry_msgs/Twist": ["linear", "angular"],
        "my/State": ["level", "mode"],
        "std_srvs/SetBoolRequest": ["data"],
    }.items():
        answered = await call(client, "/rosapi/message_details", {"type": name})
        assert answered["values"]["typedefs"][0]["fieldnames"] == fields


async def views_another_topic(world: DoorWorld, _client: WebSocketClient, robot: RosNode) -> None:
    for topic, name in {"/twist": "geometry_msgs/Twist", "/state": "my/State"}.items():
        await publishes(robot, topic, name)
        world.master.answers["getSystemState"] = [[[topic, ["/robot"]]], [], []]
        world.master.answers["getTopicTypes"] = [[topic, name]]
        await asyncio.sleep(3)
        assert [one.definition for one in (await world.lookout.look()).topics] == [standard().full_text(name)]


WAYS: tuple[Callable[[DoorWorld, WebSocketClient, RosNode], Awaitable[None]], ...] = (
    calls_a_service_of_ros, offers_a_service, publishes_a_type_of_ros, publishes_a_type_of_the_operator,
    reads_details, views_another_topic,
)  # fmt: skip


@pytest.mark.parametrize(
    "name", ["std_srvs/SetBoolRequest", "std_srvs/SetBoolResponse", "geometry_msgs/Twist", "my/State"]
)
@pytest.mark.parametrize("way", WAYS, ids=lambda way: way.__name__)
async def test_a_forged_type_of_a_guest_changes_nothing_elsewhere(way: Any, name: str) -> None:
    async with guest_world("/guest/topic", name) as (world, client, robot):
        await way(world, client, robot)
