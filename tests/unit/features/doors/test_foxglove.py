import asyncio
import json
import struct
from typing import Any

import pytest

from appliance.features.doors.client_frames import content, is_text
from appliance.features.doors.client_requests import (
    DoorRequest,
    PublishMessage,
    SubscribeTopic,
    UnsubscribeTopic,
)
from appliance.features.doors.foxglove import SUBPROTOCOLS, Foxglove, FoxgloveLimits
from appliance.features.doors.quotas import DOOR_BYTES
from appliance.features.doors.surroundings import DoorSurroundings, SeenTopic, VisibleGraph
from appliance.features.doors.viewer_queue import ViewerQueue
from roswire.definitions import Definitions
from roswire.node import MessageType, RosNode, ServiceFailedError, ServiceType
from roswire.standard import standard_definitions
from roswire.tcpros import Body
from roswire.xmlrpc import MethodCall, Value
from tests.support.features.doors.door_world import DoorWorld, WebSocketClient, door_world

pytestmark = pytest.mark.anyio
OWN = Definitions.from_files({"own/Load.msg": "geometry_msgs/Point32 at\nfloat32 weight"})


async def next_op(client: WebSocketClient, op: str) -> Any:
    while True:
        frame = await client.next()
        if isinstance(frame, dict) and frame["op"] == op:
            return frame


def sees(
    world: DoorWorld, *, topics: dict[str, tuple[str, str]], services: dict[str, str] | None = None
) -> None:
    world.master.answers["getSystemState"] = [
        [[topic, [node]] for topic, (_kind, node) in topics.items()],
        [["/cmd_vel", ["/base"]]],
        [[service, [node]] for service, node in (services or {}).items()],
    ]
    world.master.answers["getTopicTypes"] = [[topic, kind] for topic, (kind, _node) in topics.items()]


async def publishes(robot: RosNode, topic: str, kind: str, definitions: Definitions) -> Any:
    return await robot.advertise(topic, MessageType.defined(definitions, kind), latched=False, queue=10)


@pytest.mark.parametrize("subprotocol", SUBPROTOCOLS)
async def test_a_viewer_gets_channels_with_definitions_and_the_bytes_of_messages(subprotocol: str) -> None:
    async with door_world() as world:
        robot = await world.robot("10.0.0.3", "/robot")
        definitions = standard_definitions().extended(OWN)
        load = await publishes(robot, "/load", "own/Load", definitions)
        await publishes(robot, "/text", "std_msgs/String", definitions)
        sees(world, topics={"/load": ("own/Load", "/robot"), "/text": ("std_msgs/String", "/robot")})
        client = await world.client(subprotocols=["other", subprotocol])
        assert client.socket.subprotocol == subprotocol
        info = await next_op(client, "serverInfo")
        assert info["capabilities"] == [
            "clientPublish", "parameters", "parametersSubscribe", "services", "connectionGraph",
        ]  # fmt: skip
        channels = {one["topic"]: one for one in (await next_op(client, "advertise"))["channels"]}
        assert channels["/load"]["schema"] == definitions.full_text("own/Load")
        assert (
            channels["/load"]["encoding"] == "ros1" and channels["/text"]["schemaName"] == "std_msgs/String"
        )
        subscription = {"id": 7, "channelId": channels["/load"]["id"]}
        client.send({"op": "subscribe", "subscriptions": [subscription]})
        await asyncio.sleep(1)
        load.publish(b"\x01" * 16)
        frame = await client.next()
        opcode, number, stamp = struct.unpack_from("<BIQ", frame)
        assert (opcode, number, frame[13:]) == (1, 7, b"\x01" * 16) and stamp > 0
        client.send({"op": "unsubscribe", "subscriptionIds": [7]})
        sees(world, topics={"/text": ("std_msgs/String", "/robot")})
        gone = await next_op(client, "unadvertise")
        assert gone["channelIds"] == [channels["/load"]["id"]]


