import json
import struct
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cbor2
import pytest

from appliance.features.doors.client_frames import content, is_text
from appliance.features.doors.client_requests import (
    AdvertiseTopic,
    AnswerCall,
    CallOfService,
    DoorRequest,
    OfferService,
    PublishMessage,
    SubscribeTopic,
    UnadvertiseTopic,
    UnsubscribeTopic,
    WithdrawService,
)
from appliance.features.doors.door_memory import DoorMemory
from appliance.features.doors.known_types import DoorMessage, KnownTypes
from appliance.features.doors.rosbridge import Rosbridge, RosbridgeLimits
from appliance.features.doors.values import ValueLimits
from appliance.features.doors.viewer_queue import ViewerQueue, ViewerStalledError
from roswire.definitions import Definitions

STRING = KnownTypes(Definitions.from_files({"std_msgs/String.msg": "string data"}), ValueLimits()).message(
    "std_msgs/String"
)


class Client:
    def __init__(self, **limits: Any) -> None:
        self.queue: ViewerQueue[str] = ViewerQueue(message_bytes=100_000, reply_bytes=100_000)
        self.rosbridge = Rosbridge("/door_alice", RosbridgeLimits(**limits), self.queue)
        self.now = 100.0

    def sends(self, frame: str | bytes | dict[str, Any]) -> list[DoorRequest]:
        if isinstance(frame, bytes):
            return self.rosbridge.receive(frame, is_text=False)
        text = json.dumps(frame) if isinstance(frame, dict) else frame
        return self.rosbridge.receive(text.encode(), is_text=True)

    def refusal(self, frame: str | bytes | dict[str, Any]) -> dict[str, Any]:
        assert self.sends(frame) == []
        (status,) = self.gets()
        assert status["op"] == "status" and status["level"] == "error"
        return dict(status)

    def gets(self) -> list[Any]:
        frames = []
        while (frame := self.rosbridge.next_frame(self.now)) is not None:
            frames.append(json.loads(content(frame)) if is_text(frame) else cbor2.loads(content(frame)))
        return frames

    def hears(self, text: str, topic: str = "/chatter") -> None:
        data = text.encode()
        body = struct.pack("<I", len(data)) + data
        self.rosbridge.message(DoorMessage(topic, body, {}, 7_000_000_005, lambda _header: STRING), self.now)


@pytest.fixture
def client() -> Client:
    return Client()


def values(request: DoorRequest) -> Any:
    assert isinstance(request, PublishMessage | CallOfService | AnswerCall)
    return json.loads(bytes(request.values))


def test_topics_are_advertised_once_for_each_id_and_end_with_the_last(client: Client) -> None:
    advertise = {
        "op": "advertise",
        "topic": "cmd_vel",
        "type": "geometry_msgs/Twist",
        "latch": True,
        "queue_size": 3,
    }
    assert client.sends(advertise | {"id": "a"}) == [
        AdvertiseTopic("/cmd_vel", "geometry_msgs/Twist", latched=True, queue=3, reply_to="a")
    ]
    assert client.sends(advertise | {"id": 2})[0].reply_to == 2
    assert client.sends({"op": "unadvertise", "topic": "/cmd_vel", "id": "a"}) == []
    assert client.sends({"op": "unadvertise", "topic": "/cmd_vel", "id": 2}) == [
        UnadvertiseTopic("/cmd_vel", 2)
    ]
    assert client.sends({"op": "unadvertise", "topic": "/cmd_vel"}) == []


@pytest.mark.parametrize("spelling", ["/cmd_vel", "cmd_vel", "//cmd_vel/", "/cmd_vel/"])
def test_every_spelling_is_the_same_topic_to_the_node(client: Client, spelling: str) -> None:
    publish = {"op": "publish", "topic": spelling, "msg": {"data": "x"}}
    first, second = client.sends(publish)
    assert first == AdvertiseTopic("/cmd_vel", None)
    assert (
        isinstance(second, PublishMessage) and second.topic == "/cmd_vel" and values(second) == {"data": "x"}
    )
    assert len(client.sends(publish)) == 1


@pytest.mark.parametrize(
    "spelling", ["std_msgs//String", "//std_msgs/String", "/std_msgs//String/", "std_msgs/String//"]
)
def test_slashes_around_the_parts_of_a_type_do_not_count(client: Client, spelling: str) -> None:
    for operation, name, made in (
        ("advertise", "topic", AdvertiseTopic),
        ("subscribe", "topic", SubscribeTopic),
        ("advertise_service", "service", OfferService),
    ):
        [request] = client.sends({"op": operation, name: "/x", "type": spelling})
        assert isinstance(request, made) and request.type == "std_msgs/String"


