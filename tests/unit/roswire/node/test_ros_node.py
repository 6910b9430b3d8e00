import asyncio
import tracemalloc
from collections.abc import AsyncIterator
from typing import Any

import pytest

from roswire.errors import LimitExceededError, ProtocolError
from roswire.node import (
    MasterDenialError,
    MessageType,
    NodeLimits,
    PeerUnreachableError,
    RosNode,
    ServiceFailedError,
    ServiceType,
)
from roswire.node.network import ByteWriter
from roswire.node.tcpros_streams import read_header
from roswire.node.topics import OwnMemory
from roswire.tcpros import Body, HeaderParser, encode_frame, encode_header
from roswire.uris import parse_node_uri
from roswire.xmlrpc import MethodCall, Value, build_fault, build_response
from tests.support.autojump import own_tasks
from tests.support.memory_network import MemoryNetwork
from tests.support.scripted_master import MASTER, ScriptedMaster

pytestmark = pytest.mark.anyio
STRING = MessageType("std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1", "string data\n")
SET_BOOL = ServiceType(
    "std_srvs/SetBool",
    "09fb03525b03e7ea1fd3992bafd87e16",
    "std_srvs/SetBoolRequest",
    "std_srvs/SetBoolResponse",
)


class Nodes:
    def __init__(self) -> None:
        self.network = MemoryNetwork()
        self.master = ScriptedMaster(self.network)
        self.nodes: list[RosNode] = []
        self.ends: list[str] = []
        self.skipped = 0

    def _skip(self) -> None:
        self.skipped += 1

    async def node(self, address: str, memory: OwnMemory | None = None, **limits: Any) -> RosNode:
        node = RosNode(
            f"/node_{address.rpartition('.')[2]}",
            MASTER,
            self.network.at(address),
            limits=NodeLimits(**limits),
            shut_down=self.ends.append,
            memory=memory,
            skipped=self._skip,
        )
        await node.start()
        self.nodes.append(node)
        return node


@pytest.fixture
async def world() -> AsyncIterator[Nodes]:
    """Yield nodes of one master. At the end, no task of them may remain."""
    made = Nodes()
    yield made
    for node in made.nodes:
        await node.close()
    await asyncio.sleep(1)
    assert not own_tasks()


async def later(seconds: float = 1.0) -> None:
    await asyncio.sleep(seconds)


async def test_messages_arrive_in_order_with_the_publishers_header(world: Nodes) -> None:
    talker, listener = await world.node("10.0.0.2"), await world.node("10.0.0.3")
    heard: list[tuple[Body, str]] = []
    await listener.subscribe("/chatter", lambda body, header: heard.append((body, header["type"])))
    publisher = await talker.advertise("/chatter", STRING, latched=False, queue=10)
    await later()
    for number in range(3):
        publisher.publish(b"%d" % number)
    await later()
    assert heard == [(b"0", "std_msgs/String"), (b"1", "std_msgs/String"), (b"2", "std_msgs/String")]
    for source, (host, _port) in world.network.connections:
        assert (source, host) in {
            ("10.0.0.2", "10.0.0.1"),
            ("10.0.0.3", "10.0.0.1"),
            ("10.0.0.3", "10.0.0.2"),
            ("10.0.0.1", "10.0.0.3"),
        }


async def test_too_many_large_messages_are_dropped_and_counted(world: Nodes) -> None:
    talker, listener = await world.node("10.0.0.2"), await world.node("10.0.0.3", arriving_bytes=100_000)
    heard: list[Body] = []
    await listener.subscribe("/image", lambda body, _header: heard.append(body))
    publisher = await talker.advertise("/image", STRING, latched=False, queue=10)
    await later()
    for size in (100_001, 3, 100_000):
        publisher.publish(bytes(size))
        await later()
    assert ([*map(len, heard)], world.skipped) == ([3, 100_000], 1)


async def test_headers_come_from_all_publishers_that_are_connected_now(world: Nodes) -> None:
    talker, listener = await world.node("10.0.0.2"), await world.node("10.0.0.3")
    subscription = await listener.subscribe("/chatter", lambda _body, _header: None)
    await talker.advertise("/chatter", STRING, latched=False, queue=10)
    await later()
    assert [header["callerid"] for header in await subscription.headers(1)] == ["/node_2"]
    await talker.unadvertise("/chatter")
    await later()
    assert await subscription.headers(1) == []
    for address in ("10.0.0.4", "10.0.0.5"):
        await (await world.node(address)).advertise("/chatter", STRING, latched=False, queue=10)
    found = await subscription.headers(1)
    assert sorted(header["callerid"] for header in found) == ["/node_4", "/node_5"]


