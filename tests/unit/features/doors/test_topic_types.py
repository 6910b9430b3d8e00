"""A type is the one of its topic or service. A guest that names another type changes nothing for others."""

import asyncio
import json
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest

from appliance.features.doors.foxglove import SUBPROTOCOLS
from roswire.definitions import Definitions
from roswire.node import MessageType, RosNode, ServiceType
from roswire.standard import standard_definitions
from roswire.tcpros import Body
from tests.support.features.doors.door_world import DoorWorld, WebSocketClient, door_world

pytestmark = pytest.mark.anyio
OWN = {"my/State.msg": "int8 level\nint8 mode", "my/Set.srv": "bool on\n---\nbool done"}
FORGED = "int64 forged"


def standard() -> Definitions:
    return standard_definitions().extended(Definitions.from_files(OWN))


async def publishes(robot: RosNode, topic: str, name: str, text: str = "") -> Any:
    definitions = Definitions.from_full_text(name, text) if text else standard()
    return await robot.advertise(topic, MessageType.defined(definitions, name), latched=False, queue=10)


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

    await robot.offer("/set", ServiceType.defined(standard(), "std_srvs/SetBool"), answer)
    answered = await call(client, "/set", {"data": True})
    assert (answered["result"], answered["values"], heard) == (
        True,
        {"success": True, "message": ""},
        [b"\x01"],
    )


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
    await robot.subscribe("/cmd", lambda body, _header: heard.append(body), _twist())
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
    calls_a_service_of_ros,
    offers_a_service,
    publishes_a_type_of_ros,
    publishes_a_type_of_the_operator,
    reads_details,
    views_another_topic,
)


@pytest.mark.parametrize(
    "name", ["std_srvs/SetBoolRequest", "std_srvs/SetBoolResponse", "geometry_msgs/Twist", "my/State"]
)
@pytest.mark.parametrize("way", WAYS, ids=lambda way: way.__name__)
async def test_a_forged_type_of_a_guest_changes_nothing_elsewhere(way: Any, name: str) -> None:
    async with guest_world("/guest/topic", name) as (world, client, robot):
        await way(world, client, robot)


def _twist() -> MessageType:
    return MessageType.defined(standard(), "geometry_msgs/Twist")


async def test_two_versions_on_two_topics_are_both_shown() -> None:
    """Two packages of one robot may be built with different versions of a third one."""
    async with door_world() as world:
        robot = await world.robot("10.0.0.3", "/robot")
        old = await publishes(robot, "/old", "own/Load", "int8 x")
        new = await publishes(robot, "/new", "own/Load", "int16 x")
        world.master.answers["getSystemState"] = [[["/new", ["/robot"]], ["/old", ["/robot"]]], [], []]
        world.master.answers["getTopicTypes"] = [["/new", "own/Load"], ["/old", "own/Load"]]
        seen = (await world.lookout.look()).topics
        assert [(one.topic, one.definition) for one in seen] == [("/new", "int16 x"), ("/old", "int8 x")]
        client = await world.client()
        for topic in ("/old", "/new"):
            client.send({"op": "subscribe", "topic": topic, "type": "own/Load"})
        await asyncio.sleep(1)
        old.publish(b"\x01")
        new.publish(b"\x02\0")
        assert [(await client.next())["msg"] for _topic in range(2)] == [{"x": 1}, {"x": 2}]
        answered = await call(client, "/rosapi/message_details", {"type": "own/Load"})
        assert "own/Load' has several definitions" in answered["values"]["message"]
        assert "/new" in answered["values"]["message"] and "/old" in answered["values"]["message"]