@pytest.mark.parametrize(
    "kind", ["", "/", "//", "bad", "not/better/still", "better/", "/better", "this\\isbad", "string"]
)
@pytest.mark.parametrize("operation", ["advertise", "subscribe", "advertise_service"])
def test_a_type_without_two_parts_is_refused_in_words(client: Client, operation: str, kind: str) -> None:
    status = client.refusal({"op": operation, "topic": "/x", "service": "/x", "type": kind, "id": 5})
    assert "is not a type; write PACKAGE/NAME" in status["msg"] and status["id"] == 5


@pytest.mark.parametrize("operation", ["advertise", "subscribe"])
def test_a_second_type_of_a_topic_is_refused_and_the_first_one_stays(client: Client, operation: str) -> None:
    assert client.sends({"op": operation, "topic": "/chatter", "type": "std_msgs/String", "id": 1})
    status = client.refusal({"op": operation, "topic": "/chatter", "type": "std_msgs/Int32", "id": 2})
    assert (
        f"/chatter is {operation.removesuffix('e')}ed as std_msgs/String, not std_msgs/Int32" in status["msg"]
    )
    assert client.sends({"op": f"un{operation}", "topic": "/chatter", "id": 2}) == []
    assert client.sends({"op": f"un{operation}", "topic": "/chatter", "id": 1})


@pytest.mark.parametrize("spelling", [" /cmd_vel", "/cmd_vel ", "/cmd\u200bvel", "/cmd-vel", "", "/", "/a\n"])
def test_a_name_that_no_topic_has_is_refused_in_words(client: Client, spelling: str) -> None:
    assert client.refusal({"op": "publish", "topic": spelling, "msg": {}, "id": 5})["id"] == 5


def test_a_refusal_has_the_id_and_once_none_for_programs_that_see_only_such(client: Client) -> None:
    reason = "denied by [Publishers] /t (site.ini:14)"
    for number in ("p1", "p2"):
        advertise, publish = client.sends({"op": "publish", "topic": "/t", "msg": {}, "id": number})
        client.rosbridge.failed(advertise, reason)
        with_id = {"op": "status", "level": "error", "msg": reason, "id": number}
        plain = {"op": "status", "level": "error", "msg": reason}
        assert client.gets() == ([with_id, plain] if number == "p1" else [with_id])
        assert isinstance(publish, PublishMessage) and publish.reply_to == number
    client.rosbridge.failed(advertise, reason.replace("14", "15"))  # a number is not another reason
    assert [one.get("id") for one in client.gets()] == ["p2"]
    client.rosbridge.failed(advertise, "an operator refused approval 17; ask again in 90 s")
    assert [one.get("id") for one in client.gets()] == ["p2", None]


def test_a_message_repeats_the_refused_advertisement_with_its_type_and_will(client: Client) -> None:
    """roslib and roslibpy advertise once, and an operator may approve it later."""
    fields = {"topic": "/t", "type": "std_msgs/String", "latch": True, "will": {"data": "stop"}}
    [advertise] = client.sends({"op": "advertise", "id": "a", **fields})
    assert isinstance(advertise, AdvertiseTopic)
    for number in range(3):
        client.rosbridge.failed(advertise, "held for approval 17; ask the operator, then repeat")
        again, publish = client.sends({"op": "publish", "topic": "/t", "msg": {}, "id": number})
        assert again == replace(advertise, reply_to=number, repeated=True)
        assert isinstance(publish, PublishMessage)
    [only] = client.sends({"op": "publish", "topic": "/t", "msg": {}})  # it was not refused
    assert isinstance(only, PublishMessage)
    client.rosbridge.failed(advertise, "denied")
    [other] = client.sends({"op": "advertise", "topic": "/t", "type": "std_msgs/Int8"})
    assert isinstance(other, AdvertiseTopic) and other.type == "std_msgs/Int8"
    client.rosbridge.failed(other, "denied")
    assert client.sends({"op": "unadvertise", "topic": "/t"})
    [first, _publish] = client.sends({"op": "publish", "topic": "/t", "msg": {}})
    assert first == AdvertiseTopic("/t", None)