async def test_a_viewer_publishes_bytes_and_json() -> None:
    async with door_world() as world:
        robot = await world.robot("10.0.0.3", "/robot")
        sees(world, topics={})
        heard: list[Body] = []
        await robot.subscribe("/text", lambda body, _header: heard.append(body))
        client = await world.client(subprotocols=SUBPROTOCOLS)
        for number, encoding in ((1, "ros1"), (2, "json")):
            channel = {"id": number, "topic": "/text", "encoding": encoding, "schemaName": "std_msgs/String"}
            client.send({"op": "advertise", "channels": [channel]})
        await asyncio.sleep(1)
        client.send(struct.pack("<BI", 1, 1) + b"\x02\0\0\0hi")
        client.send(struct.pack("<BI", 1, 2) + b'{"data":"hi"}')
        client.send(struct.pack("<BI", 1, 2) + b'{"datum":"hi"}')
        assert "unknown field `datum`" in (await next_op(client, "status"))["message"]
        assert heard == [b"\x02\0\0\0hi"] * 2
        client.send({"op": "unadvertise", "channelIds": [1, 2]})
        await asyncio.sleep(15)
        assert world.master.publishers["/text"] == []


async def test_a_refusal_drops_no_other_topic_of_the_frame() -> None:
    async with door_world() as world:
        sees(world, topics={})
        client = await world.client(subprotocols=SUBPROTOCOLS)
        types = {"/a": "own/Unknown", "/b": "std_msgs/String", "/not a name": "std_msgs/String"}
        channels = [
            {"id": number, "topic": topic, "encoding": "ros1", "schemaName": kind}
            for number, (topic, kind) in enumerate(types.items())
        ]
        client.send({"op": "advertise", "channels": channels})
        assert "character 5 is ' '" in (await next_op(client, "status"))["message"]
        assert "does not know this message type" in (await next_op(client, "status"))["message"]
        await asyncio.sleep(1)
        assert [*world.master.publishers] == ["/b"]


async def test_a_topic_appears_once_the_policy_allows_it_and_its_publisher_answers() -> None:
    async with door_world() as world:
        definitions = standard_definitions().extended(OWN)
        sees(world, topics={"/load": ("own/Load", "/robot")})
        world.master.denials["registerSubscriber"] = "denied by [Subscribers]"
        client = await world.client(subprotocols=SUBPROTOCOLS)
        assert (await next_op(client, "advertise"))["channels"] == []
        await asyncio.sleep(60)
        assert world.master.calls.count("registerSubscriber") == 1
        del world.master.denials["registerSubscriber"]
        world.lookout.policy_changed()
        await asyncio.sleep(30)
        assert client.frames.empty()  # no publisher answers
        await publishes(await world.robot("10.0.0.3", "/robot"), "/load", "own/Load", definitions)
        assert [one["topic"] for one in (await next_op(client, "advertise"))["channels"]] == ["/load"]


async def test_a_denial_of_the_policy_before_is_asked_about_again() -> None:
    async with door_world() as world:
        sees(world, topics={"/load": ("own/Load", "/robot")})
        await publishes(
            await world.robot("10.0.0.3", "/robot"), "/load", "own/Load", standard_definitions().extended(OWN)
        )
        world.master.denials["registerSubscriber"] = "denied by [Subscribers]"

        async def change_policy(call: MethodCall) -> None:
            if call.method == "registerSubscriber":
                world.lookout.policy_changed()

        world.master.before_answer = change_policy
        client = await world.client(subprotocols=SUBPROTOCOLS)
        assert (await next_op(client, "advertise"))["channels"] == []
        del world.master.denials["registerSubscriber"]
        assert [one["topic"] for one in (await next_op(client, "advertise"))["channels"]] == ["/load"]


@pytest.mark.parametrize("value", ["1e999", "12345678901", "null"])
async def test_a_value_that_no_parameter_has_is_refused_in_words(value: str) -> None:
    async with door_world() as world:
        client = await world.client(subprotocols=["foxglove.sdk.v1"])
        client.send('{"op":"setParameters","parameters":[{"name":"/a","value":' + value + "}]}")
        assert (await next_op(client, "status"))["level"] == 2
        assert client.is_open and "setParam" not in world.master.calls