async def test_a_latched_message_reaches_a_late_subscriber(world: Nodes) -> None:
    talker, listener = await world.node("10.0.0.2"), await world.node("10.0.0.3")
    publisher = await talker.advertise("/map", STRING, latched=True, queue=1)
    publisher.publish(b"old")
    publisher.publish(b"new")
    heard: list[Body] = []
    await listener.subscribe("/map", lambda body, _header: heard.append(body))
    await later()
    assert heard == [b"new"]


@pytest.mark.parametrize(
    ("sent", "heard"),
    [
        ("0a 1a", "a"),
        ("0a 1a 0b", "ab"),
        ("0a 0b 1b", "b"),
        ("0a 1b 0b", "b"),
        ("1a 0a", "a"),
        ("1a 0a 0b", "ab"),
    ],
)
async def test_a_repeated_message_is_neither_lost_nor_doubled(world: Nodes, sent: str, heard: str) -> None:
    """Connection 0 is the subscription's, 1 the repetition's. The client missed the messages before the repetition."""
    talker, listener = await world.node("10.0.0.2"), await world.node("10.0.0.3")
    publication = await talker.advertise("/map", STRING, latched=True, queue=1)
    header = encode_header({"latching": "1", "md5sum": STRING.md5sum, "type": STRING.name})
    connections: list[ByteWriter] = []

    async def serve(reader: asyncio.StreamReader, writer: ByteWriter) -> None:
        await read_header(reader, 10)
        writer.write(header)
        connections.append(writer)

    world.network.servers[talker.tcpros] = serve
    received: list[Body] = []
    await listener.subscribe(publication.topic, lambda body, _header: received.append(body))
    await later()
    first, *rest = sent.split()
    before = first if first.startswith("0") else ""
    if before:
        connections[0].write(encode_frame(before[1:].encode()))
        await later()
        received.clear()
    listener.repeat("/map", lambda body, _header: received.append(body))
    await later()
    for step in rest if before else sent.split():
        connections[int(step[0])].write(encode_frame(step[1:].encode()))
        await later()
    assert b"".join(received).decode() == heard
    for writer in connections:
        writer.close()


async def test_a_node_hears_its_own_topic_without_a_connection(world: Nodes) -> None:
    node = await world.node("10.0.0.2")
    heard: list[tuple[str, Body, str]] = []

    def hear(body: Body, header: Any) -> None:
        heard.append((header["topic"], body, header["type"]))

    await node.subscribe("/chatter", hear)
    await node.subscribe("/other", hear, MessageType("std_msgs/Bool", "8b94c1b53db61fb6aed406028ad6332a", ""))
    for topic in ("/map", "/chatter", "/other"):
        publisher = await node.advertise(topic, STRING, latched=topic == "/map", queue=1)
        await later()
        publisher.publish(b"one")
    await node.subscribe("/map", hear)
    await later()
    assert heard == [("/chatter", b"one", "std_msgs/String"), ("/map", b"one", "std_msgs/String")]
    assert {host for source, (host, _port) in world.network.connections if source == "10.0.0.2"} == {
        "10.0.0.1"
    }


@pytest.mark.parametrize(("wait", "heard"), [(0.5, [b"early", b"next"]), (1.5, [])])
async def test_early_messages_are_replayed_only_for_a_while(
    world: Nodes, wait: float, heard: list[Body]
) -> None:
    talker, listener = await world.node("10.0.0.2"), await world.node("10.0.0.3")
    publisher = await talker.advertise("/cmd_vel", STRING, latched=False, queue=2, replay=1)
    for body in (b"dropped", b"early", b"next"):
        publisher.publish(body)
    await later(wait)
    got: list[Body] = []
    await listener.subscribe("/cmd_vel", lambda body, _header: got.append(body))
    await later()
    assert got == heard


async def test_early_messages_take_no_memory_after_the_replay(world: Nodes) -> None:
    talker = await world.node("10.0.0.2")
    publisher = await talker.advertise("/image", STRING, latched=False, queue=100, replay=1)
    tracemalloc.start()
    for _ in range(9):
        publisher.publish(bytes(100_000))
    await later(1.5)
    taken, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert taken < 300_000
    assert peak > 900_000