@pytest.mark.parametrize(
    ("wish", "seconds"),
    [(None, 60), (0, 60), (-5, 60), (2.5, 2.5), (600, 600), (3600, 3600), (86_400, 3600), (1e300, 3600)],
)
def test_a_call_takes_as_long_as_its_client_wishes_up_to_an_hour(
    client: Client, wish: float | None, seconds: float
) -> None:
    [call] = client.sends({"op": "call_service", "service": "/s", "timeout": wish})
    assert isinstance(call, CallOfService) and call.seconds == seconds


def test_messages_have_the_spelling_and_the_compression_of_the_client(client: Client) -> None:
    assert client.sends({"op": "subscribe", "topic": "chatter", "type": "std_msgs/String", "id": "s"}) == [
        SubscribeTopic("/chatter", "std_msgs/String", "s")
    ]
    client.hears("hello")
    client.hears("not this one", "/other")
    assert client.gets() == [{"op": "publish", "topic": "chatter", "msg": {"data": "hello"}}]
    client.sends({"op": "subscribe", "topic": "chatter", "compression": "cbor", "id": 2})
    client.hears("hello")
    assert client.gets() == [{"op": "publish", "topic": "chatter", "msg": {"data": "hello"}}]
    client.sends({"op": "subscribe", "topic": "chatter", "compression": "cbor-raw", "id": 3})
    client.hears("hello")
    raw = {"secs": 7, "nsecs": 5, "bytes": b"\x05\0\0\0hello"}
    assert client.gets() == [{"op": "publish", "topic": "chatter", "msg": raw}]
    assert client.sends({"op": "unsubscribe", "topic": "chatter", "id": 3}) == []
    assert client.sends({"op": "unsubscribe", "topic": "chatter"}) == [UnsubscribeTopic("/chatter")]
    client.hears("hello")
    assert client.gets() == []


def test_png_and_fragments_are_answered_with_json_and_a_warning(client: Client) -> None:
    asked = {"op": "subscribe", "topic": "/chatter", "id": 1, "compression": "png", "fragment_size": 1000}
    assert client.sends(asked) == [SubscribeTopic("/chatter", None, 1)]
    client.hears("hello")
    *warnings, message = client.gets()
    assert message == {"op": "publish", "topic": "/chatter", "msg": {"data": "hello"}}
    assert {(one["op"], one["level"]) for one in warnings} == {("status", "warning")}
    assert [one.get("id") for one in warnings] == [1, None, 1, None]  # roslib shows those without an id
    assert "png is plain JSON" in warnings[0]["msg"] and "fragment_size has no effect" in warnings[2]["msg"]
    client.sends({"op": "subscribe", "topic": "/chatter", "id": 2, "compression": "cbor"})
    client.hears("hello")
    assert client.gets() == [message]


def test_two_spellings_of_a_topic_both_get_its_messages(client: Client) -> None:
    for spelling in ("chatter", "/chatter"):
        client.sends({"op": "subscribe", "topic": spelling})
    client.hears("hello")
    assert sorted(frame["topic"] for frame in client.gets()) == ["/chatter", "chatter"]
    assert client.sends({"op": "unsubscribe", "topic": "chatter"}) == []
    assert client.sends({"op": "unsubscribe", "topic": "/chatter"}) == [UnsubscribeTopic("/chatter")]


def test_a_throttled_topic_drops_early_messages_or_keeps_the_newest(client: Client) -> None:
    client.sends({"op": "subscribe", "topic": "/chatter", "throttle_rate": 1000})
    for number in range(25):
        client.hears(str(number))
        client.now += 0.125
    assert [frame["msg"]["data"] for frame in client.gets()] == ["0", "8", "16", "24"]
    client.sends({"op": "subscribe", "topic": "/chatter", "throttle_rate": 1000, "queue_length": 2})
    client.sends({"op": "unsubscribe", "topic": "/chatter", "id": None})
    client.sends({"op": "subscribe", "topic": "/chatter", "throttle_rate": 1000, "queue_length": 2, "id": 9})
    for number in range(5):
        client.hears(str(number))
    assert [frame["msg"]["data"] for frame in client.gets()] == ["3"]
    assert client.queue.next_time() == client.now + 1
    client.now += 1
    assert [frame["msg"]["data"] for frame in client.gets()] == ["4"]


def test_a_client_that_does_not_read_loses_old_messages_and_no_memory(client: Client) -> None:
    for topic in ("/chatter", "/image"):
        client.sends({"op": "subscribe", "topic": topic, "queue_length": 1000})
    client.hears("small")
    for number in range(50):
        client.hears(f"{number:05}" * 4000, "/image")
    frames = client.gets()
    assert frames[0]["msg"] == {"data": "small"}
    assert [frame["msg"]["data"][:5] for frame in frames[1:]] == ["00046", "00047", "00048", "00049"]
    assert client.queue.dropped == 46