async def test_a_viewer_calls_services_and_reads_parameters() -> None:
    async with door_world() as world:
        robot = await world.robot("10.0.0.3", "/robot")

        async def answer(request: bytes) -> bytes:
            if request == b"\x00":
                raise ServiceFailedError("the arm is blocked")
            return b"\x01\0\0\0\0"

        await robot.offer("/brake", ServiceType.defined(standard_definitions(), "std_srvs/SetBool"), answer)
        sees(world, topics={}, services={"/brake": "/robot", "/gone": "/other"})
        world.master.answers |= {"getParamNames": ["/a"], "hasParam": True, "getParam": [1, 2.5]}
        client = await world.client(subprotocols=SUBPROTOCOLS)
        (service,) = (await next_op(client, "advertiseServices"))["services"]
        assert (service["name"], service["request"]["schema"]) == ("/brake", "bool data")
        for call, request in enumerate((b"\x01", b"\x00")):
            client.send(struct.pack("<BIII", 2, service["id"], call, 4) + b"ros1" + request)
        frame = await client.next()
        assert frame == struct.pack("<BIII", 3, service["id"], 0, 4) + b"ros1" + b"\x01\0\0\0\0"
        failure = await next_op(client, "serviceCallFailure")
        assert failure["callId"] == 1 and failure["message"] == "the arm is blocked"
        client.send({"op": "getParameters", "parameterNames": [], "id": "p"})
        values = await next_op(client, "parameterValues")
        assert values == {
            "op": "parameterValues",
            "id": "p",
            "parameters": [{"name": "/a", "value": [1, 2.5]}],
        }
        world.master.denials["setParam"] = "denied by [Parameters] /a (site.ini:9)"
        client.send({"op": "setParameters", "parameters": [{"name": "/a", "value": 1}], "id": "q"})
        assert (await next_op(client, "status"))["message"] == "denied by [Parameters] /a (site.ini:9)"


async def test_a_stop_does_not_wait_for_reads_of_parameters() -> None:
    async with door_world() as world:
        sees(world, topics={})
        robot, client = await world.robot("10.0.0.3", "/robot"), await world.client(subprotocols=SUBPROTOCOLS)
        heard: list[Body] = []
        await robot.subscribe("/cmd", lambda body, _header: heard.append(body))
        channel = {"id": 7, "topic": "/cmd", "encoding": "ros1", "schemaName": "std_msgs/Bool"}
        client.send({"op": "advertise", "channels": [channel]})
        await asyncio.sleep(1)
        names: list[Any] = [f"/p{number}" for number in range(300)]
        world.master.answers |= {"getParamNames": names, "hasParam": True, "getParam": 1}
        world.master.before_answer = lambda _call: asyncio.sleep(0.01)
        for number in range(9):
            client.send({"op": "getParameters", "parameterNames": [], "id": str(number)})
        client.send(struct.pack("<BI", 1, 7) + b"\0")
        await asyncio.sleep(0.1)
        assert heard == [b"\0"]
        assert "8 reads of parameters wait" in (await next_op(client, "status"))["message"]
        for number in range(8):
            assert (await next_op(client, "parameterValues"))["id"] == str(number)
        client.send({"op": "getParameters", "parameterNames": [], "id": "left"})
        await asyncio.sleep(0.1)
        client.writer.close()
        await asyncio.sleep(20)
        world.master.before_answer = None


async def test_names_of_parameters_whose_reads_wait_are_bounded() -> None:
    async with door_world() as world:
        sees(world, topics={})
        client = await world.client(subprotocols=SUBPROTOCOLS)
        world.master.answers |= {"hasParam": True, "getParam": 1}
        world.master.before_answer = lambda _call: asyncio.sleep(0.01)
        for number in range(3):
            names = [f"/{'x' * 1000}{one}" for one in range(1000)]
            client.send({"op": "getParameters", "parameterNames": names, "id": str(number)})
        await asyncio.sleep(1)
        assert world.calls.held > 3_000_000
        client.send({"op": "getParameters", "parameterNames": ["/a"] * 1001})
        assert "1001 parameters; name at most 1000" in (await next_op(client, "status"))["message"]
        world.calls.add(DOOR_BYTES.bounds.host)
        client.send({"op": "getParameters", "parameterNames": ["/a"]})
        assert "too many calls of this door wait" in (await next_op(client, "status"))["message"]
        world.calls.add(-DOOR_BYTES.bounds.host)
        for number in range(3):
            assert (await next_op(client, "parameterValues"))["id"] == str(number)
        assert world.calls.held == 0
        world.master.before_answer = None