async def test_a_slow_subscriber_loses_the_oldest_messages(world: Nodes) -> None:
    talker, listener = await world.node("10.0.0.2"), await world.node("10.0.0.3")
    heard: list[Body] = []
    await listener.subscribe("/image", lambda body, _header: heard.append(body))
    publisher = await talker.advertise("/image", STRING, latched=False, queue=4)
    await later()
    _reader, stuck = world.network.connect("10.0.0.4", talker.tcpros)
    stuck.write(encode_header({"topic": "/image", "md5sum": "*", "type": "*", "callerid": "/stuck"}))
    await later()
    assert sorted(publisher.subscribers) == ["/node_3", "/stuck"]
    for number in range(20):
        publisher.publish(bytes([number]) * 50_000)
        await later(0.1)
    assert [body[0] for body in heard] == [*range(20)]
    assert publisher.dropped == 20 - 4 - 3  # three went to the buffer of the connection
    stuck.close()
    await later()
    assert publisher.subscribers == ["/node_3"]


async def test_queues_share_one_memory_and_a_stalled_subscriber_costs_no_other_a_message(
    world: Nodes,
) -> None:
    memory = OwnMemory(1 << 20)
    talker, listener = await world.node("10.0.0.2", memory), await world.node("10.0.0.3")
    publisher = await talker.advertise("/image", STRING, latched=False, queue=1000)
    heard: list[Body] = []
    await listener.subscribe("/image", lambda body, _header: heard.append(body))
    stalled = [world.network.connect("10.0.0.4", talker.tcpros) for _number in range(5)]
    for _reader, writer in stalled:
        writer.write(encode_header({"topic": "/image", "md5sum": "*", "callerid": "/stalled"}))
    await later()
    for number in range(100):
        publisher.publish(b"%03d" % number + bytes(100_000))
        await later()
        assert memory.held <= 1 << 20
    assert [int(body[:3]) for body in heard] == [*range(100)]
    assert memory.held > 900_000 and publisher.dropped > 400
    for _reader, writer in stalled:
        writer.close()
    await later()
    assert memory.held == 0


async def test_a_latched_message_without_memory_is_an_error_in_words(world: Nodes) -> None:
    talker, listener = await world.node("10.0.0.2", OwnMemory(200_000)), await world.node("10.0.0.3")
    first = await talker.advertise("/map", STRING, latched=True, queue=1)
    second = await talker.advertise("/other", STRING, latched=True, queue=1)
    heard: list[int] = []
    await listener.subscribe("/other", lambda body, _header: heard.append(len(body)))
    await later()
    first.publish(bytes(60_000))
    second.publish(bytes(30_000))
    await later()
    with pytest.raises(LimitExceededError, match="no memory to keep a latched message of 150004 bytes"):
        second.publish(bytes(150_000))
    await talker.unadvertise("/map")
    second.publish(bytes(80_000))
    await later()
    assert heard == [30_000, 80_000]


async def test_a_subscriber_connects_again_after_the_publisher_breaks_off(world: Nodes) -> None:
    talker, listener = await world.node("10.0.0.2"), await world.node("10.0.0.3")
    heard: list[Body] = []
    subscriber = await listener.subscribe("/chatter", lambda body, _header: heard.append(body))
    publisher = await talker.advertise("/chatter", STRING, latched=True, queue=1)
    publisher.publish(b"once")
    await later()
    world.network.break_off(talker.tcpros)
    await later()
    assert heard == [b"once", b"once"]
    assert subscriber.problems == {}


async def test_an_unreachable_publisher_is_a_problem_in_words_and_is_tried_ever_less_often(
    world: Nodes,
) -> None:
    listener = await world.node("10.0.0.3")
    world.master.publishers["/chatter"] = ["http://10.0.0.9:1/", "nonsense"]
    subscriber = await listener.subscribe("/chatter", lambda _body, _header: None)
    await later(60)
    assert subscriber.problems["http://10.0.0.9:1/"] == (
        "http://10.0.0.9:1/ cannot be called: Connection refused"
    )
    assert "has no scheme" in subscriber.problems["nonsense"]
    await world.master.call(listener.uri, "publisherUpdate", "/chatter", [])
    assert subscriber.problems == {}


async def test_an_update_that_overtakes_the_answer_of_the_master_is_kept(world: Nodes) -> None:
    talker, listener = await world.node("10.0.0.2"), await world.node("10.0.0.3")
    publisher = await talker.advertise("/chatter", STRING, latched=True, queue=1)
    publisher.publish(b"heard")

    async def overtake(call: MethodCall) -> None:
        if call.method == "registerSubscriber":
            await world.master.call(listener.uri, "publisherUpdate", "/chatter", [talker.uri])
            world.master.publishers["/chatter"].remove(talker.uri)  # the answer is older than the update

    world.master.before_answer = overtake
    heard: list[Body] = []
    await listener.subscribe("/chatter", lambda body, _header: heard.append(body))
    await later()
    assert heard == [b"heard"]
    world.master.publishers["/chatter"].append(talker.uri)