def test_a_burst_of_small_messages_is_kept_and_of_large_ones_the_newest(client: Client) -> None:
    for topic in ("/chatter", "/image"):
        client.sends({"op": "subscribe", "topic": topic})
    for number in range(500):
        client.hears(str(number))
    for number in range(5):
        client.hears(f"{number}" * 30_000, "/image")
    received = [(frame["topic"], frame["msg"]["data"][:3]) for frame in client.gets()]
    assert [text for topic, text in received if topic == "/chatter"] == [*map(str, range(500))]
    assert ("/image", "444") in received


def test_a_client_that_asks_and_does_not_read_is_given_up(client: Client) -> None:
    with pytest.raises(ViewerStalledError, match="more than 100000 bytes of replies"):
        for _ in range(10_000):
            client.sends({"op": "nonsense"})


def test_a_call_is_answered_or_fails_with_a_message(client: Client) -> None:
    (call,) = client.sends({"op": "call_service", "service": "add", "args": {"a": 1}, "id": "c"})
    assert isinstance(call, CallOfService) and call.service == "/add" and values(call) == {"a": 1}
    client.rosbridge.answered(call.call, STRING.codec.json(b"\x01\0\0\0x"))
    (second,) = client.sends({"op": "call_service", "service": "/add", "args": [1, 2]})
    assert values(second) == [1, 2]
    reason = "denied by [Services] /add (site.ini:3)"
    client.rosbridge.failed(second, reason)
    assert client.gets() == [
        {"op": "service_response", "service": "add", "values": {"data": "x"}, "result": True, "id": "c"},
        {
            "op": "service_response",
            "service": "/add",
            "values": {"message": reason, "reason": reason, "successful": False},
            "result": False,
        },
    ]
    (old,) = client.sends({"op": "call_service", "service": "/add#33"})
    assert (old.reply_to, values(old)) == ("33", {})
    assert client.sends({"op": "call_service", "service": "/a dd", "id": 1}) == []
    assert client.gets()[0]["result"] is False


def test_calls_without_an_answer_are_bounded() -> None:
    client = Client(calls=2)
    for _ in range(2):
        assert client.sends({"op": "call_service", "service": "/slow"})
    assert client.sends({"op": "call_service", "service": "/slow"}) == []
    assert "2 calls of this client wait" in client.gets()[0]["values"]["message"]


def test_a_service_of_the_client_gets_calls_and_its_answers_are_matched_by_id(client: Client) -> None:
    offer = {"op": "advertise_service", "service": "brake", "type": "std_srvs/SetBool"}
    assert client.sends(offer) == [OfferService("/brake", "std_srvs/SetBool")]
    call = client.rosbridge.ask("/brake", STRING.codec.json(b"\x01\0\0\0x"))
    (asked,) = client.gets()
    assert asked == {"op": "call_service", "service": "brake", "args": {"data": "x"}, "id": call}
    answer = {"op": "service_response", "service": "brake", "id": call, "values": {"ok": 1}, "result": True}
    (answered,) = client.sends(answer)
    assert isinstance(answered, AnswerCall) and answered.call == call and values(answered) == {"ok": 1}
    assert "no call of '/brake' has this id" in client.refusal(answer | {"service": "/brake"})["msg"]
    assert client.sends({"op": "unadvertise_service", "service": "/brake"}) == [WithdrawService("/brake")]
    assert "does not offer" in client.refusal({"op": "unadvertise_service", "service": "/brake"})["msg"]


def test_cbor_and_binary_json_of_a_client_are_understood(client: Client) -> None:
    for frame in (cbor2.dumps({"op": "subscribe", "topic": "/a"}), b' {"op":"subscribe","topic":"/a"}'):
        assert client.sends(frame) == [SubscribeTopic("/a")]


def test_levels_choose_the_statuses(client: Client) -> None:
    client.rosbridge.status("info", "not this one")
    client.sends({"op": "set_level", "level": "info"})
    client.rosbridge.status("info", "this one")
    client.sends({"op": "set_level", "level": "none"})
    client.rosbridge.status("error", "not this one")
    assert [frame["msg"] for frame in client.gets()] == ["this one"]


