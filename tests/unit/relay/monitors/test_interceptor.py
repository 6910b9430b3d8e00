import gc
import socket
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance.channel.messages import (
    UNLIMITED,
    ConnectionClosed,
    FactWithdrawn,
    FlowLimit,
    GrantInstalled,
    LookWanted,
    Message,
    MessageSeen,
    MessagesLimited,
    MonitorGiven,
    MonitorResumed,
    MonitorSwitched,
    NodePlaced,
    OwnPublished,
    PublicationPlaced,
    PublicationRefused,
    SpecificationsRefused,
    SpecificationsTaken,
    StateGiven,
    StopWanted,
    TrafficReported,
    UpstreamWanted,
)
from appliance.relay.connections.relayed_topic import RelayedTopic
from appliance.relay.connections.startup_replay import REPLAY_GAP
from appliance.relay.monitors.observation_points import ObservationPoint
from appliance.relay.monitors.state_keeper import StateKeeper
from appliance.relay.monitors.topic_pipeline import TopicPipeline
from appliance.relay.transport.frames import Batch
from roswire.standard import standard_definitions
from roswire.tcpros import encode_frame, encode_header, encode_service_reply
from tests.support.stated import stated
from tests.unit.relay.monitors.monitored import (
    BEGINNING,
    COSTLY,
    GUARD,
    LATCH,
    SAFE,
    STOPPING,
    STRING_MD5,
    TYPED,
    WANTED,
    Monitored,
    MonitoredDialogue,
    data_of,
    string,
)
from tests.unit.relay.world import ASK, LOOPBACK, Peer
from tests.unit.transcripts import transcripts

pytestmark = pytest.mark.usefixtures("sockets")

DIALOGUES = transcripts(Path(__file__).with_name("dialogues.txt"))


def _marks(title: str) -> list[pytest.MarkDecorator]:
    """Mark the dialogues about processor time, which virtual time does not have."""
    return [pytest.mark.nightly] * any("processor time" in line for line in DIALOGUES[title])


@pytest.mark.parametrize("title", [pytest.param(title, id=title, marks=_marks(title)) for title in DIALOGUES])
def test_dialogue(world: Monitored, title: str) -> None:
    dialogue = MonitoredDialogue(world)
    for line in DIALOGUES[title]:
        dialogue.say(line)


@pytest.fixture
def world() -> Iterator[Monitored]:
    world = Monitored()
    yield world
    world.close()


def passes_by(relayed: RelayedTopic) -> bool:
    simple = relayed.simple()
    return simple is not None and simple[1] is None


TWIST = """a() { event e(double x) /cmd_vel geometry_msgs/Twist '{linear:{x:x}}' { } }"""


@pytest.mark.parametrize(
    ("change", "refused"),
    [
        (("", ""), False),
        (("Vector3 linear", "Vector3  linear  # forwards"), False),
        (("Vector3 linear", "Vector3[] linear"), True),
        (("Vector3 angular", "Vector3[2] angular"), True),
        (
            ("MSG: geometry_msgs/Vector3", "MSG: geometry_msgs/Other"),
            False,
        ),  # it cannot be read: the md5sum decides
    ],
)
def test_a_definition_with_other_arrays_is_refused_in_spite_of_its_md5sum(
    world: Monitored, change: tuple[str, str], refused: bool
) -> None:
    assert isinstance(world.load(TWIST), SpecificationsTaken)
    definitions = standard_definitions()
    text = definitions.full_text("geometry_msgs/Twist").replace(*change)
    header = {"type": "geometry_msgs/Twist", "md5sum": definitions.md5sum("geometry_msgs/Twist")}
    point = ObservationPoint("k", "/cmd_vel")
    objection = world.engine.interceptor.objection(point, header | {"message_definition": text})
    assert ("with the same md5sum, but with other arrays" in objection) == refused
    assert world.engine.interceptor.objection(point, header) == ""


def test_a_topic_without_an_enabled_event_never_goes_through_monitors(world: Monitored) -> None:
    world.load(GUARD.replace("/chatter", "/other"))
    publisher, subscriber = world.subscribed()
    relayed = world.engine.topics["k", "/chatter"]
    assert passes_by(relayed)
    publisher.send(string("bad"))
    world.gets(subscriber, string("bad"))
    world.load(GUARD, revision=2, guard=False)
    assert passes_by(relayed)
    publisher.send(string("bad") + string("one"))
    world.gets(subscriber, string("bad") + string("one"))