@pytest.mark.parametrize("method", ["registerSubscriber", "registerPublisher", "registerService"])
async def test_a_denied_registration_has_the_words_of_the_master_and_leaves_nothing(
    world: Nodes, method: str
) -> None:
    node = await world.node("10.0.0.2")
    world.master.denials[method] = "denied by [Publishers] /chatter (site.ini:14)"
    with pytest.raises(MasterDenialError, match=r"denied by \[Publishers\] /chatter \(site.ini:14\)"):
        if method == "registerSubscriber":
            await node.subscribe("/chatter", lambda _body, _header: None)
        elif method == "registerPublisher":
            await node.advertise("/chatter", STRING, latched=False, queue=1)
        else:
            await node.offer("/chatter", SET_BOOL, negated)
    assert not (node.subscribers or node.publishers or node.services)


@pytest.mark.parametrize(
    ("status", "body", "error", "words"),
    [
        (
            "200 OK",
            build_fault(-1, "denied by [Publishers] /a"),
            MasterDenialError,
            r"^denied by \[Publishers\] /a$",
        ),
        ("503 Busy", build_fault(503, "too many calls"), MasterDenialError, "^too many calls$"),
        ("404 Not Found", b"<html/>", ProtocolError, "HTTP status 404"),
        ("500 Error", build_response([1, "", 1]), ProtocolError, "HTTP status 500"),
    ],
)
async def test_a_fault_of_the_master_keeps_its_words(
    world: Nodes, status: str, body: bytes, error: type[Exception], words: str
) -> None:
    node = await world.node("10.0.0.2")
    world.master.server.close()

    async def serve(reader: asyncio.StreamReader, writer: ByteWriter) -> None:
        await reader.read(1 << 16)
        writer.write(f"HTTP/1.1 {status}\r\nContent-Length: {len(body)}\r\n\r\n".encode() + body)

    world.network.listen("10.0.0.1", serve, 11311)
    with pytest.raises(error, match=words):
        await node.master("getPid")


async def negated(request: bytes) -> bytes:
    if request == b"\x07":
        raise ServiceFailedError("the arm is blocked")
    return bytes([1 - request[0]]) + b"\x00\x00\x00\x00"


async def test_a_service_answers_or_fails_in_words(world: Nodes) -> None:
    server, client = await world.node("10.0.0.2"), await world.node("10.0.0.3")
    await server.offer("/brake", SET_BOOL, negated)
    assert (await client.probe_service("/brake"))["type"] == "std_srvs/SetBool"
    for md5sum in ("*", SET_BOOL.md5sum):
        assert await client.call_service("/brake", md5sum, b"\x01", 5) == b"\x00\x00\x00\x00\x00"
    with pytest.raises(ServiceFailedError, match="the arm is blocked"):
        await client.call_service("/brake", "*", b"\x07", 5)
    with pytest.raises(ProtocolError, match="has the type std_srvs/SetBool"):
        await client.call_service("/brake", "0" * 32, b"\x01", 5)
    await server.withdraw("/brake")
    with pytest.raises(MasterDenialError, match="no provider"):
        await client.call_service("/brake", "*", b"\x01", 5)


async def test_a_service_that_hangs_ends_after_the_time_limit(world: Nodes) -> None:
    server, client = await world.node("10.0.0.2"), await world.node("10.0.0.3")
    never = asyncio.get_running_loop().create_future()

    async def hang(_request: bytes) -> bytes:
        return bytes(await never)

    await server.offer("/brake", SET_BOOL, hang)
    with pytest.raises(PeerUnreachableError, match="/brake did not answer within 3 s"):
        await client.call_service("/brake", "*", b"\x01", 3)


async def test_a_master_that_is_gone_or_silent_is_an_error_in_words_and_close_still_ends(
    world: Nodes,
) -> None:
    node = await world.node("10.0.0.2")
    await node.advertise("/chatter", STRING, latched=False, queue=1)
    never = asyncio.get_running_loop().create_future()

    async def hang(_call: MethodCall) -> None:
        await never

    world.master.before_answer = hang
    with pytest.raises(PeerUnreachableError, match="did not answer registerPublisher within 10 s"):
        await node.advertise("/other", STRING, latched=False, queue=1)
    before = asyncio.get_running_loop().time()
    await node.close()
    assert asyncio.get_running_loop().time() - before < 3
    never.cancel()
    world.master.server.close()
    with pytest.raises(PeerUnreachableError, match="cannot be called: Connection refused"):
        await node.master("getPid")
    await later(200)