@pytest.mark.parametrize("first", ["/guest", "/robot"])
async def test_a_second_md5sum_on_a_topic_is_refused_in_words(first: str) -> None:
    """The version of ROS counts, whichever publisher comes first."""
    async with door_world() as world:
        guest, robot = await world.robot("10.0.0.66", "/guest"), await world.robot("10.0.0.3", "/robot")
        client, viewer = await world.client(), await world.client(subprotocols=SUBPROTOCOLS)
        client.send({"op": "subscribe", "topic": "/level", "type": "std_msgs/Int8"})
        world.master.answers["getSystemState"] = [[["/level", ["/robot"]]], [], []]
        world.master.answers["getTopicTypes"] = [["/level", "std_msgs/Int8"]]
        await asyncio.sleep(3)
        viewer.send({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 1}]})
        await asyncio.sleep(1)
        makers = {"/guest": (guest, FORGED), "/robot": (robot, "")}
        publications = {}
        for name in sorted(makers, key=lambda one: one != first):
            publications[name] = await publishes(makers[name][0], "/level", "std_msgs/Int8", makers[name][1])
        await asyncio.sleep(1)
        for _message in range(3):
            publications["/guest"].publish(bytes(8))
            publications["/robot"].publish(b"\x07")
            await asyncio.sleep(1)
        frames = [await client.next() for _frame in range(client.frames.qsize())]
        heard = [one["msg"] for one in frames if one["op"] == "publish"]
        words = [one["msg"] for one in frames if one["op"] == "status"]
        assert heard[-3:] == [{"data": 7}] * 3 and heard[:-3] in ([], [{"forged": 0}])
        assert len(words) == 1 and "/level has publishers of two types: std_msgs/Int8" in words[0]
        seen = [await viewer.next() for _frame in range(viewer.frames.qsize())]
        assert [one[13:] for one in seen if isinstance(one, bytes)] == [b"\x07"] * 3
        assert any(
            "md5sum" in json.dumps(one) for one in seen if isinstance(one, dict) and one["op"] == "status"
        )


async def test_a_type_of_a_topic_is_gone_with_its_publisher() -> None:
    async with door_world() as world:
        guest = await world.robot("10.0.0.66", "/guest")
        await publishes(guest, "/shared", "own/Load", FORGED)
        client = await world.client()
        advertise = {"op": "advertise", "topic": "/shared", "type": "own/Load"}
        other = advertise | {"topic": "/other"}
        client.send(other)
        assert "no publisher of /other has been heard" in (await client.next())["msg"]
        client.send(advertise)
        client.send(advertise | {"op": "publish", "msg": {"forged": 1}})
        await asyncio.sleep(2)
        client.send({"op": "unadvertise", "topic": "/shared"})
        await guest.unadvertise("/shared")
        await asyncio.sleep(15)
        client.send(advertise)
        assert "no publisher of /shared has been heard" in (await client.next())["msg"]
        await publishes(await world.robot("10.0.0.3", "/robot"), "/shared", "own/Load", "int8 x")
        client.send(advertise)
        await asyncio.sleep(2)
        client.send({"op": "publish", "topic": "/shared", "msg": {"forged": 1}})
        assert "unknown field `forged`" in (await client.next())["msg"]


@pytest.mark.parametrize(
    ("changed", "text"),
    [
        ({}, "float32 b"),
        ({"latch": True}, "float32 a"),
        ({"type": "own/Other"}, "float32 a"),
        ({}, "float32 a"),
    ],
)
async def test_the_next_client_gets_the_publication_that_it_advertises(
    changed: dict[str, Any], text: str
) -> None:
    """A topic stays registered for some seconds after its last client, and is not that of another type or latch."""
    async with door_world() as world:
        first, second = await world.client(), await world.client()
        advertise = {"op": "advertise", "topic": "/t", "type": "own/Load"}
        files = {"own/Load.msg": "float32 a", "own/Other.msg": "float32 c"}
        world.types.define(Definitions.from_files(files))
        first.send(advertise)
        await asyncio.sleep(1)
        first.writer.close()
        await asyncio.sleep(2)
        registered = world.node.publishers["/t"]
        world.types.define(Definitions.from_files(files | {"own/Load.msg": text}))
        second.send(advertise | changed)
        await asyncio.sleep(1)
        publication = world.node.publishers["/t"]
        assert second.frames.empty() and (publication is registered) is (not changed and text == "float32 a")
        assert publication.latched is ("latch" in changed)
        assert publication.type.name == changed.get("type", "own/Load")
        if publication.type.name == "own/Load":
            assert publication.type.definition.strip() == text