def test_the_first_specifications_delay_only_their_topics(world: Monitored) -> None:
    world.loop.holds = True
    late = GUARD.replace("/chatter", "/late")
    world.state(stated(1, [("0.rv", late)], {}, {}, True, statement=7))
    world.state(PublicationPlaced("k", "/late", "std_msgs/String"))
    world.state(GrantInstalled("k", "/late", LOOPBACK, "/listener"))
    world.state(MonitorSwitched("guard", False))
    turned: list[bool] = []
    world.loop.after(0, lambda: turned.append(True))
    world.until(lambda: turned)
    assert ("k", "/late") not in world.engine.topics
    world.loop.release()
    taken = world.until(lambda: world.taken(SpecificationsTaken, 1))
    assert (taken.began, taken.statement) == (["guard"], 7)
    assert ("k", "/late") in world.engine.topics
    assert not world.engine.interceptor.wants("/late")
    world.state(MonitorSwitched("guard", True))
    assert world.engine.interceptor.wants("/late")


def test_statements_that_come_while_the_first_is_compiled_come_into_force_in_order(world: Monitored) -> None:
    other = GUARD.replace("/chatter", "/other")
    for revision, text in enumerate((GUARD, other, GUARD, "nonsense", other, other), 1):
        world.control.send(stated(revision, [("0.rv", text)], {}, {}, True, statement=revision))
    world.link.catch_up()
    world.until(lambda: any(getattr(one, "revision", 0) == 6 for one in world.told))
    answers = [one for one in world.told if isinstance(one, SpecificationsTaken | SpecificationsRefused)]
    assert [answer.statement for answer in answers] == [1, 2, 3, 4, 5, 6]
    assert isinstance(answers[3], SpecificationsRefused)
    assert world.engine.interceptor.wants("/other")
    assert not world.engine.interceptor.wants("/chatter")
    assert isinstance(world.load(GUARD, revision=7), SpecificationsTaken)
    for _ in range(20):  # no work is left that would wake the loop
        world.loop.turn(0.01)


@pytest.mark.parametrize("text", [GUARD.replace("/chatter", "/late"), "nonsense"])
def test_specifications_of_a_new_control_are_in_force_before_its_placements(
    world: Monitored, text: str
) -> None:
    world.load(GUARD)
    world.loop.holds = True
    world.state(stated(2, [("0.rv", text)], {}, {}, True, ahead=True))
    world.state(PublicationPlaced("k", "/late", "std_msgs/String"))
    assert ("k", "/late") not in world.engine.topics
    world.loop.release()
    world.until(lambda: world.taken(SpecificationsTaken, 2) or world.taken(SpecificationsRefused, 2))
    assert ("k", "/late") in world.engine.topics


@pytest.mark.nightly
def test_ticks_that_take_longer_than_their_period_do_not_starve_the_relay(world: Monitored) -> None:
    slow = "slow() { int n; event tick() every 1ms { for (int i = 0; i < 60000; i++) n += i; } }"
    world.load(slow)
    longest = 0.0
    gc.collect()
    gc.disable()  # the objects of all collected tests would be visited in a turn
    try:
        ends = time.thread_time() + 1.5
        while time.thread_time() < ends:
            began = time.thread_time()
            world.loop.turn(0.01)
            longest = max(longest, time.thread_time() - began)
    finally:
        gc.enable()
    assert longest < 0.6
    assert "they take too long" in world.event("log", monitor="slow").text


def test_messages_that_do_not_fit_into_a_quantum_are_left_for_the_next_turn(world: Monitored) -> None:
    world.load(COSTLY)
    lane = TopicPipeline(world.engine.interceptor, ObservationPoint("k", "/chatter"))
    frames = bytearray(string("x" * 3000) + string("last") * 3)
    batch = Batch(memoryview(frames), 4, None)
    batch.first = 7
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(world.engine.interceptor, "over", lambda: True)
        left = lane.through(batch)
    assert left is not None
    assert (left.messages, bytes(left.view)) == (1, string("x" * 3000))
    rest = batch.tail(batch.left)
    assert (rest.first, rest.messages, bytes(rest.view)) == (8, 3, string("last") * 3)


