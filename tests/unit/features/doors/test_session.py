import asyncio
import json
import struct
import time
import tracemalloc
from typing import Any

import cbor2
import pytest
from websockets.datastructures import Headers
from websockets.frames import Frame, Opcode
from websockets.typing import Subprotocol

from appliance.features.doors.door_memory import DoorMemory
from appliance.features.doors.foxglove import Foxglove, FoxgloveLimits
from appliance.features.doors.known_types import DoorMessage, KnownTypes
from appliance.features.doors.origins import rejection
from appliance.features.doors.quotas import DOOR_BYTES
from appliance.features.doors.rosbridge import Rosbridge, RosbridgeLimits
from appliance.features.doors.values import ValueLimits
from appliance.features.doors.viewer_queue import ViewerQueue
from roswire.definitions import Definitions
from roswire.node import MessageType, RosNode, ServiceType
from roswire.standard import standard_definitions
from roswire.tcpros import Body
from roswire.xmlrpc import MethodCall
from tests.support.features.doors.door_world import DOOR, DoorWorld, WebSocketClient

pytestmark = pytest.mark.anyio


def string(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


async def offers_late(node: RosNode, service: str, kind: str, seconds: float = 3600) -> None:
    """Offer a service that answers after this time."""

    async def answer(_body: bytes) -> bytes:
        await asyncio.sleep(seconds)
        return b""

    await node.offer(service, ServiceType.of(standard_definitions(), kind), answer)


async def talks(node: RosNode, topic: str, *, latched: bool = False) -> Any:
    kind = MessageType.of(standard_definitions(), "std_msgs/String")
    return await node.advertise(topic, kind, latched=latched, queue=100)


@pytest.mark.parametrize("subprotocols", [[], [Subprotocol("foxglove.websocket.v1")]])
async def test_a_client_whose_right_ends_before_its_handshake_gets_nothing(
    world: DoorWorld, subprotocols: list[Subprotocol]
) -> None:
    streams = world.network.connect("10.0.0.9", DOOR)
    await asyncio.sleep(1)
    world.sessions[0].revoke("this host is blocked by an operator")
    client = WebSocketClient(*streams, subprotocols=subprotocols)
    await asyncio.sleep(5)
    assert client.response is not None and client.response.status_code == 403
    assert client.response.body == b"this host is blocked by an operator\n" and client.frames.empty()
    assert not world.sessions[0].began and "blocked" in world.sessions[0].end


async def test_wills_and_arguments_of_waiting_calls_are_bounded(world: DoorWorld) -> None:
    """Each is charged its own bytes, not those of its whole frame."""
    robot, client = await world.robot("10.0.0.3", "/robot"), await world.client()
    await offers_late(robot, "/slow", "roscpp/SetLoggerLevel")
    large, will = "x" * (1 << 18), {"op": "advertise", "topic": "/cmd", "type": "std_msgs/String"}
    client.send(will | {"will": {"data": "x" * 5000}})
    assert "at most 4096" in (await client.next())["msg"]
    tracemalloc.start()
    for number in range(6):
        client.send(will | {"topic": f"/cmd{number}", "will": {"data": "stop"}, "more": large})
        client.send({"op": "call_service", "service": "/slow", "more": large, "args": {"logger": "x"}})
    await asyncio.sleep(5)
    taken, _peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert taken < 3 * len(large)
    taken = DOOR_BYTES.bounds.host - 8 * len(large)
    world.calls.add(taken)
    for _number in range(6):
        client.send({"op": "call_service", "service": "/slow", "args": {"logger": large}})
        await asyncio.sleep(0.1)
    refusal = await client.next()
    assert "would hold" in refusal["values"]["message"]
    assert client.frames.qsize() < 5
    world.calls.add(-taken)
    await asyncio.sleep(100)


async def test_one_letter_makes_no_frame_take_more_than_is_charged(world: DoorWorld) -> None:
    clients = [await world.client() for _number in range(4)]
    world.master.before_answer = lambda _call: asyncio.sleep(5)
    tracemalloc.start()
    for number, client in enumerate(clients):
        more = f"{'x' * (4 << 20)}{number}\N{GRINNING FACE}"
        frame = {"op": "advertise", "topic": f"/t{number}", "type": "std_msgs/String", "more": more}
        client.send(json.dumps(frame, ensure_ascii=False))
        del frame, more
    await asyncio.sleep(1)
    taken, _peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert 16 << 20 < taken < sum(memory.held for memory in world.memories)
    world.master.before_answer = None
    await asyncio.sleep(10)


async def test_a_frame_of_few_bytes_that_takes_much_memory_is_refused_in_words(world: DoorWorld) -> None:
    client = await world.client()
    client.send({"op": "advertise", "topic": "/markers", "type": "visualization_msgs/MarkerArray"})
    await asyncio.sleep(1)
    tracemalloc.start()
    client.send('{"op":"publish","id":1,"topic":"/markers","msg":{"markers":[' + "{}," * 2_000_000 + "{}]}}")
    status = await client.next()
    _taken, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert "the client would hold" in status["msg"] and status["id"] == 1
    assert peak < DOOR_BYTES.bounds.host
    assert "id" not in await client.next()
    client.send({"op": "publish", "topic": "/markers", "msg": {"markers": [{}] * 20_000}})
    await asyncio.sleep(1)
    assert client.frames.empty() and client.is_open


async def test_without_memory_small_frames_are_carried_out_and_a_large_one_ends_the_connection(
    world: DoorWorld,
) -> None:
    robot, client = await world.robot("10.0.0.3", "/robot"), await world.client()
    heard: list[Body] = []
    await robot.subscribe("/a", lambda body, _header: heard.append(body))
    for memory in world.memories:
        memory.add(DOOR_BYTES.bounds.host)
    client.send({"op": "advertise", "topic": "/a", "type": "std_msgs/String"})
    client.send({"op": "publish", "topic": "/a", "msg": {"data": "stop"}})
    await asyncio.sleep(1)
    world.waiting.add(-DOOR_BYTES.bounds.host)
    client.send({"op": "publish", "topic": "/a", "msg": {"data": "stop"}})
    await asyncio.sleep(1)
    assert client.is_open and heard == [string("stop")]
    client.send({"op": "publish", "topic": "/a", "msg": {"data": "x" * 400_000}})
    assert "the client would hold" in await client.closed()
    world.calls.add(-DOOR_BYTES.bounds.host)


@pytest.mark.parametrize("deflate", [False, True])
async def test_messages_of_every_size_have_frames_that_clients_read(world: DoorWorld, deflate: bool) -> None:
    publication = await talks(await world.robot("10.0.0.3", "/robot"), "/state")
    world.master.answers["getSystemState"] = [[["/state", ["/robot"]]], [], []]
    world.master.answers["getTopicTypes"] = [["/state", "std_msgs/String"]]
    clients = {
        kind: await world.client(
            deflate=deflate, subprotocols=["foxglove.websocket.v1"] if kind == "f" else ()
        )
        for kind in ("none", "cbor", "cbor-raw", "f")
    }
    for kind in ("none", "cbor", "cbor-raw"):
        clients[kind].send({"op": "subscribe", "topic": "/state", "compression": kind})
    assert (await clients["f"].next())["op"] == "serverInfo"
    channels: list[Any] = []
    while not channels:
        channels = (await clients["f"].next()).get("channels", [])
    number = next(channel["id"] for channel in channels if channel["topic"] == "/state")
    clients["f"].send({"op": "subscribe", "subscriptions": [{"id": 9, "channelId": number}]})
    await asyncio.sleep(1)
    for size in (0, 1, 40, 121, 122, 125, 126, 127, 65_400, 65_535, 65_536, 70_000, 300_000):
        publication.publish(string("x" * size))
        assert (await clients["none"].next())["msg"]["data"] == "x" * size
        assert (await clients["cbor"].next())["msg"]["data"] == "x" * size
        assert (await clients["cbor-raw"].next())["msg"]["bytes"] == string("x" * size)
        opcode, subscription, _stamp = struct.unpack_from("<BIQ", data := await clients["f"].next())
        assert (opcode, subscription, data[13:]) == (1, 9, string("x" * size))


async def test_pings_without_reading_their_answers_stop_the_reading(world: DoorWorld) -> None:
    client = await world.client()
    client.stop_reading()
    for _ in range(50):
        for _number in range(1000):
            client.socket.send_ping(b"x" * 125)
        client.flush()
        await asyncio.sleep(0.1)
    [session] = world.sessions
    assert session.received_bytes < 50 * 125_000 / 2


async def test_a_burst_of_a_client_on_a_topic_that_it_hears_itself_arrives_whole(world: DoorWorld) -> None:
    client = await world.client()
    client.send({"op": "advertise", "topic": "/loop", "type": "std_msgs/Int32"})
    client.send({"op": "subscribe", "topic": "/loop"})
    await asyncio.sleep(1)
    for number in range(3000):
        client.socket.send_text(b'{"op":"publish","topic":"/loop","msg":{"data":%d}}' % number)
    client.flush()
    assert [(await client.next())["msg"]["data"] for _number in range(3000)] == [*range(3000)]


async def test_a_topic_ends_ten_seconds_after_its_last_client_however_often_clients_leave(
    world: DoorWorld,
) -> None:
    tasks = len(asyncio.all_tasks())
    for _ in range(4):
        client = await world.client()
        for number in range(20):
            client.send({"op": "advertise", "topic": f"/cmd{number}", "type": "std_msgs/String"})
            client.send({"op": "subscribe", "topic": f"/state{number}"})
        await asyncio.sleep(4)
        client.writer.close()
        await asyncio.sleep(2)
        assert len(asyncio.all_tasks()) < tasks + 10
    await asyncio.sleep(7)
    assert world.master.publishers["/cmd0"] and world.master.subscribers["/state0"]
    await asyncio.sleep(2)
    for number in range(20):
        assert world.master.publishers[f"/cmd{number}"] == []
        assert world.master.subscribers[f"/state{number}"] == []


async def test_a_viewer_that_stops_reading_delays_no_other_and_takes_bounded_memory(world: DoorWorld) -> None:
    robot = await world.robot("10.0.0.3", "/robot")
    publication = await talks(robot, "/image")
    stuck, reading = await world.client(), await world.client()
    for client in (stuck, reading):
        client.send({"op": "subscribe", "topic": "/image", "compression": "cbor-raw", "queue_length": 1000})
    await asyncio.sleep(1)
    stuck.stop_reading()
    for number in range(100):
        publication.publish(string(f"{number:03}" + "x" * 200_000))
        await asyncio.sleep(0.05)
    received = [await reading.next() for _ in range(100)]
    assert [frame["msg"]["bytes"][4:7] for frame in received] == [b"%03d" % number for number in range(100)]
    assert 90 < world.queues[0].dropped < 100  # its queue has 1 MB
    assert world.queues[1].dropped == 0
    await asyncio.sleep(100)
    assert world.sessions[0].end == "the client was silent for too long"
    assert reading.is_open


async def test_a_client_that_does_not_read_gives_shared_memory_back_within_seconds(world: DoorWorld) -> None:
    publication = await talks(await world.robot("10.0.0.3", "/robot"), "/image")
    clients = [await world.client() for _number in range(4)]
    stuck, slow, small, reading = clients
    for client in clients:
        client.send({"op": "subscribe", "topic": "/image", "compression": "cbor-raw"})
    await asyncio.sleep(1)
    for client in clients[:3]:
        client.stop_reading()
    for memory in (world.memories[2], world.memories[3]):  # as for a larger message
        memory.add(DOOR_BYTES.bounds.host // 2)
    publication.publish(string("x" * 3_000_000))
    await asyncio.sleep(1)
    assert DOOR_BYTES.bounds.host // 2 < world.memory.shared
    for _second in range(12):
        await slow.reader.readexactly(200_000)
        await asyncio.sleep(1)
    assert "the client took 0 bytes in 5 s" in world.sessions[0].end
    assert world.memories[2].held == 0 and stuck.writer.peer.closed
    assert [session.end for session in world.sessions[1:]] == ["", "", ""]
    assert (await reading.next())["op"] == "publish" and small.is_open


async def test_a_message_is_charged_until_the_client_has_room_for_it(world: DoorWorld) -> None:
    publication = await talks(await world.robot("10.0.0.3", "/robot"), "/image")
    client = await world.client()
    client.send({"op": "subscribe", "topic": "/image", "compression": "cbor-raw"})
    await asyncio.sleep(1)
    client.stop_reading()
    publication.publish(string("x" * 400_000))
    await asyncio.sleep(1)
    memory = world.memories[-1]
    assert world.queues[0].take(0.0) is None
    assert 400_000 < memory.held < 410_000
    await asyncio.sleep(100)  # the client is disconnected
    assert memory.held == 0


async def test_a_message_that_has_no_room_in_its_encoding_is_refused_in_words(world: DoorWorld) -> None:
    publication = await talks(await world.robot("10.0.0.3", "/robot"), "/image")
    client = await world.client()
    client.send({"op": "subscribe", "topic": "/image"})
    await asyncio.sleep(1)
    for other in (world.waiting, world.calls):
        other.add(DOOR_BYTES.bounds.host)
    for text in ("\x01" * 3_000_000, "small"):
        publication.publish(string(text))
        await asyncio.sleep(1)
    refused, message = await client.next(), await client.next()
    assert (refused["op"], refused["level"]) == ("status", "error")
    assert "/image: the client would hold 180" in refused["msg"]
    assert message["msg"] == {"data": "small"}
    for other in (world.waiting, world.calls):
        other.add(-DOOR_BYTES.bounds.host)


@pytest.mark.parametrize(
    ("deflate", "frame", "code"),
    [
        (True, "[" + " " * 50_000_000, 1009),
        (False, " " * (8 << 20) + "{", 1009),
        (False, b"\x00" * (8 << 20) + b"a", 1009),
    ],
)
async def test_a_frame_that_is_too_large_even_inflated_ends_the_connection(
    world: DoorWorld, deflate: bool, frame: str | bytes, code: int
) -> None:
    """The rest of the frame is read, because unread bytes would reset the connection before the closing frame."""
    client = await world.client(deflate=deflate)
    client.send(frame)
    await client.closed()
    assert client.socket.close_code == code
    assert client.writer.peer.reader.at_eof()
    other = await world.client()
    assert other.is_open


async def test_fragments_of_websocket_frames_have_one_limit_together(world: DoorWorld) -> None:
    client = await world.client()
    client.socket.send_text(b" " * (5 << 20), fin=False)
    client.socket.send_continuation(b" " * (5 << 20), fin=True)
    client.flush()
    await client.closed()
    assert client.socket.close_code == 1009


async def test_fragments_take_the_memory_of_their_bytes(world: DoorWorld) -> None:
    client = await world.client()
    client.socket.send_text(b'{"op":"x"', fin=False)
    client.flush()
    await asyncio.sleep(0.1)
    tracemalloc.start()
    for part in (b"", b" "):
        for _ in range(5000):
            client.socket.send_continuation(part, fin=False)
        client.flush()
        await asyncio.sleep(1)
    taken, _peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert taken < 60_000
    client.socket.send_continuation(b"}", fin=True)
    client.flush()
    assert "unknown operation 'x'" in (await client.next())["msg"]


async def test_a_text_frame_that_is_not_utf_8_ends_the_connection(world: DoorWorld) -> None:
    client = await world.client()
    client.socket.send_text(b'{"op":"\xff"}')
    client.flush()
    assert await client.closed() == "a text frame that is not UTF-8"
    assert client.socket.close_code == 1007


@pytest.mark.parametrize(
    ("origin", "status"), [(None, 101), ("https://robot.example", 101), ("https://evil.example", 403)]
)
async def test_only_listed_pages_may_connect(world: DoorWorld, origin: str | None, status: int) -> None:
    client = await world.client(origin=origin)
    assert client.response is not None and client.response.status_code == status
    assert status == 101 or b"'https://evil.example' may not connect" in (client.response.body or b"")


@pytest.mark.parametrize(
    ("origins", "host", "accepted"),
    [
        ([], "evil.example:9090", True),  # not a browser
        (["http://10.0.0.2:9090"], "10.0.0.2:9090", True),
        (["https://[fd00::2]:9090"], "[fd00::2]:9090", True),
        (["http://localhost:9090"], "localhost:9090", True),
        (["http://evil.example:9090"], "evil.example:9090", False),  # whose name has the door's address
        (["http://10.0.0.2:8080"], "10.0.0.2:9090", False),
        (["http://localhost.evil.example:9090"], "localhost.evil.example:9090", False),
        (["http://10.0.0.2.evil.example"], "10.0.0.2.evil.example", False),
        (["http://evil.example@10.0.0.2"], "10.0.0.2", False),
        (["null"], "10.0.0.2:9090", False),
        ([""], "", False),
        (["https://robot.example", "https://evil.example"], "10.0.0.2:9090", False),
        (["https://robot.example."], "10.0.0.2:9090", False),
    ],
)
def test_an_origin_that_equals_the_host_is_accepted_only_for_addresses(
    origins: list[str], host: str, accepted: bool
) -> None:
    headers = Headers([("Host", host), *(("Origin", origin) for origin in origins)])
    assert (rejection(headers, ("https://robot.example",)) == "") is accepted


@pytest.mark.parametrize(
    "sent",
    [
        b"",
        b"GET / HTTP/1.1\r\nHost: x\r\n\r\n",
        b"\x16\x03\x01\x02\x00",
        b"GET /" + b"a" * 20_000,
        b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * 2000,
        b"POST / HTTP/1.1\r\n\r\n",
    ],
)
async def test_a_peer_without_a_handshake_is_disconnected_in_time(world: DoorWorld, sent: bytes) -> None:
    reader, writer = world.network.connect("10.0.0.9", DOOR)
    writer.write(sent)
    async with asyncio.timeout(20):
        await reader.read()
    assert world.sessions[0].end


async def test_connections_of_a_door_are_bounded_in_number_and_rate(world: DoorWorld) -> None:
    hosts = [f"10.0.1.{number}" for number in range(world.limits.connections + 5)]
    answers = [(await world.client(host)).response for host in hosts]
    statuses = [answer.status_code for answer in answers if answer is not None]
    assert statuses == [101] * world.limits.connections + [503] * 5
    assert len(world.refusals) == 5
    assert answers[-1] is not None and b"the limit is 32" in (answers[-1].body or b"")
    world.network.break_off(DOOR)
    await asyncio.sleep(20)
    assert world.limits.in_ten_seconds == 200
    refused = 0
    for number in range(250):
        client = WebSocketClient(*world.network.connect(f"10.0.0.{number}", DOOR))
        await asyncio.sleep(0.01)
        refused += client.response is not None and client.response.status_code == 503
        client.writer.close()
    assert refused == 50
    await asyncio.sleep(20)
    assert (await world.client()).is_open


@pytest.mark.parametrize("op", ["subscribe", "advertise"])
async def test_topics_of_a_door_are_bounded_over_all_its_hosts(world: DoorWorld, op: str) -> None:
    request = {"op": op, "type": "std_msgs/String"}
    greedy, others = await world.client(), [await world.client(f"10.0.1.{n}") for n in range(14)]
    for number in range(50):
        greedy.send(request | {"topic": f"/a{number}"})
    await asyncio.sleep(2)
    refusals = [(await greedy.next())["msg"] for _number in range(13)]
    assert all("would use 38 topics of this door, leaving 12 for all others" in one for one in refusals)
    for number in range(13):
        others[number].send(request | {"topic": f"/b{number}"})
    await asyncio.sleep(2)
    assert greedy.frames.empty() and all(other.frames.empty() for other in others)
    others[13].send(request | {"topic": "/c"})
    assert "use 50 topics of this door; the limit is 50" in (await others[13].next())["msg"]


@pytest.mark.parametrize(("begin", "end"), [("subscribe", "unsubscribe"), ("advertise", "unadvertise")])
async def test_a_client_that_goes_through_a_thousand_topics_a_second_takes_none_of_another(
    world: DoorWorld, begin: str, end: str
) -> None:
    flooding, other = await world.client(), await world.client()
    registered = world.master.subscribers if begin == "subscribe" else world.master.publishers
    other.send({"op": begin, "topic": "/own", "type": "std_msgs/String"})
    seconds = range(2)
    for second in seconds:
        for number in range(1000):
            topic = f"/t{second}_{number}"
            flooding.send({"op": begin, "topic": topic, "type": "std_msgs/String"})
            flooding.send({"op": end, "topic": topic})
        await asyncio.sleep(1)
        other.send({"op": begin, "topic": f"/own{second}", "type": "std_msgs/String"})
        await asyncio.sleep(1)
        present = {topic for topic, nodes in registered.items() if nodes}
        assert len(present) <= 50 and {"/own", f"/own{second}"} <= present
    assert other.frames.empty() and flooding.frames.empty()
    await asyncio.sleep(11)
    assert {t for t, nodes in registered.items() if nodes} == {"/own", *(f"/own{n}" for n in seconds)}


async def test_a_thousand_calls_that_get_no_answer_leave_calls_for_other_hosts(world: DoorWorld) -> None:
    """A call waits on for ten seconds although its client has left."""
    await offers_late(await world.robot("10.0.0.3", "/robot"), "/hangs", "std_srvs/Empty")
    words = []
    for _client in range(10):
        client = await world.client()
        for number in range(100):
            client.send({"op": "call_service", "service": "/hangs", "id": number})
        await asyncio.sleep(0.5)
        words += [client.frames.get_nowait()["values"]["message"] for _ in range(client.frames.qsize())]
        client.writer.close()
    assert len(words) == 1000 - 192
    assert "would use 193 calls of this door that wait for answers" in words[0]
    other = await world.client("10.0.0.10")
    other.send({"op": "call_service", "service": "/rosapi/get_time", "id": 1})
    assert (await other.next())["result"] is True
    await asyncio.sleep(61)
    last = await world.client()
    last.send({"op": "call_service", "service": "/rosapi/get_time", "id": 1})
    assert (await last.next())["result"] is True


async def test_services_that_one_host_offers_leave_some_for_others(world: DoorWorld) -> None:
    offer = {"op": "advertise_service", "type": "std_srvs/Empty"}
    clients = [await world.client() for _number in range(4)]
    for number in range(400):
        clients[number // 100].send(offer | {"service": f"/s{number}"})
    await asyncio.sleep(5)
    assert sum(client.frames.qsize() for client in clients) == 100
    assert "would use 301 services of this door" in (await clients[3].next())["msg"]
    other = await world.client("10.0.0.10")
    other.send(offer | {"service": "/other"})
    await asyncio.sleep(1)
    assert other.frames.empty() and "/other" in world.master.services


async def test_reads_of_parameters_of_one_host_delay_another_by_one_read(world: DoorWorld) -> None:
    foxglove = ["foxglove.websocket.v1"]
    flooding = [await world.client(subprotocols=foxglove) for _number in range(4)]
    other = await world.client("10.0.0.10", subprotocols=foxglove)
    world.master.before_answer = lambda _call: asyncio.sleep(0.01)
    read = {"op": "getParameters", "parameterNames": [f"/p{number}" for number in range(100)]}
    for client in flooding:
        for number in range(8):
            client.send(read | {"id": str(number)})
    await asyncio.sleep(1)
    other.send({"op": "getParameters", "parameterNames": ["/p"], "id": "own"})
    async with asyncio.timeout(6):
        while (await other.next()).get("id") != "own":
            pass
    world.master.before_answer = None
    await asyncio.sleep(100)


@pytest.mark.parametrize("pings", [0, 5000])
async def test_a_driver_whose_window_is_full_stops_the_robot_in_time(world: DoorWorld, pings: int) -> None:
    """Also if it has sent pings whose answers it does not take."""
    robot, client = await world.robot("10.0.0.3", "/robot"), await world.client()
    heard: list[Body] = []
    await robot.subscribe("/cmd", lambda body, _header: heard.append(body))
    image = await talks(robot, "/image")
    client.send({"op": "advertise", "topic": "/cmd", "type": "std_msgs/String", "will": {"data": "stop"}})
    client.send({"op": "subscribe", "topic": "/image"})
    await asyncio.sleep(1)
    client.stop_reading()
    for _number in range(20):
        image.publish(string("x" * 100_000))
        client.send({"op": "publish", "topic": "/cmd", "msg": {"data": "go"}})
        await asyncio.sleep(1)
    assert heard == [string("go")] * 20  # it drives on while it is heard
    for _number in range(pings):
        client.socket.send_ping(b"x" * 125)
    client.flush()
    await asyncio.sleep(6)
    assert heard[20:] == [string("stop")]


async def test_parameters_of_one_host_leave_some_for_others(world: DoorWorld) -> None:
    foxglove = ["foxglove.websocket.v1"]
    greedy = [await world.client(subprotocols=foxglove) for _number in range(2)]
    other = await world.client("10.0.0.10", subprotocols=foxglove)
    for number, client in enumerate(greedy):
        names = [f"/p{number}_{parameter}" for parameter in range(1000)]
        client.send({"op": "subscribeParameterUpdates", "parameterNames": names})
    other.send({"op": "subscribeParameterUpdates", "parameterNames": ["/own"]})
    await asyncio.sleep(5)
    refusal = "would use 1500 subscribed parameters of this door"
    assert sum(refusal in frame.get("message", "") for frame in _taken(*greedy)) == 501
    assert not any("subscribed parameters" in frame.get("message", "") for frame in _taken(other))


def _taken(*clients: WebSocketClient) -> list[Any]:
    return [client.frames.get_nowait() for client in clients for _ in range(client.frames.qsize())]


async def test_a_call_ends_soon_after_its_client_and_a_long_one_as_late_as_it_wishes(
    world: DoorWorld,
) -> None:
    await offers_late(await world.robot("10.0.0.3", "/robot"), "/slow", "std_srvs/Empty", 600)
    stays, leaves = await world.client(), await world.client()
    for client, number in ((stays, 1), (leaves, 2)):
        client.send({"op": "call_service", "service": "/slow", "id": number, "timeout": 3600})
    stays.send({"op": "call_service", "service": "/slow", "id": 3})
    await asyncio.sleep(1)
    assert world.door.waiting_calls.total == 3
    leaves.writer.close()
    await asyncio.sleep(12)
    assert world.door.waiting_calls.total == 2
    async with asyncio.timeout(700):
        first, second = await stays.frames.get(), await stays.frames.get()
    assert (first["id"], first["values"]["message"]) == (3, "/slow did not answer within 60 s")
    assert (second["id"], second["result"]) == (1, True)


async def test_two_spellings_of_a_topic_both_get_its_messages(world: DoorWorld) -> None:
    publication = await talks(await world.robot("10.0.0.3", "/robot"), "/state")
    client = await world.client()
    for spelling in ("state", "/state"):
        client.send({"op": "subscribe", "topic": spelling})
    await asyncio.sleep(1)
    publication.publish(string("ready"))
    assert {(await client.next())["topic"] for _spelling in range(2)} == {"state", "/state"}
    client.send({"op": "unsubscribe", "topic": "state"})
    await asyncio.sleep(1)
    publication.publish(string("ready"))
    assert (await client.next())["topic"] == "/state"


async def test_a_denial_of_the_policy_before_is_asked_about_again(world: DoorWorld) -> None:
    world.master.answers["getSystemState"] = [[["/load", ["/robot"]]], [], []]
    world.master.answers["getTopicTypes"] = [["/load", "own/Load"]]
    own = MessageType.of(Definitions.from_files({"own/Load.msg": "float32 weight"}), "own/Load")
    await (await world.robot("10.0.0.3", "/robot")).advertise("/load", own, latched=False, queue=10)
    world.master.denials["registerSubscriber"] = "denied by [Subscribers]"

    async def change_policy(call: MethodCall) -> None:
        if call.method == "registerSubscriber":
            world.lookout.policy_changed()

    world.master.before_answer = change_policy
    client = await world.client(subprotocols=["foxglove.sdk.v1"])
    await asyncio.sleep(1)
    assert [frame["channels"] for frame in _taken(client) if frame["op"] == "advertise"] == [[]]
    del world.master.denials["registerSubscriber"]
    await asyncio.sleep(2)
    assert [channel["topic"] for channel in (await client.next())["channels"]] == ["/load"]


NUMBERS = 20_000
LOAD = {"op": "publish", "topic": "/load", "msg": {"data": [0.0] * NUMBERS}}
TYPED = LOAD | {"msg": {"data": cbor2.CBORTag(86, bytes(8 * NUMBERS))}}
HOSTILE: dict[str, tuple[Opcode, bytes, int]] = {
    "json": (Opcode.TEXT, json.dumps(LOAD).encode(), 5),
    "cbor": (Opcode.BINARY, cbor2.dumps(LOAD), 3),
    "typed array": (Opcode.BINARY, cbor2.dumps(TYPED), 5),
    "refused": (Opcode.TEXT, b'{"op":"x"}', 200),
    "ping": (Opcode.PING, b"", 2000),
}
"""By kind: the frames that each of 24 clients sends, and their number."""


@pytest.mark.parametrize("kind", HOSTILE)
async def test_frames_of_one_host_do_not_delay_those_of_another(world: DoorWorld, kind: str) -> None:
    opcode, data, count = HOSTILE[kind]
    robot, heard = await world.robot("10.0.0.3", "/robot"), list[float]()
    await robot.subscribe("/cmd", lambda *_message: heard.append(time.thread_time()))
    hostile = [await world.client("10.0.0.66", deflate=True) for _number in range(24)]
    for one in hostile:
        one.send({"op": "advertise", "topic": "/load", "type": "std_msgs/Float64MultiArray"})
    client = await world.client()
    client.send({"op": "advertise", "topic": "/cmd", "type": "std_msgs/String"})
    await asyncio.sleep(10)
    for one in hostile:
        one.stop_reading()
        for _number in range(count):
            one.socket.send_frame(Frame(opcode, data))
    for one in hostile:
        one.flush()
    client.send({"op": "publish", "topic": "/cmd", "msg": {"data": "stop"}})
    began = time.thread_time()
    await asyncio.sleep(10)
    whole = time.thread_time() - began
    assert heard[0] - began < whole / 3
    for one in hostile:
        one.read_on()


async def test_names_of_parameters_whose_reads_wait_are_bounded(world: DoorWorld) -> None:
    client = await world.client(subprotocols=["foxglove.websocket.v1"])
    world.master.answers |= {"getSystemState": [[], [], []], "getTopicTypes": []}
    world.master.answers |= {"hasParam": True, "getParam": 1}
    world.master.before_answer = lambda _call: asyncio.sleep(0.01)
    for number in range(3):
        names = [f"/{'x' * 1000}{one}" for one in range(1000)]
        client.send({"op": "getParameters", "parameterNames": names, "id": str(number)})
    await asyncio.sleep(1)
    assert world.calls.held > 3_000_000
    _taken(client)
    client.send({"op": "getParameters", "parameterNames": ["/a"] * 1001})
    assert "1001 parameters; name at most 1000" in (await client.next())["message"]
    world.calls.add(DOOR_BYTES.bounds.host)
    client.send({"op": "getParameters", "parameterNames": ["/a"]})
    assert "too many calls of this door wait" in (await client.next())["message"]
    world.calls.add(-DOOR_BYTES.bounds.host)
    for number in range(3):
        assert (await client.next())["id"] == str(number)
    assert world.calls.held == 0
    world.master.before_answer = None


def test_a_raw_message_that_waited_is_sent_although_other_clients_took_memory() -> None:
    door = DoorMemory()
    queue = ViewerQueue[str](message_bytes=64 << 20, memory=door.client())
    rosbridge = Rosbridge("/door_alice", RosbridgeLimits(), queue)
    rosbridge.receive(b'{"op":"subscribe","topic":"/t","compression":"cbor-raw"}', is_text=True)
    body = bytes(40 << 20)
    kind = KnownTypes(standard_definitions(), ValueLimits()).message("std_msgs/String")
    rosbridge.message(DoorMessage("/t", body, {}, 0, lambda _header: kind), 0.0)
    for size in (40 << 20, 30 << 20):
        other = door.client()
        assert not other.refusal(size)
        other.add(size)
    frame = rosbridge.next_frame(0.0)
    assert isinstance(frame, tuple) and frame[1] is body


LONG = "\U0001f600" * 1000  # four bytes a character
NAME, KIND = f"/{'t' * 1000}", f"a/{'T' * 1000}"
CAMERA = ["/" * slashes + "camera" for slashes in range(1, 201)]
Frames = list[dict[str, Any]]
TABLES: dict[str, tuple[Frames, Frames]] = {
    "ids of spellings": (
        [{"op": "subscribe", "topic": topic, "id": f"{LONG}{one}"} for topic in CAMERA for one in range(100)],
        [{"op": "unsubscribe", "topic": topic} for topic in CAMERA],
    ),
    "ids of advertisements": (
        [{"op": "advertise", "topic": "/t", "type": KIND, "id": f"{LONG}{one}"} for one in range(100)],
        [{"op": "unadvertise", "topic": "/t", "id": f"{LONG}{one}"} for one in range(100)],
    ),
    "topics": (
        [{"op": "subscribe", "topic": f"{NAME}{number}", "type": KIND} for number in range(1000)],
        [{"op": "unsubscribe", "topic": f"{NAME}{number}"} for number in range(1000)],
    ),
    "advertisements": (
        [{"op": "advertise", "topic": f"{NAME}{number}", "type": KIND, "will": "w" * 4000} for number in range(1000)],
        [{"op": "unadvertise", "topic": f"{NAME}{number}"} for number in range(1000)],
    ),
    "services": (
        [{"op": "advertise_service", "service": f"{NAME}{number}", "type": KIND} for number in range(100)],
        [{"op": "unadvertise_service", "service": f"{NAME}{number}"} for number in range(100)],
    ),
    "calls": ([{"op": "call_service", "service": NAME, "id": f"{LONG}{one}"} for one in range(100)], []),
    "channels": (
        [{"op": "advertise", "channels": [{"id": one, "topic": NAME, "encoding": "ros1", "schemaName": KIND}]}
         for one in range(200)],
        [{"op": "unadvertise", "channelIds": [*range(200)]}],
    ),
    "parameters": (
        [{"op": "subscribeParameterUpdates", "parameterNames": [f"{NAME}{number}"]} for number in range(1000)],
        [{"op": "unsubscribeParameterUpdates", "parameterNames": []}],
    ),
}  # fmt: skip
"""By table of a protocol: frames that fill it to its limit, and frames that empty it."""


@pytest.mark.parametrize("refused", [False, True])
@pytest.mark.parametrize("table", TABLES)
def test_a_protocol_charges_a_client_for_what_it_keeps(table: str, refused: bool) -> None:
    queue = ViewerQueue[Any]()
    protocol: Any = Rosbridge("/door", RosbridgeLimits(), queue)
    if table in {"channels", "parameters"}:
        protocol = Foxglove("/door", FoxgloveLimits(), queue)
    filling, emptying = (
        [json.dumps(frame, ensure_ascii=False).encode() for frame in frames] for frames in TABLES[table]
    )

    def read() -> None:
        while queue.take(0.0) is not None:
            pass
        queue.memory.sent()

    def carry_out(frame: bytes) -> None:
        for request in protocol.receive(frame, is_text=True):
            if refused:
                protocol.failed(request, "no")
        read()

    tracemalloc.start()
    for frame in filling:
        carry_out(frame)
    taken, _peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert taken < 1.5 * queue.memory.held + 100_000
    assert queue.memory.held < DOOR_BYTES.bounds.host
    for frame in emptying:
        carry_out(frame)
    if table == "calls":
        for number in range(1, 101):
            protocol.answered(number, b"{}")
    read()
    assert queue.memory.held < 10_000 if refused else queue.memory.held == 0  # the reasons that it got