async def test_the_node_api_answers_the_master_and_other_nodes(world: Nodes) -> None:
    talker, listener = await world.node("10.0.0.2"), await world.node("10.0.0.3")
    await talker.advertise("/chatter", STRING, latched=False, queue=1)
    await listener.subscribe("/chatter", lambda _body, _header: None)
    await later()

    async def ask(node: RosNode, method: str, *params: Value) -> Any:
        return await world.master.call(node.uri, method, *params)

    assert (await ask(talker, "getPublications"))[2] == [["/chatter", "std_msgs/String"]]
    assert (await ask(listener, "getSubscriptions"))[2] == [["/chatter", "*"]]
    assert (await ask(talker, "getBusInfo"))[2] == [[1, "/node_3", "o", "TCPROS", "/chatter", True]]
    assert (await ask(listener, "getBusInfo"))[2] == [[1, talker.uri, "i", "TCPROS", "/chatter", True]]
    assert (await ask(talker, "getMasterUri"))[2] == MASTER
    assert (await ask(talker, "requestTopic", "/chatter", [["UDPROS"]]))[0] == 0
    assert (await ask(talker, "requestTopic", "/none", [["TCPROS"]]))[0] == 0
    assert (await ask(talker, "publisherUpdate", "/chatter", []))[0] == 0
    assert (await ask(talker, "requestTopic", 7))[0] == -1
    assert (await ask(talker, "shutdown", "another node has this name"))[0] == 1
    assert world.ends == ["another node has this name"]


@pytest.mark.parametrize(
    "sent",
    [
        b"\xff\xff\xff\xff",  # a header of 4 GB
        b"\x04\x00\x00\x00\x00\x00\x00\x00",  # a field without a name
        encode_header({"callerid": "/x"}),  # neither topic nor service
        encode_header({"topic": "/chatter", "md5sum": "0" * 32, "type": "a/B"}),
        encode_header({"service": "/none", "md5sum": "*"}),
        encode_header({"service": "/brake", "md5sum": "*", "persistent": "1"}) + b"\xff\xff\xff\xff",
        b"",  # silent
    ],
)
async def test_a_peer_that_breaks_the_protocol_is_disconnected(world: Nodes, sent: bytes) -> None:
    node = await world.node("10.0.0.2")
    await node.advertise("/chatter", STRING, latched=False, queue=1)
    await node.offer("/brake", SET_BOOL, negated)
    reader, writer = world.network.connect("10.0.0.9", node.tcpros)
    writer.write(sent)
    async with asyncio.timeout(30):
        answer = await reader.read()
    if sent.startswith(encode_header({"service": "/none"})[:8]) and b"/none" in sent:
        assert "does not offer" in (HeaderParser().feed(answer) or {})["error"]
    assert (await node.probe_service("/brake"))["type"] == "std_srvs/SetBool"


async def test_connections_are_bounded(world: Nodes) -> None:
    node = await world.node("10.0.0.2", connections=8)
    ends = [world.network.connect("10.0.0.9", node.tcpros) for _ in range(20)]
    await later()
    assert sum(not reader.at_eof() for reader, _writer in ends) == 8
    await later(60)  # the silent ones reach the time limit of the header
    assert all(reader.at_eof() for reader, _writer in ends)


@pytest.mark.parametrize(
    "sent",
    [
        b"GET / HTTP/1.1\r\n\r\n",
        b"POST / HTTP/1.1\r\nContent-Length: 99999999\r\n\r\n" + b"x" * 2_000_000,
        b"\x16\x03\x01",
        b"POST / HTTP/1.1\r\nContent-Length: 3\r\n\r\nabc",
        b"",
    ],
)
async def test_a_client_of_the_node_api_that_sends_nonsense_gets_an_end(world: Nodes, sent: bytes) -> None:
    node = await world.node("10.0.0.2")
    address = parse_node_uri(node.uri)
    reader, writer = world.network.connect("10.0.0.9", (address.host, address.port))
    writer.write(sent)
    async with asyncio.timeout(300):
        answer = await reader.read()
    assert answer == b"" or b"<fault>" in answer