def test_hosts_that_the_policy_does_not_name_have_one_pace(world: Monitored) -> None:
    interceptor = world.engine.interceptor
    for key, host, named in (("a", "10.9.0.1", False), ("b", "10.9.0.2", False), ("c", "10.0.0.1", True)):
        world.state(NodePlaced(key, "/node", host), world.listen())
        world.state(PublicationPlaced(key, "/t", "*", named=named))
    one, other, robot = (ObservationPoint("k", "/t", host) for host in ("10.9.0.1", "10.9.0.2", "10.0.0.1"))
    interceptor.time_budgets.of(one).cut(1, 10)
    assert [interceptor.time_budgets.of(place).part(2, 10) for place in (one, other, robot)] == [0.1, 0.1, 1]
    interceptor.time_budgets.of(robot).cut(1, 10)
    places = (robot, robot._replace(resource="/u"))
    assert [interceptor.time_budgets.of(place).part(2, 10) for place in places] == [0.1, 1]


def test_waiting_messages_survive_new_specifications_in_order(world: Monitored) -> None:
    world.load(COSTLY)
    publisher, subscriber = world.typed()
    many = [string(f"{number:05}" + "x" * 100) for number in range(3000)]
    world.engine.interceptor.over = lambda: True
    world.push(publisher, b"".join(many))
    world.loop.turn(0.01)
    world.load(COSTLY.replace("i < s.size()", "i < 0"), revision=2)
    world.gets(subscriber, b"".join(many))


def test_waiting_messages_end_with_the_publication(world: Monitored) -> None:
    world.load(COSTLY)
    publisher, subscriber = world.typed()
    world.engine.interceptor.over = lambda: True
    world.push(publisher, string("x" * 100) * 3000)
    world.until(lambda: world.held)
    world.state(FactWithdrawn(("publication", "k", "/chatter")))
    world.ends(subscriber)
    assert world.held == 0


def test_a_defect_of_the_monitors_drops_the_message_and_nothing_else(
    world: Monitored, monkeypatch: pytest.MonkeyPatch
) -> None:
    world.load(GUARD)
    publisher, subscriber = world.typed()
    monitors = world.engine.interceptor.monitors
    assert monitors is not None
    monkeypatch.setattr(monitors, "process", lambda *_args, **_named: 1 / 0)
    publisher.send(string("a"))
    assert "a defect of rosrv" in world.event("fault").text
    monkeypatch.undo()
    publisher.send(string("b"))
    world.gets(subscriber, string("b"))


def own_publication(world: Monitored, topic: str, limit: FlowLimit = UNLIMITED) -> socket.socket:
    """Let the appliance publish a topic; return where a subscriber connects."""
    port = world.listen()
    world.state(NodePlaced("own", "/rosrv", LOOPBACK, monitors=True), port)
    world.state(PublicationPlaced("own", topic, "std_msgs/String"))
    world.state(GrantInstalled("own", topic, LOOPBACK, "/listener", limit))
    return port


ALARM = """
alarm() {
    std_msgs::String text;
    event said(std::string t) /chatter std_msgs/String '{data:t}' {
        if (t == "bad") { text.data = "alarm"; PUBLISH(/alarm, std_msgs/String, text); return; }
    }
    event tick() every 50ms { text.data = "tick"; PUBLISH(/alarm, std_msgs/String, text); }
}
"""


def test_publications_of_monitors_are_served_and_not_monitored(world: Monitored) -> None:
    hearer = GUARD.replace("/chatter", "/alarm")
    world.load(ALARM, hearer)
    port = own_publication(world, "/alarm", FlowLimit(messages=0.001))
    world.port = port
    subscriber = world.connect(encode_header(WANTED | {"topic": "/alarm"}))
    header = world.gets_header(subscriber)
    named = header["callerid"], header["md5sum"], header["type"]
    assert named == ("/rosrv", STRING_MD5, "std_msgs/String")
    assert header["message_definition"].startswith("string data")
    world.until(lambda: len(data_of(subscriber)) >= 2 * len(string("tick")))
    assert subscriber.data.startswith(string("tick") * 2)
    publisher = world.upstream(TYPED)
    publisher.send(string("bad"))
    world.until(lambda: string("alarm") in data_of(subscriber))
    assert world.event("publish", resource="/alarm").monitor == "alarm"


def _called(world: Monitored) -> tuple[Peer, Peer]:
    return world.call(MonitoredDialogue.served, persistent="1")


class Killed(BaseException):
    pass