@pytest.mark.parametrize(
    ("frame", "words", "reply_to"),
    [
        ("{", "not a rosbridge operation", None),
        ("[]", "not a rosbridge operation", None),
        ("null", "not a rosbridge operation", None),
        ("[" * 200_000, "not a rosbridge operation", None),
        ('{"op":"publish","topic":"/a","msg":' + '{"a":' * 100_000, "maximum recursion depth", None),
        ('{"id":1,"topic":"/a"}', "an operation without `op`", 1),
        ('{"receiver":"/a","msg":{}}', "rosbridge 1.0 is not supported", None),
        ('{"op":"auth","mac":"x","id":"a"}', "unknown operation 'auth'; the operations are advertise", "a"),
        ('{"op":7,"id":1.5}', "unknown operation '7'", 1.5),
        ('{"op":"subscribe","id":"x"}', "subscribe: Object missing required field `topic`", "x"),
        ('{"op":"subscribe","topic":7,"id":"x"}', "Expected `str`, got `int` - at `$.topic`", "x"),
        ('{"op":"subscribe","topic":"/a","compression":"zip"}', "Invalid enum value 'zip'", None),
        ('{"op":"subscribe","topic":"/a","throttle_rate":-1}', ">= 0 - at `$.throttle_rate`", None),
        ('{"op":"subscribe","topic":"/a","throttle_rate":1e99}', "throttle_rate", None),
        ('{"op":"advertise","topic":"/a","type":"b/C","queue_size":9999999}', "<= 1000000", None),
        ('{"op":"subscribe","topic":"/' + "a" * 1_000_000 + '"}', "length <= 1024 - at `$.topic`", None),
        (
            '{"op":"subscribe","topic":"/a","id":"' + "a" * 1_000_000 + '"}',
            "length <= 1024 - at `$.id`",
            None,
        ),
        ('{"op":"subscribe","topic":"/a","id":{}}', "at `$.id`", None),
        ('{"op":"subscribe","topic":"/a","id":' + "9" * 1000 + "}", "at `$.id`", None),
        ('{"op":"subscribe","topic":"/\\ud800"}', "not a rosbridge operation", None),
        (b'{"op":"subscribe","topic":"/\xff"}', "can't decode byte 0xff", None),
        (b"\xa1\x62op\x9f\xff", "indefinite length", None),
        (b"\xff\xff", "indefinite length", None),
        ('{"op":"fragment","id":1,"num":3,"total":3,"data":""}', "send the whole operation in one frame", 1),
        ('{"op":"service_response","service":"/a","id":"x","result":true}', "no call of '/a'", "x"),
        ('{"op":"set_level","level":"loud"}', "Invalid enum value 'loud'", None),
    ],
)
def test_a_frame_that_breaks_the_protocol_is_refused_in_words(
    client: Client, frame: str | bytes, words: str, reply_to: Any
) -> None:
    status = client.refusal(frame)
    assert words in status["msg"] and status.get("id") == reply_to
    assert len(status["msg"]) < 1000


def test_everything_that_a_client_can_make_grow_has_a_limit() -> None:
    client = Client(topics=3, ids=3, services=3)
    made: dict[str, Callable[[int], dict[str, Any]]] = {
        "subscribe": lambda number: {"topic": f"/t{number}"},
        "publish": lambda number: {"topic": f"/t{number}"},
        "advertise": lambda number: {"topic": "/t1", "type": "a/B", "id": number},
        "advertise_service": lambda number: {"service": f"/s{number}", "type": "a/B"},
    }
    for operation, fields in made.items():
        refused = 0
        for number in range(1000):
            client.sends({"op": operation} | fields(number))
            refused += len(client.gets())
        assert refused >= 10, operation
    client.sends({"op": "unsubscribe", "topic": "/t0"})
    assert client.sends({"op": "subscribe", "topic": "/t9"}) == [SubscribeTopic("/t9")]


def test_a_raw_message_that_waited_is_sent_although_other_clients_took_memory() -> None:
    door = DoorMemory()
    queue = ViewerQueue[str](message_bytes=64 << 20, memory=door.client())
    rosbridge = Rosbridge("/door_alice", RosbridgeLimits(), queue)
    rosbridge.receive(b'{"op":"subscribe","topic":"/t","compression":"cbor-raw"}', is_text=True)
    body = bytes(40 << 20)
    rosbridge.message(DoorMessage("/t", body, {}, 0, lambda _header: STRING), 0.0)
    for size in (40 << 20, 30 << 20):
        other = door.client()
        assert not other.refusal(size)
        other.add(size)
    frame = rosbridge.next_frame(0.0)
    assert isinstance(frame, tuple) and frame[1] is body