async def test_a_publication_on_a_topic_of_two_types_is_refused_in_words() -> None:
    async with door_world() as world:
        for address, text in {"10.0.0.66": FORGED, "10.0.0.3": "int8 x"}.items():
            await publishes(await world.robot(address, f"/n{address[-1]}"), "/shared", "own/Load", text)
        client = await world.client()
        client.send({"op": "advertise", "topic": "/shared", "type": "own/Load"})
        assert "/shared has publishers of two types, own/Load with the md5sum" in (await client.next())["msg"]


LEFT = "Wheels[] left\nWheels right" + f"\n{'=' * 80}\nMSG: own/Wheels\nint8 speed"
RIGHT = LEFT.replace("Wheels[] left", "Wheels left").replace("Wheels right", "Wheels[] right")
"""Two definitions with one md5sum, because it leaves out the brackets. One right wheel of `RIGHT` reads as one left."""


async def next_warning(client: WebSocketClient) -> str:
    while (frame := await client.next())["op"] != "status":
        pass
    return str(frame["msg"])


async def test_a_definition_with_the_same_md5sum_changes_nothing_on_another_topic() -> None:
    """A guest sent its definition first. Clients still read and write with that of the topic's own publisher."""
    async with door_world() as world:
        guest, robot = await world.robot("10.0.0.66", "/guest"), await world.robot("10.0.0.3", "/robot")
        await publishes(guest, "/guest/drive", "own/Drive", LEFT)
        own = await publishes(robot, "/drive", "own/Drive", RIGHT)
        client, viewer = await world.client(), await world.client(subprotocols=SUBPROTOCOLS)
        client.send({"op": "subscribe", "topic": "/guest/drive"})
        client.send({"op": "advertise", "topic": "/guest/drive", "type": "own/Drive"})
        world.master.answers["getSystemState"] = [
            [["/drive", ["/robot"]], ["/guest/drive", ["/guest"]]],
            [],
            [],
        ]
        world.master.answers["getTopicTypes"] = [["/drive", "own/Drive"], ["/guest/drive", "own/Drive"]]
        await asyncio.sleep(3)
        heard: list[Body] = []
        await robot.subscribe("/drive", lambda body, _header: heard.append(body))
        for gone in (False, True):
            if gone:
                await guest.close()
                world.nodes.remove(guest)
                await asyncio.sleep(15)
            client.send({"op": "subscribe", "topic": "/drive"})
            client.send({"op": "advertise", "topic": "/drive", "type": "own/Drive"})
            await asyncio.sleep(2)
            client.send({"op": "publish", "topic": "/drive", "msg": {"left": {"speed": 5}, "right": []}})
            await asyncio.sleep(1)
            assert heard.pop() == b"\x05\0\0\0\0" and not heard
            assert (await client.next())["msg"] == {"left": {"speed": 5}, "right": []}
            own.publish(b"\x07\0\0\0\0")
            assert (await client.next())["msg"] == {"left": {"speed": 7}, "right": []}
            heard.clear()
        channels: dict[str, str] = {}
        while len(channels) < 2:
            frame = await viewer.next()
            channels |= {one["topic"]: one["schema"] for one in frame.get("channels", ())}
        assert channels == {"/drive": RIGHT, "/guest/drive": LEFT}
        [found] = world.types.take_differing()
        assert found.name == "own/Drive"
        assert {found.earlier, found.later} == {("/guest", "/guest/drive"), ("/robot", "/drive")}
        assert world.types.take_differing() == []