class Mortal(bytearray):
    kills = False

    def __setitem__(self, key: Any, value: Any) -> None:
        if self.kills:
            raise Killed
        super().__setitem__(key, value)


def _passes_on(world: Monitored) -> tuple[Peer, Peer, bytes]:
    world.load(GUARD)
    publisher, subscriber = world.typed()
    return publisher, subscriber, string("count")


def _publishes(world: Monitored) -> tuple[Peer, Peer, bytes]:
    world.load("""alarm() {
        int seen = 0;
        std_msgs::String text;
        event said(std::string t) /chatter std_msgs/String '{data:t}' {
            seen = seen + 1;
            text.data = "alarm";
            PUBLISH(/alarm, std_msgs/String, text);
        }
    }""")
    own = own_publication(world, "/alarm")
    publisher, _subscriber = world.typed()
    world.port = own
    alarmed = world.connect(encode_header(WANTED | {"topic": "/alarm"}))
    world.gets_header(alarmed)
    return publisher, alarmed, string("a")


def _calls(world: Monitored) -> tuple[Peer, Peer, bytes]:
    world.load(LATCH)
    client, service = _called(world)
    return client, service, encode_frame(b"\x01")


def _replies(world: Monitored) -> tuple[Peer, Peer, bytes]:
    world.load("""count() {
        int seen = 0;
        event answer() service /mode std_srvs/SetBool response '{}' { seen = seen + 1; }
    }""")
    client, service = _called(world)
    client.send(encode_frame(b"\x01"))
    world.gets(service, encode_frame(b"\x01"))
    return service, client, encode_service_reply(b"\x01" + struct.pack("<I", 0))


@pytest.mark.parametrize("begin", [_passes_on, _publishes, _calls, _replies])
def test_state_is_written_before_its_effect(
    world: Monitored, begin: Callable[[Monitored], tuple[Peer, Peer, bytes]]
) -> None:
    memory = Mortal(1 << 20)
    world.engine.interceptor.remember(StateKeeper(StateGiven(True, "boot", 0), memory))
    sender, receiver, message = begin(world)
    memory.kills = True
    sender.send(message)
    with pytest.raises(Killed):
        world.until(lambda: False)
    assert data_of(receiver) == b""


def test_the_client_of_a_service_reads_why_its_request_could_not_be_judged(world: Monitored) -> None:
    world.load(LATCH.replace("open = wish;", "int zero = 0; open = 1 / zero;"))
    interceptor = world.engine.interceptor
    refused = interceptor.judge(ObservationPoint("k", "/mode"), "request", b"\0")
    assert (
        not refused.ok
        and refused.body.decode() == "the request is dropped by the monitor gate: division by zero"
    )
    world.state(MonitorSwitched("gate", False))
    assert interceptor.judge(ObservationPoint("k", "/mode"), "request", b"\0").ok


def test_events_without_a_control_reach_the_next_one(world: Monitored) -> None:
    world.load(GUARD)
    publisher, subscriber = world.typed()
    world.engine.attach(None)
    publisher.send(string("bad") + string("a"))
    world.gets(subscriber, string("a"))
    world.link.close()
    world.control.close()
    world.connect_control()
    world.state(stated(1, [("0.rv", GUARD)], {}, {}, True))
    world.engine.interceptor.observations.repeat()  # as at the end of what a control states
    assert world.event("drop", count=0).monitor == "guard"


def test_nothing_is_lost_while_specifications_come_and_go(world: Monitored) -> None:
    specification = (
        "mark() { event said(std::string t) /chatter std_msgs/String '{data:t}' { t = \"%s\" + t; } }"
    )
    world.load(specification % 0, revision=100)
    publisher, subscriber = world.typed()
    sent = 0
    for revision in range(1, 7):
        text = specification % revision
        files = [] if revision == 4 else [("a.rv", text)]
        world.control.send(stated(revision, files, {}, {"mark": revision != 5}, False))
        while world.taken(SpecificationsTaken, revision) is None:
            world.push(publisher, b"".join(string(f" {sent + number}") for number in range(100)))
            sent += 100
            world.until(lambda: True)
            subscriber.read()
    world.push(publisher, string(f" {sent}"))
    world.until(lambda: string(f"6 {sent}") in data_of(subscriber))
    heard, position = [], 0
    while position < len(subscriber.data):
        size = struct.unpack_from("<I", subscriber.data, position)[0]
        heard.append(subscriber.data[position + 8 : position + 4 + size].decode())
        position += 4 + size
    assert [int(text.split()[-1]) for text in heard] == list(range(sent + 1))
    assert heard[-1] == f"6 {sent}"
    marks = [text.split(" ")[0] for text in heard]
    assert sorted(set(marks)) == sorted(["", "0", "1", "2", "3", "6"])