async def test_a_viewer_follows_parameters_until_it_leaves() -> None:
    async with door_world() as world:
        sees(world, topics={})
        first, second = [await world.client(subprotocols=SUBPROTOCOLS) for _ in range(2)]
        for client in (first, second):
            client.send({"op": "subscribeParameterUpdates", "parameterNames": ["a", "/robot"]})
        await asyncio.sleep(1)
        assert world.master.calls.count("subscribeParam") == 2
        long = "x" * 100_000  # as a description of a robot
        for key, value in (("/a/", 1), ("/robot/model/", long), ("/robots/", 2), ("/a/", {})):
            await world.master.call(world.node.uri, "paramUpdate", key, value)
        rows = [(await next_op(first, "parameterValues"))["parameters"] for _ in range(3)]
        assert [row for (row,) in rows if row["name"] == "/a"] == [{"name": "/a", "value": 1}, {"name": "/a"}]
        assert [row for (row,) in rows if row["name"] != "/a"] == [{"name": "/robot/model", "value": long}]
        first.send({"op": "unsubscribeParameterUpdates", "parameterNames": []})
        await asyncio.sleep(1)
        assert "unsubscribeParam" not in world.master.calls
        second.send({"op": "unsubscribeParameterUpdates", "parameterNames": ["/a"]})
        await asyncio.sleep(1)
        assert world.master.calls.count("unsubscribeParam") == 1
        second.writer.close()
        await asyncio.sleep(5)
        assert world.master.calls.count("unsubscribeParam") == 2 and not world.node.parameters
        world.master.denials["subscribeParam"] = "denied by [Parameters] /a (site.ini:9)"
        first.send({"op": "subscribeParameterUpdates", "parameterNames": []})
        assert "site.ini:9" in (await next_op(first, "status"))["message"]
        assert not world.node.parameters


async def test_a_viewer_follows_the_graph() -> None:
    async with door_world() as world:
        sees(world, topics={"/text": ("std_msgs/String", "/robot")}, services={"/gone": "/other"})
        client = await world.client(subprotocols=SUBPROTOCOLS)
        client.send({"op": "subscribeConnectionGraph"})
        update = await next_op(client, "connectionGraphUpdate")
        assert update["publishedTopics"] == [{"name": "/text", "publisherIds": ["/robot"]}]
        assert update["subscribedTopics"] == [{"name": "/cmd_vel", "subscriberIds": ["/base"]}]
        assert update["advertisedServices"] == [{"name": "/gone", "providerIds": ["/other"]}]
        sees(world, topics={"/text": ("std_msgs/String", "/other")})
        update = await next_op(client, "connectionGraphUpdate")
        assert update["publishedTopics"] == [{"name": "/text", "publisherIds": ["/other"]}]
        assert update["removedServices"] == ["/gone"] and update["subscribedTopics"] == []
        client.send({"op": "unsubscribeConnectionGraph"})
        sees(world, topics={})
        await asyncio.sleep(10)
        assert "connectionGraphUpdate" not in [
            client.frames.get_nowait()["op"] for _ in range(client.frames.qsize())
        ]


async def test_a_denied_look_is_one_status_in_words() -> None:
    async with door_world() as world:
        world.master.denials["getSystemState"] = "denied by [Commands] getSystemState (site.ini:4)"
        client = await world.client(subprotocols=SUBPROTOCOLS)
        await asyncio.sleep(60)
        frames = [client.frames.get_nowait() for _ in range(client.frames.qsize())]
        assert [frame["op"] for frame in frames] == ["serverInfo", "status", "advertise"]
        assert frames[1]["level"] == 2 and "site.ini:4" in frames[1]["message"]


def received(foxglove: Foxglove, frame: str | bytes) -> list[DoorRequest]:
    data = frame if isinstance(frame, bytes) else frame.encode()
    return foxglove.receive(data, is_text=isinstance(frame, str))


def text_frame(foxglove: Foxglove) -> str | None:
    frame = foxglove.next_frame(0.0)
    assert frame is None or is_text(frame)
    return None if frame is None else content(frame).decode()