@pytest.mark.parametrize("robot_host", ["0", "7"])
async def test_the_robots_own_definition_comes_before_that_of_a_guest_who_was_first(robot_host: str) -> None:
    """Without a publisher on the robot's machine, the first one counts until it is gone. All clients get the reason."""
    async with door_world() as world:
        world.hosts = {"/guest": "66", "/robot": robot_host}
        guest, robot = await world.robot("10.0.0.66", "/guest"), await world.robot("10.0.0.3", "/robot")
        first = await publishes(guest, "/drive", "own/Drive", LEFT)
        client, late = await world.client(), await world.client()
        client.send({"op": "subscribe", "topic": "/drive"})
        await asyncio.sleep(1)
        first.publish(b"\0\0\0\0\x01")
        assert (await client.next())["msg"] == {"left": [], "right": {"speed": 1}}
        own = await publishes(robot, "/drive", "own/Drive", RIGHT)
        await asyncio.sleep(1)
        own.publish(b"\x02\0\0\0\0")
        assert "another definition of own/Drive with the same md5sum are dropped" in await next_warning(
            client
        )
        await asyncio.sleep(1)
        late.send({"op": "subscribe", "topic": "/drive"})
        assert "with the same md5sum" in await next_warning(late)
        for speed in (3, 4):
            own.publish(bytes([speed]) + bytes(4))
            first.publish(b"\0\0\0\0" + bytes([speed]))
            await asyncio.sleep(1)
        while late.frames.qsize():
            values = (await late.next())["msg"]
            assert values["right"] == ([] if robot_host == "0" else {"speed": values["right"]["speed"]}), (
                values
            )
        late.send({"op": "advertise", "topic": "/drive", "type": "own/Drive"})
        await asyncio.sleep(2)
        refused = late.frames.qsize() and "publishers of two types" in (await late.next())["msg"]
        assert refused == (robot_host != "0")
        await guest.unadvertise("/drive")
        await asyncio.sleep(1)
        own.publish(b"\x05\0\0\0\0")
        while (frame := await late.next())["op"] != "publish" or frame["msg"]["right"] != []:
            pass
        assert frame["msg"] == {"left": {"speed": 5}, "right": []}


@pytest.mark.parametrize("comes", [True, False])
async def test_a_client_does_not_publish_a_definition_whose_publisher_is_gone(comes: bool) -> None:
    async with door_world() as world:
        guest, robot = await world.robot("10.0.0.66", "/guest"), await world.robot("10.0.0.3", "/robot")
        heard: list[Body] = []
        await robot.subscribe("/drive", lambda body, _header: heard.append(body))
        await publishes(guest, "/drive", "own/Drive", LEFT)
        client = await world.client()
        message = {"left": [{"speed": 5}], "right": {"speed": 0}}
        client.send({"op": "advertise", "topic": "/drive", "type": "own/Drive"})
        await asyncio.sleep(2)
        client.send({"op": "publish", "topic": "/drive", "msg": message})
        await asyncio.sleep(1)
        assert heard.pop() == b"\x01\0\0\0\x05\0"
        await guest.unadvertise("/drive")
        if comes:
            await publishes(robot, "/drive", "own/Drive", RIGHT)
        await asyncio.sleep(1 if comes else 15)
        client.send({"op": "publish", "topic": "/drive", "msg": message})
        words = "two types" if comes else "the publishers of /drive that define its type are gone"
        assert words in await next_warning(client)
        client.send({"op": "publish", "topic": "/drive", "msg": message})
        again = "Expected `object`" if comes else "no publisher of /drive has been heard"
        assert again in await next_warning(client)
        client.send({"op": "publish", "topic": "/drive", "msg": {"left": {"speed": 5}}})
        await asyncio.sleep(1)
        assert heard == ([b"\x05\0\0\0\0"] if comes else [])


async def test_a_service_that_is_replaced_by_another_type_is_not_called_with_old_bytes() -> None:
    async with door_world() as world:
        robot = await world.robot("10.0.0.3", "/robot")

        async def answer(_body: bytes) -> bytes:
            raise AssertionError("it must not be called")

        await robot.offer("/set", ServiceType.defined(standard(), "std_srvs/Trigger"), answer)
        world.master.answers["getSystemState"] = [[], [], [["/set", ["/robot"]]]]
        world.master.answers["getTopicTypes"] = []
        viewer = await world.client(subprotocols=SUBPROTOCOLS)
        while (frame := await viewer.next())["op"] != "advertiseServices":
            pass
        await robot.withdraw("/set")
        await robot.offer("/set", ServiceType.defined(standard(), "std_srvs/SetBool"), answer)
        number = frame["services"][0]["id"]
        viewer.send(b"\x02" + number.to_bytes(4, "little") + b"\x01\0\0\0\x04\0\0\0ros1")
        while (frame := await viewer.next())["op"] != "serviceCallFailure":
            pass
        assert "has the type std_srvs/SetBool, not std_srvs/Trigger" in frame["message"]