def test_a_monitor_that_comes_from_another_relay_holds_its_topics_if_it_is_declared_so(
    world: Monitored,
) -> None:
    held = "hold gate() { event e() /chatter std_msgs/String '{}' { } }"
    free = "free() { event e() /other std_msgs/String '{}' { } }"
    world.load(free)
    files = [("gate.rv", held), ("free.rv", free)]
    world.state(stated(2, files, {}, {}, False, moved=("gate", "free")))
    taken = world.until(lambda: world.taken(SpecificationsTaken, 2))
    assert (taken.began, taken.held) == (["gate"], ["gate"])
    world.state(stated(3, files, {}, {}, False, moved=("gate", "free")))
    assert world.until(lambda: world.taken(SpecificationsTaken, 3)).held == ["gate"]
    world.state(MonitorResumed("gate"))
    world.state(stated(4, files, {}, {}, False, moved=("gate", "free")))
    assert world.until(lambda: world.taken(SpecificationsTaken, 4)).held == []


@pytest.mark.parametrize(
    ("modifier", "said", "held"), [("", ["one"], True), ("", [], False), ("begin ", ["one"], False)]
)
def test_a_text_that_changes_while_a_state_is_to_lose_holds_the_topics(
    world: Monitored, modifier: str, said: list[str], held: bool
) -> None:
    world.load(GUARD)
    publisher, subscriber = world.typed()
    for text in said:
        publisher.send(string(text))
        world.gets(subscriber, string("two"))
    changed = modifier + GUARD.strip().replace("longer", "wider")
    taken = world.load(changed, revision=2)
    assert (taken.began, taken.held, list(taken.because)) == (["guard"], *[["guard"] if held else []] * 2)
    if held:
        assert "has changed" in taken.because["guard"]
        world.state(MonitorResumed("guard"))
    publisher.send(string("next"))
    world.gets(subscriber, string("next"))


def test_a_verdict_names_its_senders_and_messages(world: Monitored) -> None:
    world.load("""latch() {
    event on(std::string text) /chatter std_msgs/String '{data:text}' when (text == "on") { }
    event off(std::string text) /chatter std_msgs/String '{data:text}' when (text == "off") { }
    event go(std::string text) /chatter std_msgs/String '{data:text}' when (text == "go") { }
    fsm: idle [ on -> armed, off -> idle, go -> idle ] armed [ on -> armed, off -> idle, go -> fired ]
         fired [ default fired ]
    @fired { ROS_WARN("fired"); DROP; }
}""")
    publisher, _subscriber = world.typed()
    publisher.send(b"".join(map(string, ("on", "off", "x", "on", "on", "y", "go"))))
    verdict = world.event("verdict", monitor="latch", count=0)
    assert verdict.detail["at"] == ["0.rv:5:10"]
    assert verdict.detail["number"] == 7
    why = verdict.detail["why"]
    told = [(one["event"], one["state"], one["node"], one["host"], one["on"]) for one in why["events"]]
    assert told == [
        (name, state, "/talker", LOOPBACK, "/chatter") for name, state in (("on", "armed"), ("go", "fired"))
    ]
    assert why["fewest"] is True
    drop = world.event("drop", monitor="latch", count=0)
    assert drop.detail["at"] == ["0.rv:7:33"]
    assert drop.detail["conditions"] == {"0.rv:4:77": {"text": "go"}}


def test_slices_are_charged_to_the_host_that_publishes(world: Monitored) -> None:
    interceptor = world.engine.interceptor
    world.state(NodePlaced("robot", "/robot", "10.0.0.1"), world.listen())
    numbers = [
        interceptor.senders.number(ObservationPoint("k", "/t", host))
        for host in ("10.0.0.1", "10.0.0.8", "10.0.0.9")
    ]
    assert [interceptor.holder_of(number) for number in (*numbers, 999)] == ["10.0.0.1", "", "", ""]


