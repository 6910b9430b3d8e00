import asyncio
import json
import struct
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.asyncio.client import ClientConnection, connect
from websockets.typing import Subprotocol

from tests.support.features.doors.real_door import real_door
from tests.support.nodes import RosSession
from tests.support.processes import Process
from tests.support.site import Site

SECONDS = 20.0


@pytest.fixture
def ros(site: Site, tmp_path: Path) -> Iterator[RosSession]:
    with RosSession(site.master_uri, tmp_path, site.robot) as session:
        yield session


def with_client(
    site: Site, work: Callable[[ClientConnection], Awaitable[None]], subprotocols: tuple[str, ...] = ()
) -> None:
    async def run() -> None:
        async with (
            asyncio.timeout(3 * SECONDS),
            real_door(site.master_uri, site.robot.address) as port,
            connect(
                f"ws://{site.robot.address}:{port}", subprotocols=[*map(Subprotocol, subprotocols)] or None
            ) as client,
        ):
            await work(client)

    on_robot: Any = getattr(site.robot, "run", None)
    on_robot(lambda: asyncio.run(run()))


async def next_frame(client: ClientConnection, op: str) -> Any:
    while True:
        frame = json.loads(await asyncio.wait_for(client.recv(), SECONDS))
        if frame["op"] == op:
            return frame


def test_a_rosbridge_client_hears_publishes_and_calls(site: Site, ros: RosSession) -> None:
    async def work(client: ClientConnection) -> None:
        await asyncio.to_thread(ros.talker, "roscpp", "/chatter")
        await client.send(json.dumps({"op": "subscribe", "topic": "/chatter"}))
        heard = await next_frame(client, "publish")
        assert heard["topic"] == "/chatter" and heard["msg"]["data"].startswith("hello ")
        await client.send(json.dumps({"op": "unsubscribe", "topic": "/chatter"}))
        listener = await asyncio.to_thread(ros.listener, "rospy", "/answer")
        await client.send(json.dumps({"op": "advertise", "topic": "/answer", "type": "std_msgs/String"}))
        await client.send(json.dumps({"op": "publish", "topic": "/answer", "msg": {"data": "first"}}))
        event = await asyncio.to_thread(listener.wait_for, event="received")
        assert event["data"] == "first"
        await asyncio.to_thread(ros.service_server, "roscpp", "/brake")
        await client.send(json.dumps({"op": "call_service", "service": "/brake", "args": [True], "id": 1}))
        assert (await next_frame(client, "service_response"))["values"]["success"] is False
        await client.send(json.dumps({"op": "call_service", "service": "/rosapi/topics_and_raw_types"}))
        topics = (await next_frame(client, "service_response"))["values"]
        assert "string data" in topics["typedefs_full_text"][topics["topics"].index("/chatter")]

    with_client(site, work)


@pytest.mark.real
@pytest.mark.parametrize(
    "site", ["appliance"], indirect=True
)  # a stock node may not hear a quick new advertisement
def test_a_guest_defines_no_type_for_another_topic(site: Site, ros: RosSession) -> None:
    """A guest comes first with another definition of the same md5sum, and leaves; then the robot's text changes."""

    async def work(client: ClientConnection) -> None:
        async def sends(*frames: dict[str, Any], topic: str = "/drive") -> None:
            for frame in frames:
                await client.send(json.dumps(frame | {"topic": topic}))

        async def drives(base: Process, message: dict[str, Any], **heard: Any) -> None:
            before = len(base.seen(event="received"))
            for _attempt in range(40):
                await sends({"op": "publish", "msg": message})
                await asyncio.sleep(0.5)
                if found := base.seen(event="received")[before:]:
                    assert {key: found[0][key] for key in heard} == heard
                    return
            raise AssertionError("the base heard nothing")

        advertise, subscribe = {"op": "advertise", "type": "own/Drive"}, {"op": "subscribe"}
        guest = await asyncio.to_thread(ros.node, "rospy", "drive", "/guest/drive", "left", name="guest")
        await sends(advertise, subscribe, topic="/guest/drive")
        assert (await next_frame(client, "publish"))["msg"]["left"] == []
        await sends({"op": "unsubscribe"}, topic="/guest/drive")
        base = await asyncio.to_thread(ros.node, "rospy", "drive", "/drive", "right", name="base")
        for leaves in (True, False):
            await sends(advertise, subscribe)
            while (heard := await next_frame(client, "publish"))["topic"] != "/drive":
                pass
            assert heard["msg"]["right"] == [] and heard["msg"]["left"]["speed"] > 0
            await drives(base, {"left": {"speed": 5}, "right": []}, left=5, right=[])
            if leaves:
                await sends({"op": "unsubscribe"})
                await asyncio.to_thread(guest.stop)
        await asyncio.to_thread(base.stop)
        base = await asyncio.to_thread(ros.node, "rospy", "drive", "/drive", "left", name="base")
        await drives(base, {"left": [{"speed": 7}], "right": {"speed": 6}}, left=[7], right=6)
        while (heard := await next_frame(client, "publish"))["msg"]["left"] != []:
            pass

    with_client(site, work)


def test_a_foxglove_viewer_gets_the_bytes_of_messages(site: Site, ros: RosSession) -> None:
    async def work(client: ClientConnection) -> None:
        assert client.subprotocol == "foxglove.websocket.v1"
        await asyncio.to_thread(ros.talker, "rospy", "/chatter")
        channel = None
        while channel is None:
            announced = (await next_frame(client, "advertise"))["channels"]
            channel = next((one for one in announced if one["topic"] == "/chatter"), None)
        subscription = {"id": 3, "channelId": channel["id"]}
        await client.send(json.dumps({"op": "subscribe", "subscriptions": [subscription]}))
        while not isinstance(frame := await asyncio.wait_for(client.recv(), SECONDS), bytes):
            pass
        opcode, number, _stamp, length = struct.unpack_from("<BIQI", frame)
        assert (opcode, number, len(frame)) == (1, 3, 17 + length) and frame[17:].startswith(b"hello ")

    with_client(site, work, ("foxglove.websocket.v1",))
