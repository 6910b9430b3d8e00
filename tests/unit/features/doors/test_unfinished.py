import asyncio
import json
from collections.abc import Callable

import pytest

from appliance.features.doors.quotas import DOOR_BYTES
from tests.support.features.doors.door_world import DoorWorld, WebSocketClient

pytestmark = pytest.mark.anyio
FIVE_HUNDRED_KBIT = 62_500  # bytes a second


def half_a_frame(client: WebSocketClient) -> None:
    client.writer.write(b"\x81\xff" + (1 << 20).to_bytes(8) + bytes(4) + b"[" * 1000)


def half_a_message(client: WebSocketClient) -> None:
    client.socket.send_text(b"[" * 1000, fin=False)
    client.flush()


def half_a_message_without_bytes(client: WebSocketClient) -> None:
    client.socket.send_text(b"", fin=False)
    client.flush()


async def trickle(client: WebSocketClient, data: bytes, rate: int) -> None:
    for start in range(0, len(data), rate):
        client.writer.write(data[start : start + rate])
        await asyncio.sleep(1)


def picture(size: int) -> bytes:
    operation = {"op": "publish", "topic": "/image", "msg": {"data": "x" * size}}
    text = json.dumps(operation).encode()
    return b"\x81\xff" + len(text).to_bytes(8) + bytes(4) + text


@pytest.mark.parametrize(
    ("begin", "subprotocol"),
    [
        (half_a_frame, ""),
        (half_a_message, ""),
        (half_a_message_without_bytes, ""),
        (half_a_frame, "foxglove.websocket.v1"),
        (half_a_message, "foxglove.sdk.v1"),
    ],
)
async def test_a_client_must_finish_what_it_has_begun_although_it_answers_pings(
    world: DoorWorld, begin: Callable[[WebSocketClient], None], subprotocol: str
) -> None:
    client = await world.client(subprotocols=[subprotocol] if subprotocol else ())
    await asyncio.sleep(100)
    begin(client)
    await asyncio.sleep(9)
    assert client.is_open
    await asyncio.sleep(5)
    assert (
        "bytes in 10 s of what it has begun; at least 16384" in await client.closed()
        and client.socket.close_code == 1008
    )
    assert "of what it has begun" in world.sessions[0].end
    assert world.memories[-1].held == 0


@pytest.mark.parametrize("meanwhile", ["bytes", "pings"])
async def test_few_bytes_and_pings_are_not_the_rest(world: DoorWorld, meanwhile: str) -> None:
    client = await world.client()
    (half_a_frame if meanwhile == "bytes" else half_a_message)(client)
    for _second in range(25):
        if not client.is_open:
            break
        if meanwhile == "bytes":
            client.writer.write(b"[" * 1000)
        else:
            client.socket.send_ping(b"x" * 125)
            client.flush()
        await asyncio.sleep(1)
    await client.closed()
    assert client.socket.close_code == 1008


@pytest.mark.parametrize("shares", [False, True])
async def test_a_picture_of_a_megabyte_goes_up_a_slow_link(world: DoorWorld, shares: bool) -> None:
    client = await world.client()
    client.send({"op": "advertise", "topic": "/image", "type": "std_msgs/String"})
    await asyncio.sleep(1)
    client.stop_reading()  # no answer to a ping may come inside a frame
    if shares:
        world.memories[-1].add(DOOR_BYTES.bounds.host // 4)
        assert world.memories[-1].shares
    for _picture in range(2):
        await trickle(client, picture(1 << 20), FIVE_HUNDRED_KBIT)
    assert world.sessions[0].received == 3 and not world.sessions[0].end


async def test_a_client_that_holds_memory_of_others_must_send_the_rest_faster(world: DoorWorld) -> None:
    client = await world.client()
    world.memories[-1].add(DOOR_BYTES.bounds.host // 4)
    await trickle(client, picture(1 << 19), FIVE_HUNDRED_KBIT // 4)
    assert "at least 262144" in await client.closed()


async def test_a_door_that_is_busy_blames_no_client(
    world: DoorWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = await world.client()

    async def slow(_request: object, _client: object) -> None:
        await asyncio.sleep(50)

    monkeypatch.setattr(world.door, "carry_out", slow)
    client.send({"op": "subscribe", "topic": "/image"})
    client.stop_reading()
    data = picture(1 << 17)
    client.writer.write(data[:1000])
    await asyncio.sleep(45)
    client.writer.write(data[1000:])
    await asyncio.sleep(10)
    assert world.sessions[0].received == 2 and not world.sessions[0].end


async def test_a_client_that_sends_pings_and_takes_no_answers_leaves_in_time(world: DoorWorld) -> None:
    client = await world.client()
    client.stop_reading()
    for _number in range(20_000):
        client.socket.send_ping(b"x" * 125)
    client.flush()
    await asyncio.sleep(70)
    assert world.sessions[0].end == "the client was silent for too long"