def test_given_constants_are_set_between_two_messages_and_on_a_new_relay(world: Monitored) -> None:
    text = """s() given { int most = 1 in 0..9; } { int n; event e(std::string t) /chatter std_msgs/String '{data:t}' {
        n++; if (n > most) { t = "late"; } else { t = std::to_string(n); } } }"""
    files = [("s.rv", text)]
    world.state(stated(1, files, given={"s": {"most": 2}}))
    world.until(lambda: world.taken(SpecificationsTaken, 1))
    publisher, subscriber = world.typed()
    for told, sent in ((None, "1"), (None, "2"), (None, "late"), (5, "4"), (4, "late")):
        if told is not None:
            world.state(MonitorGiven("s", {"most": told}))
        publisher.send(string("x"))
        world.gets(subscriber, string(sent))
    world.state(stated(1, files, given={"s": {"most": 9}}))
    world.until(lambda: world.taken(SpecificationsTaken, 1))
    publisher.send(string("x"))
    world.gets(subscriber, string("6"))


def test_a_base_that_reconnects_after_a_stop_does_not_get_the_latched_motion(world: Monitored) -> None:
    world.load(STOPPING)
    publisher = world.upstream(header := TYPED | {"latching": "1"})
    publisher.send(string("one"))
    late = world.connect(encode_header(WANTED))
    assert world.gets_header(late) == header
    world.gets(late, string("two"))
    world.state(StopWanted(1, "/chatter", begin=True))
    world.event("publish", monitor="guard")
    late = world.connect(encode_header(WANTED))
    assert world.gets_header(late) == header
    publisher.send(string("three"))
    world.gets(late, string("stop") + string("three"))


def latching_client(world: Monitored, topic: str) -> tuple[Peer, Peer]:
    """Return a publisher that latches, and a node that hears it."""
    names = {"topic": topic}
    world.state(PublicationPlaced("k", topic, "*"))
    world.state(GrantInstalled("k", topic, LOOPBACK, "/listener"))
    server = world.connect(encode_header(WANTED | names))
    publisher = world.upstream(TYPED | names | {"latching": "1"})
    world.gets_header(server)
    return publisher, server


def quiet(world: Monitored) -> None:
    """Let the time pass after which a message of a latching publisher is a new one."""
    end = world.loop.clock() + 2 * REPLAY_GAP
    world.until(lambda: world.loop.clock() > end)


def shadowed(world: Monitored, text: str) -> None:
    world.state(stated(2, [("0.rv", text)], {}, {}, False, shadows=("guard",)))
    world.until(lambda: world.taken(SpecificationsTaken, 2))


OFF: dict[str, Callable[[Monitored, str], object]] = {
    "disabled": lambda world, _text: world.state(MonitorSwitched("guard", False)),
    "removed": lambda world, _text: world.load(revision=2),
    "replaced": lambda world, text: world.load(text.replace('"bad"', '"worse"'), revision=2),
    "in shadow mode": shadowed,
}


OTHER_GUARD = GUARD.replace('"bad"', '"worse"')
COMES: dict[str, tuple[Callable[[Monitored], object], Callable[[Monitored], object]]] = {
    "loaded": (lambda world: world.load(), lambda world: world.load(GUARD, revision=2)),
    "beside another": (
        lambda world: world.load(OTHER_GUARD.replace("guard", "other")),
        lambda world: world.load(OTHER_GUARD.replace("guard", "other"), GUARD, revision=2),
    ),
    "with another text": (
        lambda world: world.load(BEGINNING.replace('"bad"', '"worse"')),
        lambda world: world.load(BEGINNING, revision=2),
    ),
    "switched on": (
        lambda world: world.load(GUARD, guard=False),
        lambda world: world.state(MonitorSwitched("guard", True)),
    ),
    "out of shadow mode": (
        lambda world: shadowed(world, OTHER_GUARD),
        lambda world: world.load(GUARD, revision=3),
    ),
    "in shadow mode": (lambda world: world.load(), lambda world: shadowed(world, GUARD)),
}


@pytest.mark.parametrize("how", COMES)
def test_a_monitor_that_begins_judges_the_latched_message_that_came_before(
    world: Monitored, how: str
) -> None:
    """Its publisher sends the message only on a connection, and the relay has one already."""
    before, comes = COMES[how]
    before(world)
    publisher, listener = latching_client(world, "/chatter")
    publisher.send(string("bad"))
    world.gets(listener, string("bad"))
    world.told.clear()
    comes(world)
    world.event("shadow drop" if how == "in shadow mode" else "drop", monitor="guard")
    publisher.send(string("new"))
    world.gets(listener, string("new"))
    assert not [one for one in world.told if isinstance(one, UpstreamWanted)]