def viewer(**limits: int) -> tuple[Foxglove, ViewerQueue[int | str]]:
    queue: ViewerQueue[int | str] = ViewerQueue()
    foxglove = Foxglove("/door_alice", FoxgloveLimits(**limits), queue)
    graph = VisibleGraph({"/t": ["/n"]}, {}, {}, {"/t": "a/B"})
    foxglove.surroundings(DoorSurroundings(graph, [SeenTopic("/t", "a/B", "int8 x", "md5", "sha")], []))
    while foxglove.next_frame(0.0) is not None:
        pass
    return foxglove, queue


@pytest.mark.parametrize(
    ("frame", "words"),
    [
        ("{", "rejected"),
        ("[]", "Expected `object`"),
        ("[" * 100_000, "rejected"),
        ('{"op":"nonsense"}', "Invalid value 'nonsense'"),
        ('{"op":"subscribe","subscriptions":[{"id":-1,"channelId":1}]}', ">= 0"),
        ('{"op":"subscribe","subscriptions":[{"id":1e99,"channelId":1}]}', "rejected"),
        ('{"op":"subscribe","subscriptions":[{"id":4294967296,"channelId":1}]}', "<= 4294967295"),
        ('{"op":"subscribe","subscriptions":[{"id":1,"channelId":9}]}', "the channel 9 is not announced"),
        (
            '{"op":"advertise","channels":[{"id":1,"topic":"/a","encoding":"cdr","schemaName":"a/B"}]}',
            "'cdr'",
        ),
        (
            '{"op":"advertise","channels":[{"id":1,"topic":" /a","encoding":"ros1","schemaName":"a/B"}]}',
            "' /a'",
        ),
        ('{"op":"subscribeParameterUpdates","parameterNames":["/a b "]}', "rejected"),
        (b"", "begins with nothing"),
        (b"\x01\x01", "a binary frame of 2 bytes"),
        (b"\x07" + bytes(20), "begins with 07"),
        (b"\x01" + b"\xff" * 4, "the channel 4294967295 is not advertised"),
    ],
)
def test_a_frame_that_breaks_the_protocol_is_refused(frame: str | bytes, words: str) -> None:
    foxglove, _queue = viewer()
    assert received(foxglove, frame) == []
    answer = json.loads(text_frame(foxglove) or "")
    assert answer["op"] == "status" and answer["level"] == 2 and words in answer["message"]


@pytest.mark.parametrize("service", [1, 4_294_967_295])
def test_a_call_of_an_unknown_service_fails_in_words(service: int) -> None:
    foxglove, _queue = viewer()
    assert received(foxglove, struct.pack("<BIII", 2, service, 3, 0xFFFFFFFF)) == []
    answer = json.loads(text_frame(foxglove) or "")
    assert (
        answer["op"] == "serviceCallFailure"
        and answer["callId"] == 3
        and "not announced" in answer["message"]
    )


def test_an_asset_is_an_error_at_once() -> None:
    foxglove, _queue = viewer()
    received(foxglove, '{"op":"fetchAsset","uri":"package://x/y.stl","requestId":5}')
    frame = foxglove.next_frame(0.0)
    assert frame == b"\x82\x21" + struct.pack("<BIBI", 4, 5, 1, 23) + b"this door has no assets"


def test_a_subscription_ends_with_its_channel() -> None:
    foxglove, _queue = viewer()
    subscribe = '{"op":"subscribe","subscriptions":[{"id":5,"channelId":%d}]}'
    assert received(foxglove, subscribe % 1) == [SubscribeTopic("/t", "a/B")]
    gone = DoorSurroundings(
        VisibleGraph({}, {}, {}, {}), [SeenTopic("/t", "a/C", "int8 y", "md5", "sha")], []
    )
    assert foxglove.surroundings(gone) == [UnsubscribeTopic("/t")]
    assert received(foxglove, '{"op":"unsubscribe","subscriptionIds":[5]}') == []
    assert received(foxglove, subscribe % 2) == [SubscribeTopic("/t", "a/C")]