@pytest.mark.parametrize(("topic", "text"), [("/chatter", STOPPING), ("/arm/goal", BEGINNING)])
def test_a_base_that_connects_gets_no_command_that_a_guard_has_not_judged(
    world: Monitored, topic: str, text: str
) -> None:
    world.load()
    publisher, base = latching_client(world, topic)
    publisher.send(string("one"))
    world.gets(base, string("one"))
    world.load(text.replace("/chatter", topic), revision=2)
    late = world.connect(encode_header(WANTED | {"topic": topic}))
    world.gets_header(late)
    publisher.send(string("new"))
    world.gets(late, string("new"))


@pytest.mark.parametrize("off", OFF)
@pytest.mark.parametrize(("topic", "safe"), [("/chatter", SAFE), ("/arm/goal", "int seen")])
def test_a_command_that_a_guard_has_dropped_does_not_come_when_the_guard_is_off(
    world: Monitored, topic: str, safe: str, off: str
) -> None:
    """A latching client, such as `rostopic pub`, sends it on each connection: the relay makes none."""
    text = BEGINNING.strip().replace("int seen", safe).replace("/chatter", topic)
    world.load(text)
    publisher, base = latching_client(world, topic)
    publisher.send(string("bad"))
    world.event("drop", before=string("bad")[4:])
    world.told.clear()
    OFF[off](world, text)
    publisher.send(string("new"))
    world.until(lambda: data_of(base).endswith(string("new")))
    assert base.data.replace(string("stop"), b"") == string("new")
    assert not [one for one in world.told if isinstance(one, UpstreamWanted)]


@pytest.mark.parametrize(("topic", "safe"), [("/chatter", SAFE), ("/arm/goal", "int seen")])
@pytest.mark.parametrize("replayed", ["one", "stop"])
def test_a_latched_command_is_new_only_on_the_first_connection(
    world: Monitored, topic: str, safe: str, replayed: str
) -> None:
    world.load(BEGINNING.strip().replace("int seen", safe).replace("/chatter", topic))
    publisher, base = latching_client(world, topic)
    publisher.send(string("before"))
    world.until(lambda: string("before") in data_of(base))
    base.data.clear()
    publisher.sock.close()
    publisher = world.upstream(TYPED | {"topic": topic, "latching": "1"}, behind=string(replayed))
    passes = replayed == "stop" and topic == "/chatter"
    if passes:
        world.gets(base, string("stop"))
    else:
        assert "send it again" in world.event("drop").text
    quiet(world)
    publisher.send(string("new"))
    world.until(lambda: data_of(base).endswith(string("new")))
    assert base.data == string("new")


@pytest.mark.parametrize("off", ["disabled", "removed", "in shadow mode"])
def test_a_guard_that_was_removed_still_has_its_stop_in_force(world: Monitored, off: str) -> None:
    """Until the next command a base that connects gets it, and then the last command, as in plain ROS.

    A publisher that connects to the same relay again does not repeat what it had latched.
    """
    text = BEGINNING.strip().replace("int seen", SAFE)
    world.load(text)
    publisher, base = latching_client(world, "/chatter")
    publisher.send(string("before"))
    world.until(lambda: string("before") in data_of(base))
    world.state(StopWanted(1, "/chatter", begin=True))
    world.until(lambda: data_of(base).endswith(string("stop")))
    OFF[off](world, text)
    for sent in ("stop", "back"):
        late = world.connect(encode_header(WANTED))
        world.gets_header(late)
        world.gets(late, string(sent))
        publisher.send(string("back"))
        world.gets(late, string("back"))
    publisher.sock.close()
    publisher = world.upstream(TYPED | {"latching": "1"}, behind=string("back"))
    assert "send it again" in world.event("drop").text
    quiet(world)
    publisher.send(string("new"))
    world.gets(late, string("new"))


def test_without_a_guard_a_latched_command_is_sent_again(world: Monitored) -> None:
    """As in plain ROS: so it does after a restart of the relay, if the guard was removed."""
    publisher, base = latching_client(world, "/chatter")
    publisher.send(string("before"))
    world.gets(base, string("before"))
    publisher.sock.close()
    world.upstream(TYPED | {"latching": "1"}, behind=string("before"))
    world.gets(base, string("before"))


@pytest.mark.parametrize("off", ["disabled", "removed", "in shadow mode"])
def test_a_publisher_that_returns_with_another_type_is_refused_while_a_guard_is_in_force(
    world: Monitored, off: str
) -> None:
    other = {"type": "std_msgs/Int32", "md5sum": "da5909fbe378aeaf85e547e830cc1bb7"}
    text = BEGINNING.strip().replace("int seen", SAFE)
    world.load(text)
    publisher, base = world.typed()
    publisher.send(string("before"))
    world.until(lambda: data_of(base).endswith(string("before")))
    publisher.sock.close()
    world.upstream(TYPED | other, behind=string("other"))
    assert "std_msgs/Int32" in world.hears(PublicationRefused, key="k", resource="/chatter").reason
    assert string("other") not in data_of(base)
    OFF[off](world, text)
    world.upstream(TYPED | other)
    cut = world.hears(ConnectionClosed)  # the base has to read the new header
    assert cut.reason == "the publisher returned with a different type"


def test_a_policys_limit_keeps_back_motions_and_no_stop(world: Monitored) -> None:
    """The base connects to its commander and to the appliance."""
    world.load(STOPPING.replace("1s", "10ms"))
    limit = FlowLimit(messages=0.001)
    port = own_publication(world, "/chatter", limit)
    world.state(GrantInstalled("k", "/chatter", LOOPBACK, "/listener", limit))
    publisher, driven = world.typed()
    world.port = port
    stopped = world.connect(encode_header(WANTED))
    world.gets_header(stopped)
    publisher.send(string("a") * 3)
    world.until(
        lambda: [row.messages for one in world.told if isinstance(one, MessagesLimited) for row in one.rows]
    )
    assert data_of(driven) == string("a")
    world.state(StopWanted(1, "/chatter", begin=True))
    world.until(lambda: len(data_of(stopped)) >= 3 * len(string("stop")))
    assert stopped.data.startswith(string("stop") * 3)


def test_a_server_that_connects_again_does_not_get_a_cancelled_goal(world: Monitored) -> None:
    goal = {"topic": "/arm/goal"}
    publisher, server = latching_client(world, "/arm/goal")
    publisher.send(string("one"))
    world.gets(server, string("one"))
    world.state(OwnPublished("/arm/cancel", bytes(12)))
    late = world.connect(encode_header(WANTED | goal))
    world.gets_header(late)
    publisher.send(string("two"))
    world.gets(late, string("two"))


LONG = "n" * 30_000


@pytest.mark.parametrize(
    "sort", ["traffic", "seen", "too long a name", "topic refused", "service refused", "lost"]
)
def test_no_peer_makes_a_long_message_to_control(world: Monitored, sort: str) -> None:
    """Many of them in one turn would end the link."""
    header, most = TYPED | {"md5sum": LONG, "type": LONG}, 4096
    kind: type[Message] = PublicationRefused
    if sort == "service refused":
        world.load("a() { event e() service /mode std_srvs/SetBool request '{}' { } }")
        world.connect(encode_header({"callerid": "/client", "service": "/mode", "md5sum": "*"}))
        world.accept(world.service).send(encode_header(header))
    else:
        if sort == "topic refused":
            world.load(GUARD)
        subscriber = world.connect(encode_header(ASK | {"md5sum": "*", "type": "*"}))
        if sort == "traffic":
            kind = TrafficReported
        elif "refused" not in sort:
            name = LONG if sort == "too long a name" else "n" * 255
            fields = "\n".join(f"B[] a{number}" for number in range(12))
            text = f"{fields}\n{'=' * 80}\nMSG: std_msgs/B\nuint8 {name}\n"
            header, kind, most = TYPED | {"message_definition": text}, MessageSeen, 128 << 10
        publisher = world.upstream(header)
        if kind in {TrafficReported, MessageSeen}:
            world.gets_header(subscriber)
            world.state(LookWanted(1, "/chatter", 20, latched=False))
            publisher.send(encode_frame((struct.pack("<I", 16) + bytes(16)) * 12) * 20)
    found = world.until(lambda: [one for one in world.told if isinstance(one, kind)])
    assert max(len(msgspec.msgpack.encode(one)) for one in found) <= most