def test_a_channel_that_comes_back_has_a_new_number() -> None:
    foxglove, _queue = viewer()
    announced = []
    for number in range(100):
        seen = [SeenTopic(f"/t{number % 2}", "a/B", "int8 x", "md5", "sha")]
        foxglove.surroundings(DoorSurroundings(VisibleGraph({}, {}, {}, {}), seen, []))
        while (frame := text_frame(foxglove)) is not None:
            announced += [one["id"] for one in json.loads(frame).get("channels", ())]
    assert announced == [*range(2, 102)]


def test_subscriptions_and_channels_are_bounded() -> None:
    foxglove, queue = viewer(subscriptions=3, channels=2)
    many = [{"id": number, "channelId": 1} for number in range(1000)]
    assert len(received(foxglove, json.dumps({"op": "subscribe", "subscriptions": many}))) == 3
    channels = [
        {"id": one, "topic": f"/c{one}", "encoding": "ros1", "schemaName": "a/B"} for one in range(1000)
    ]
    assert len(received(foxglove, json.dumps({"op": "advertise", "channels": channels}))) == 2
    (publish,) = received(foxglove, b"\x01\x01\0\0\0abc")
    assert publish == PublishMessage("/c1", b"abc")
    foxglove.failed(SubscribeTopic("/t", "a/B"), "denied by [Subscribers] /t (site.ini:7)")
    assert len(received(foxglove, json.dumps({"op": "subscribe", "subscriptions": many[:3]}))) == 3
    assert queue.dropped == 0


async def test_a_read_of_many_parameters_gives_those_that_the_door_may_read() -> None:
    async with door_world() as world:
        sees(world, topics={})
        client = await world.client(subprotocols=SUBPROTOCOLS)
        world.master.answers |= {"hasParam": True}
        answer = world.master.answer

        async def denies(call: MethodCall) -> Value:
            if call.method == "getParam" and str(call.params[1]).startswith("/secret"):
                return [-1, f"denied by [Parameters] (site.ini:9): {call.params[1]!s}", 0]
            return [1, "", 5] if call.method == "getParam" else await answer(call)

        world.master.answer = denies  # type: ignore[method-assign]  # the master of the test
        names = ["/secret/a", "/speed", "/secret/b"]
        client.send({"op": "getParameters", "parameterNames": names, "id": "x"})
        assert (await next_op(client, "parameterValues"))["parameters"] == [{"name": "/speed", "value": 5}]
        words = (await next_op(client, "status"))["message"]
        assert words == "denied by [Parameters] (site.ini:9): /secret/a; and 1 other parameter"
        client.send({"op": "getParameters", "parameterNames": ["/secret/a"], "id": "y"})
        assert "site.ini:9" in (await next_op(client, "status"))["message"]
        await asyncio.sleep(1)
        frames = [client.frames.get_nowait() for _ in range(client.frames.qsize())]
        assert all("parameterValues" not in str(frame) for frame in frames)


async def test_a_held_channel_gets_through_after_the_operators_yes() -> None:
    """A viewer advertises once."""
    async with door_world() as world:
        robot = await world.robot("10.0.0.3", "/robot")
        sees(world, topics={})
        heard: list[Body] = []
        await robot.subscribe("/text", lambda body, _header: heard.append(body))
        client = await world.client(subprotocols=SUBPROTOCOLS)
        world.master.denials["registerPublisher"] = "held for approval 17; ask the operator, then repeat"
        channel = {"id": 1, "topic": "/text", "encoding": "json", "schemaName": "std_msgs/String"}
        client.send({"op": "advertise", "channels": [channel]})
        for _message in range(100):
            client.send(struct.pack("<BI", 1, 1) + b'{"data":"no"}')
            await asyncio.sleep(0.1)
        assert "held for approval 17" in (await next_op(client, "status"))["message"]
        assert world.master.calls.count("registerPublisher") <= 12
        del world.master.denials["registerPublisher"]
        await asyncio.sleep(2)
        client.send(struct.pack("<BI", 1, 1) + b'{"data":"hi"}')
        await asyncio.sleep(1)
        assert heard == [b"\x02\0\0\0hi"]
        client.send({"op": "unadvertise", "channelIds": [1]})
        client.send(struct.pack("<BI", 1, 1) + b'{"data":"hi"}')
        while "channel 1 is not advertised" not in (await next_op(client, "status"))["message"]:
            pass
