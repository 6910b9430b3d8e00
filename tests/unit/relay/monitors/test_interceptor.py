"""Monitors in the middle, told as transcripts of the whole relay: specifications in, messages through, reports out."""

import struct
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from appliance.channel.messages import (
    GrantInstalled,
    MonitorEvent,
    MonitorResumed,
    MonitorsCounted,
    MonitorsReported,
    MonitorSwitched,
    NodePlaced,
    PublicationPlaced,
    PublicationRefused,
    PublicationWithdrawn,
    SpecificationsRefused,
    SpecificationsStated,
    SpecificationsTaken,
    UpstreamWanted,
)
from appliance.relay.connections.frames import Batch
from appliance.relay.monitors.loader import Loader
from appliance.relay.monitors.observation_points import Place
from rosmop.run.slice_quota import HolderOf
from roswire.tcpros import encode_frame, encode_header, encode_service_error, encode_service_reply
from tests.support.stated import stated
from tests.unit.relay.world import ASK, HEADER, LOOPBACK, Peer, World

STRING_MD5 = "992ce8a1687cec8c8bd883ec73ca41d1"
SET_BOOL_MD5 = "09fb03525b03e7ea1fd3992bafd87e16"
TYPED = HEADER | {"md5sum": STRING_MD5}
WANTED = ASK | {"md5sum": STRING_MD5}

GUARD = """
guard() {
    int seen = 0;
    event said(std::string text) /chatter std_msgs/String '{data:text}' {
        seen = seen + 1;
        if (text == "bad") { ROS_WARN("no such word"); return; }
        if (text == "one") text = "two";
        if (text == "long") text = "a longer text";
        if (text == "count") text = std::to_string(seen);
        if (text == "loop") { while (true) { seen = seen; } }
    }
}
"""
BEGINNING = GUARD.replace("guard()", "begin guard()")
"""The same, which does not hold its topics where its state is lost."""


def string(text: str) -> bytes:
    """The frame of a std_msgs/String."""
    data = text.encode()
    return encode_frame(struct.pack("<I", len(data)) + data)


def data_of(peer: Peer) -> bytes:
    """Everything the peer has been sent."""
    peer.read()
    return bytes(peer.data)


COSTLY = """a() { int n; event e(std::string s) /chatter std_msgs/String '{data:s}' {
    for (int i = 0; i < s.size(); i++) { if (s[i] == 'y') n += i; } } }"""


class Monitored(World):
    """A relay whose control states specifications, and keeps what monitors did."""

    def load(self, *texts: str, revision: int = 1, restarted: bool = False, **enabled: bool) -> Any:
        """State these files; the relay's answer."""
        files = [(f"{number}.rv", text) for number, text in enumerate(texts)]
        self.state(stated(revision, files, {}, enabled, restarted))
        return self.until(
            lambda: self.taken(SpecificationsTaken, revision) or self.taken(SpecificationsRefused, revision)
        )

    def taken(self, kind: type[Any], revision: int) -> Any:
        """The answer of this kind to a statement, once."""
        for message in self.told:
            if isinstance(message, kind) and message.revision == revision:
                self.told.remove(message)
                return message
        return None

    def event(self, kind: str, **fields: Any) -> MonitorEvent:
        """A monitor did this; it is taken out of what was told."""

        def find() -> MonitorEvent | None:
            for message in self.told:
                if isinstance(message, MonitorsReported):
                    for event in message.events:
                        if event.kind == kind and all(getattr(event, k) == v for k, v in fields.items()):
                            message.events.remove(event)
                            return event
            return None

        found: MonitorEvent = self.until(find)
        return found

    def typed(self) -> tuple[Peer, Peer]:
        """A publisher of std_msgs/String and a subscriber that is served."""
        publisher = self.upstream(TYPED)
        subscriber = self.connect(encode_header(WANTED))
        assert self.gets_header(subscriber) == TYPED
        return publisher, subscriber


@pytest.fixture
def world() -> Iterator[Monitored]:
    """A relay with one node."""
    world = Monitored()
    yield world
    world.close()


def test_a_monitor_drops_and_changes_messages_and_control_is_told_before_and_after(world: Monitored) -> None:
    """The others pass, in order, whatever the lengths of the changed ones."""
    assert world.load(GUARD) == SpecificationsTaken(1, ["guard"], [])
    publisher, subscriber = world.typed()
    publisher.send(b"".join(map(string, ("a", "bad", "one", "long", "bad", "z"))))
    world.gets(subscriber, b"".join(map(string, ("a", "two", "a longer text", "z"))))
    drop = world.event("drop", monitor="guard", count=0)
    assert (drop.key, drop.resource, drop.before, drop.size) == ("k", "/chatter", string("bad")[4:], 7)
    assert drop.text == "guard.said dropped it: no such word"
    assert (drop.host, drop.caller_id, drop.detail["number"]) == (LOOPBACK, "/talker", 2)
    change = world.event("change", monitor="guard", count=0)
    assert (change.before, change.after) == (string("one")[4:], string("two")[4:])
    assert (change.caller_id, change.detail["number"]) == ("/talker", 3)
    assert world.event("log", monitor="guard").text == "no such word"
    again = world.event("drop", count=1)
    assert (again.monitor, again.host, again.caller_id) == ("guard", LOOPBACK, "/talker")
    assert world.event("change", count=1).resource == "/chatter"


def test_a_dropped_message_is_told_as_it_was_received(world: Monitored) -> None:
    """Not as a monitor before the one that dropped it has changed it, in place or to another length."""
    first = "a() { event e(std::string s) /chatter std_msgs/String '{data:s}' { s[0] = 'X'; s[1] = 'Y'; } }"
    longer = "b() { event e(std::string s) /chatter std_msgs/String '{data:s}' { s += \"more\"; } }"
    last = "c() { event e(std::string s) /chatter std_msgs/String '{data:s}' { return; } }"
    world.load(first, last)
    publisher, _subscriber = world.typed()
    other = last.replace("c()", "d()")  # the second drop of a monitor in one second is only counted
    for revision, texts in enumerate(((first, last), (first, longer, other)), 1):
        assert isinstance(world.load(*texts, revision=revision), SpecificationsTaken)
        publisher.send(string("ok then"))
        assert world.event("drop", count=0).before == string("ok then")[4:]


def test_a_topic_without_an_enabled_event_never_goes_through_monitors(world: Monitored) -> None:
    """Not with specifications for other topics, and not while its monitor is disabled; then messages are untouched."""
    world.load(GUARD.replace("/chatter", "/other"))
    publisher, subscriber = world.subscribed()
    relayed, _publisher = world.engine.topics["k", "/chatter"]
    assert relayed.through is None
    publisher.send(string("bad"))
    world.gets(subscriber, string("bad"))
    world.load(GUARD, revision=2, guard=False)
    assert relayed.through is None
    publisher.send(string("bad") + string("one"))
    world.gets(subscriber, string("bad") + string("one"))


def test_a_monitor_is_switched_off_and_on_while_messages_go_on(world: Monitored) -> None:
    """Its variables stay."""
    world.load(GUARD)
    publisher, subscriber = world.typed()
    publisher.send(string("count"))
    world.gets(subscriber, string("1"))
    world.state(MonitorSwitched("guard", False))
    publisher.send(string("count"))
    world.gets(subscriber, string("count"))
    world.state(MonitorSwitched("guard", True))
    publisher.send(string("count"))
    world.gets(subscriber, string("2"))


def test_other_specifications_take_over_between_two_messages_and_the_same_keep_their_state(
    world: Monitored,
) -> None:
    """What is stated again unchanged (a new control) changes nothing at all."""
    world.load(GUARD)
    publisher, subscriber = world.typed()
    publisher.send(string("count"))
    world.gets(subscriber, string("1"))
    second = GUARD.replace("guard", "other").replace("/chatter", "/elsewhere")
    assert world.load(GUARD, second, revision=2).began == ["other"]
    publisher.send(string("count"))
    world.gets(subscriber, string("2"))
    assert world.load(GUARD, second, revision=3, restarted=True) == SpecificationsTaken(3, [], [])
    publisher.send(string("count"))
    world.gets(subscriber, string("3"))
    assert world.load(BEGINNING.replace('"bad"', '"worse"'), revision=4).began == ["guard"]
    publisher.send(string("bad") + string("count"))
    world.gets(subscriber, string("bad") + string("2"))
    world.load(revision=5)
    publisher.send(string("worse"))
    world.gets(subscriber, string("worse"))


def test_the_first_specifications_hold_up_nothing_but_what_is_to_be_carried(
    world: Monitored, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However long they take to compile: the loop serves on (its supervisor), and nothing goes past the monitors."""
    compiled = threading.Event()
    load_now = Loader.load

    def load_late(message: SpecificationsStated, holder_of: HolderOf) -> Any:
        compiled.wait()
        return load_now(message, holder_of)

    monkeypatch.setattr(Loader, "load", staticmethod(load_late))
    late = GUARD.replace("/chatter", "/late")
    world.state(stated(1, [("0.rv", late)], {}, {}, True, statement=7))
    world.state(PublicationPlaced("k", "/late", "std_msgs/String"))
    world.state(GrantInstalled("k", "/late", LOOPBACK, "/listener"))
    world.state(MonitorSwitched("guard", False))
    turned: list[bool] = []
    world.loop.after(0, lambda: turned.append(True))
    world.until(lambda: turned)
    assert ("k", "/late") not in world.engine.topics
    compiled.set()
    taken = world.until(lambda: world.taken(SpecificationsTaken, 1))
    assert (taken.began, taken.statement) == (["guard"], 7)
    assert ("k", "/late") in world.engine.topics
    assert not world.engine.middle.wants("/late")
    world.state(MonitorSwitched("guard", True))
    assert world.engine.middle.wants("/late")


def test_statements_that_come_while_the_first_is_compiled_come_into_force_in_order(world: Monitored) -> None:
    """What waited for the first may be others, and the same again."""
    other = GUARD.replace("/chatter", "/other")
    for revision, text in enumerate((GUARD, other, GUARD, "nonsense", other, other), 1):
        world.control.send(stated(revision, [("0.rv", text)], {}, {}, True, statement=revision))
    world.link.catch_up()
    world.until(lambda: any(getattr(one, "revision", 0) == 6 for one in world.told))
    answers = [one for one in world.told if isinstance(one, SpecificationsTaken | SpecificationsRefused)]
    assert [one.statement for one in answers] == [1, 2, 3, 4, 5, 6]
    assert isinstance(answers[3], SpecificationsRefused)
    assert world.engine.middle.wants("/other")
    assert not world.engine.middle.wants("/chatter")
    assert isinstance(world.load(GUARD, revision=7), SpecificationsTaken)
    for _ in range(20):  # nothing is left that the loop is woken for
        world.loop.turn(0.01)


@pytest.mark.parametrize("text", [GUARD.replace("/chatter", "/late"), "nonsense"])
def test_what_a_new_control_begins_with_is_in_force_before_it_places_anything(
    world: Monitored, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    """It may have another revision than the relay, after a crash in the middle of a change; or one that is refused."""
    world.load(GUARD)
    compiled = threading.Event()
    load_now = Loader.load

    def load_late(message: SpecificationsStated, holder_of: HolderOf) -> Any:
        compiled.wait()
        return load_now(message, holder_of)

    monkeypatch.setattr(Loader, "load", staticmethod(load_late))
    world.state(stated(2, [("0.rv", text)], {}, {}, True, ahead=True))
    world.state(PublicationPlaced("k", "/late", "std_msgs/String"))
    assert ("k", "/late") not in world.engine.topics
    compiled.set()
    world.until(lambda: world.taken(SpecificationsTaken, 2) or world.taken(SpecificationsRefused, 2))
    assert ("k", "/late") in world.engine.topics


def test_bad_specifications_change_nothing(world: Monitored) -> None:
    """And control is told what is wrong, with its place."""
    world.load(GUARD)
    refused = world.load("nonsense", revision=2)
    assert isinstance(refused, SpecificationsRefused)
    assert refused.findings[0].startswith("what control states is no set of specifications")
    publisher, subscriber = world.typed()
    publisher.send(string("bad") + string("good"))
    world.gets(subscriber, string("good"))


def test_a_relay_without_specifications_that_it_understands_blocks_everything(world: Monitored) -> None:
    """Fail closed, until it is given some that it does."""
    assert isinstance(world.load("nonsense"), SpecificationsRefused)
    publisher, subscriber = world.subscribed()
    publisher.send(string("a"))
    assert "could not be taken" in world.event("drop", count=0).text
    world.load(revision=2)
    publisher.send(string("b"))
    world.gets(subscriber, string("b"))


def test_a_monitor_hears_a_topic_that_nobody_subscribes_to(world: Monitored) -> None:
    """And the connection ends when the monitor is removed."""
    world.load(GUARD)
    publisher = world.upstream(TYPED)
    publisher.send(string("bad"))
    assert world.event("drop").monitor == "guard"
    world.load(revision=2)
    world.ends(publisher)


def test_a_late_subscriber_of_a_latched_topic_gets_what_the_monitors_left(world: Monitored) -> None:
    """The last message that was relayed, as it was changed; a dropped one is not latched."""
    world.load(GUARD)
    publisher = world.upstream(TYPED | {"latching": "1"})
    publisher.send(string("one") + string("bad"))
    world.event("drop")
    subscriber = world.connect(encode_header(WANTED))
    assert world.gets_header(subscriber)["latching"] == "1"
    world.gets(subscriber, string("two"))


def test_a_publisher_with_another_definition_is_refused_on_that_topic(world: Monitored) -> None:
    """Control is told once; it is carried as soon as the specifications are gone."""
    world.load(GUARD)
    subscriber = world.connect(encode_header(ASK))
    publisher = world.upstream(HEADER)
    refused = world.hears(PublicationRefused, key="k", resource="/chatter")
    assert "std_msgs/String" in refused.reason
    world.ends(publisher)
    world.load(revision=2)
    publisher = world.upstream(HEADER)
    assert world.gets_header(subscriber) == HEADER
    world.load(GUARD, revision=3)
    world.hears(PublicationRefused)
    world.ends(publisher)


def test_a_monitor_without_end_faults_and_its_messages_are_dropped(world: Monitored) -> None:
    """The relay goes on; a flood of them does not hold it up."""
    world.load(GUARD)
    publisher, subscriber = world.typed()
    publisher.send(string("loop") + string("after"))
    world.gets(subscriber, string("after"))
    fault = world.event("fault", monitor="guard")
    assert "processor time" in fault.text
    assert fault.detail["file"] == "0.rv"
    world.push(publisher, string("loop") * 200)
    publisher.send(string("later"))
    world.gets(subscriber, string("later"))


def test_ticks_that_take_longer_than_their_period_do_not_starve_the_relay(world: Monitored) -> None:
    """Each would find more of them late than the one before: they are left out, told, and everything else goes on."""
    slow = "slow() { int n; event tick() every 1ms { for (int i = 0; i < 60000; i++) n += i; } }"
    world.load(slow)
    longest = 0.0
    ends = time.thread_time() + 1.5
    while time.thread_time() < ends:
        began = time.thread_time()
        world.loop.turn(0.01)
        longest = max(longest, time.thread_time() - began)
    assert longest < 0.6
    assert "they take too long" in world.event("log", monitor="slow").text


def test_messages_that_do_not_fit_into_a_quantum_are_left_for_the_next_turn(world: Monitored) -> None:
    """In order and unchanged, while those before them go on."""
    world.load(COSTLY)
    lane = world.engine.middle.lane(Place("k", "/chatter"))
    frames = bytearray(string("x" * 3000) + string("last") * 3)
    batch = Batch(memoryview(frames), 4, None)
    batch.first = 7
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(world.engine.middle, "over", lambda: True)
        left = lane.through(batch)
    assert left is not None
    assert (left.messages, bytes(left.view)) == (1, string("x" * 3000))
    rest = batch.tail(batch.left)
    assert (rest.first, rest.messages, bytes(rest.view)) == (8, 3, string("last") * 3)


def test_a_message_that_takes_longer_than_the_budget_is_a_fault(world: Monitored) -> None:
    """It is dropped, and the record says how much was exceeded; the next ones have a tenth for a second."""
    world.load(COSTLY)
    publisher, subscriber = world.typed()
    publisher.send(string("x" * 500_000) + string("after"))
    world.gets(subscriber, string("after"))
    fault = world.event("fault", monitor="a")
    assert "ms of processor time for one message" in fault.text
    assert fault.detail["file"] == "0.rv"


def test_hosts_that_the_policy_does_not_name_have_one_pace(world: Monitored) -> None:
    """One that sent a message that took all of its time slows down the messages of all of them, and no others."""
    middle = world.engine.middle
    for key, host, named in (("a", "10.9.0.1", False), ("b", "10.9.0.2", False), ("c", "10.0.0.1", True)):
        world.state(NodePlaced(key, "/node", host), world.listen())
        world.state(PublicationPlaced(key, "/t", "*", named=named))
    one, other, robot = (Place("k", "/t", host) for host in ("10.9.0.1", "10.9.0.2", "10.0.0.1"))
    middle.pace(one).cut(1)
    assert [middle.pace(place).part(2) for place in (one, other, robot)] == [0.1, 0.1, 1]
    middle.pace(robot).cut(1)
    assert [middle.pace(place).part(2) for place in (robot, robot._replace(resource="/u"))] == [0.1, 1]


def test_what_is_left_of_a_read_outlives_other_specifications_and_comes_in_order(world: Monitored) -> None:
    """Messages that wait for their turn are judged by what is in force then; none is lost or overtaken."""
    world.load(COSTLY)
    publisher, subscriber = world.typed()
    many = [string(f"{number:05}" + "x" * 100) for number in range(3000)]
    world.engine.middle.over = lambda: True
    world.push(publisher, b"".join(many))
    world.loop.turn(0.01)
    world.load(COSTLY.replace("i < s.size()", "i < 0"), revision=2)
    world.gets(subscriber, b"".join(many))


def test_what_is_left_of_a_read_ends_with_the_publication(world: Monitored) -> None:
    """It is withdrawn while messages wait for their turn: they are forgotten, and the memory they took."""
    world.load(COSTLY)
    publisher, subscriber = world.typed()
    world.engine.middle.over = lambda: True
    world.push(publisher, string("x" * 100) * 3000)
    world.until(lambda: world.held)
    world.state(PublicationWithdrawn("k", "/chatter"))
    world.ends(subscriber)
    assert world.held == 0


def test_bytes_that_are_no_message_of_the_type_are_dropped(world: Monitored) -> None:
    """With the fault recorded."""
    world.load(GUARD)
    publisher, subscriber = world.typed()
    publisher.send(
        encode_frame(b"\xff\xff\xff\xff") + encode_frame(b"") + encode_frame(b"\x01") + string("a")
    )
    world.gets(subscriber, string("a"))
    assert "not a message of this type" in world.event("fault").text


def test_a_defect_of_the_monitors_drops_the_message_and_nothing_else(
    world: Monitored, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even one that is ours."""
    world.load(GUARD)
    publisher, subscriber = world.typed()
    monitors = world.engine.middle.monitors
    assert monitors is not None
    monkeypatch.setattr(monitors, "process", lambda *_args: 1 / 0)
    publisher.send(string("a"))
    assert "a defect of rosrv" in world.event("fault").text
    monkeypatch.undo()
    publisher.send(string("b"))
    world.gets(subscriber, string("b"))


def test_a_large_message_goes_through_a_monitor(world: Monitored) -> None:
    """Unchanged, changed and dropped ones alike."""
    spec = GUARD.replace('text == "bad"', "text.size() == 300000").replace(
        'text == "one"', "text.size() == 400000"
    )
    world.load(spec)
    publisher, subscriber = world.typed()
    for size, back in ((300_000, None), (400_000, "two"), (500_000, "x" * 500_000)):
        world.push(publisher, string("x" * size))
        if back is not None:
            world.gets(subscriber, string(back))


ALARM = """
alarm() {
    std_msgs::String text;
    event said(std::string t) /chatter std_msgs/String '{data:t}' {
        if (t == "bad") { text.data = "alarm"; PUBLISH(/alarm, std_msgs/String, text); return; }
    }
    event tick() every 50ms { text.data = "tick"; PUBLISH(/alarm, std_msgs/String, text); }
}
"""


def test_what_monitors_publish_is_served_by_the_appliance_and_given_to_no_monitor(world: Monitored) -> None:
    """With the header of the specification's definition, to who has a grant; timers go on without messages."""
    hearer = GUARD.replace("/chatter", "/alarm")
    world.load(ALARM, hearer)
    port = world.listen()
    world.state(NodePlaced("own", "/rosrv", LOOPBACK, monitors=True), port)
    world.state(PublicationPlaced("own", "/alarm", "std_msgs/String"))
    world.state(GrantInstalled("own", "/alarm", LOOPBACK, "/listener"))
    world.port = port
    subscriber = world.connect(encode_header(WANTED | {"topic": "/alarm"}))
    header = world.gets_header(subscriber)
    assert (header["callerid"], header["md5sum"], header["type"]) == (
        "/rosrv",
        STRING_MD5,
        "std_msgs/String",
    )
    assert header["message_definition"].startswith("string data")
    world.until(lambda: len(data_of(subscriber)) >= 2 * len(string("tick")))
    assert subscriber.data.startswith(string("tick") * 2)
    publisher = world.upstream(TYPED)
    publisher.send(string("bad"))
    world.until(lambda: string("alarm") in data_of(subscriber))
    assert world.event("publish", resource="/alarm").monitor == "alarm"


def test_a_hold_specification_blocks_its_topics_after_a_restart_until_it_is_resumed(world: Monitored) -> None:
    """At a first start it does not."""
    taken = world.load("hold " + GUARD.strip(), restarted=True)
    assert taken.held == ["guard"]
    publisher, subscriber = world.typed()
    publisher.send(string("a"))
    drop = world.event("drop")
    assert drop.monitor == "guard"
    assert drop.text.startswith("guard holds its topics until it is resumed (the relay process before")
    world.state(MonitorResumed("guard"))
    publisher.send(string("b"))
    world.gets(subscriber, string("b"))
    other = Monitored()
    assert other.load("hold " + GUARD.strip()).held == []
    other.close()


def test_a_latched_message_that_was_kept_back_comes_when_the_monitor_lets_it(world: Monitored) -> None:
    """Its publisher says it once and to whoever connects: a held topic would stay without it after `resume`."""
    latching = TYPED | {"latching": "1"}
    world.load("hold " + GUARD.strip(), restarted=True)
    subscriber = world.connect(encode_header(WANTED))
    publisher = world.upstream(latching)
    assert world.gets_header(subscriber)["latching"] == "1"
    publisher.send(string("map"))
    world.event("drop")
    world.state(MonitorResumed("guard"))
    again = world.upstream(latching)
    again.send(string("map"))
    world.gets(subscriber, string("map"))
    world.load("hold " + GUARD.strip().replace("longer", "wider"), revision=2)
    world.state(MonitorResumed("guard"))
    again.send(string("next"))
    world.gets(subscriber, string("next"))


def test_a_latched_message_that_a_monitor_dropped_comes_when_it_is_replaced(world: Monitored) -> None:
    """Also to subscribers that are there already; without a drop no connection is made anew."""
    latching = TYPED | {"latching": "1"}
    world.load(GUARD)
    subscriber = world.connect(encode_header(WANTED))
    publisher = world.upstream(latching)
    world.gets_header(subscriber)
    publisher.send(string("bad"))
    world.event("drop")
    world.load(BEGINNING.replace('"bad"', '"worse"'), revision=2)
    again = world.upstream(latching)
    again.send(string("bad"))
    world.gets(subscriber, string("bad"))


def test_a_change_of_other_monitors_gives_no_latched_message_again(world: Monitored) -> None:
    """Neither a load, a refused one, a switch nor a resumption; one of the monitors of the topic does."""
    latching = TYPED | {"latching": "1"}
    other = "other() { event e() /elsewhere std_msgs/String '{}' { } }"
    held = "hold other() { event e() /elsewhere std_msgs/String '{}' { return; } }"
    world.load(GUARD, other)
    world.connect(encode_header(WANTED))
    publisher = world.upstream(latching)
    publisher.send(string("bad"))
    world.event("drop")
    world.load(GUARD, held, revision=2)
    world.load(GUARD, held, revision=2, other=False)
    world.load(GUARD, "nonsense", revision=3)
    world.state(MonitorSwitched("other", True))
    world.state(MonitorResumed("other"))
    world.load(GUARD, revision=4)
    assert not [one for one in world.told if isinstance(one, UpstreamWanted)]
    world.state(MonitorSwitched("guard", False))
    world.upstream(latching)


LATCH = """
gate() {
    bool open = false;
    event ask(bool wish) service /mode std_srvs/SetBool request '{data:wish}' {
        if (open) { ROS_WARN("it is open"); return; }
        open = wish;
    }
}
"""
BUTTON = """
latch() {
    event press() /mode std_msgs/String '{}' { }
    fsm : start [ press -> pressed ] pressed [ press -> pressed ]
    @pressed { ROS_ERROR("pressed"); }
}
"""


def test_a_verdict_is_told_with_its_property_logic_and_category(world: Monitored) -> None:
    """And counted for the state of the monitors."""
    world.load(BUTTON.replace("/mode", "/chatter"))
    publisher, subscriber = world.typed()
    publisher.send(string("a") * 3)
    world.gets(subscriber, string("a") * 3)
    verdict = world.event("verdict", monitor="latch", count=0)
    assert verdict.detail["logic"] == "fsm"
    assert verdict.detail["category"] == "pressed"
    again = world.event("verdict", count=2)
    assert (again.monitor, again.text, again.detail) == ("latch", verdict.text, {"category": "pressed"})

    def counted() -> Any:
        rows = [row for one in world.told if isinstance(one, MonitorsCounted) for row in one.rows]
        return [row for row in rows if (row.events, row.verdicts, row.enabled) == (3, 3, True)]

    world.until(counted)


def _called(world: Monitored, persistent: bool = True) -> tuple[Peer, Peer]:
    """A client and its connection at the service."""
    fields = {"callerid": "/client", "service": "/mode", "md5sum": "*"}
    client = world.connect(encode_header(fields | ({"persistent": "1"} if persistent else {})))
    service = world.accept(world.service)
    world.gets_header(service)
    service.send(encode_header({"callerid": "/talker", "type": "std_srvs/SetBool", "md5sum": SET_BOOL_MD5}))
    assert world.gets_header(client)["md5sum"] == SET_BOOL_MD5
    return client, service


def test_a_request_that_is_refused_never_reaches_the_service(world: Monitored) -> None:
    """The client reads the reason as an error of the service; the next request is judged anew."""
    assert isinstance(world.load(LATCH), SpecificationsTaken)
    client, service = _called(world)
    client.send(encode_frame(b"\x01"))
    world.gets(service, encode_frame(b"\x01"))
    answer = encode_service_reply(b"\x01" + struct.pack("<I", 0))
    service.send(answer)
    world.gets(client, answer)
    client.send(encode_frame(b"\x01"))
    world.gets(client, encode_service_error("the request is refused by the monitor gate: it is open"))
    drop = world.event("drop", resource="/mode")
    assert (drop.monitor, drop.host, drop.caller_id) == ("gate", LOOPBACK, "/client")
    assert not service.data
    once, _service = _called(world, persistent=False)
    once.send(encode_frame(b"\x00"))
    assert b"it is open" in world.ends(once)


def test_the_client_of_a_service_reads_why_its_request_could_not_be_judged(world: Monitored) -> None:
    """The fault, as well as what a monitor says; services whose monitors are off are not judged."""
    world.load(LATCH.replace("open = wish;", "int zero = 0; open = 1 / zero;"))
    middle = world.engine.middle
    refused = middle.request(Place("k", "/mode"), b"\0").refused
    assert refused == "the request is refused by the monitor gate: division by zero"
    world.state(MonitorSwitched("gate", False))
    assert middle.request(Place("k", "/mode"), b"\0").refused is None


def test_a_service_with_another_definition_is_refused(world: Monitored) -> None:
    """The client reads why."""
    world.load(LATCH)
    client = world.connect(encode_header({"callerid": "/client", "service": "/mode", "md5sum": "*"}))
    service = world.accept(world.service)
    world.gets_header(service)
    service.send(encode_header({"callerid": "/talker", "type": "x/Y", "md5sum": "0"}))
    assert "std_srvs/SetBool" in world.gets_header(client)["error"]
    world.hears(PublicationRefused, resource="/mode")


def test_what_happens_without_a_control_is_told_to_the_next_one(world: Monitored) -> None:
    """Nothing of it is lost."""
    world.load(GUARD)
    publisher, subscriber = world.typed()
    world.engine.attach(None)
    publisher.send(string("bad") + string("a"))
    world.gets(subscriber, string("a"))
    world.link.close()
    world.control.close()
    world.connect_control()
    world.state(stated(1, [("0.rv", GUARD)], {}, {}, True))
    assert world.event("drop", count=0).monitor == "guard"


def test_nothing_is_lost_while_specifications_come_and_go(world: Monitored) -> None:
    """Compiled beside the loop and swapped between two messages: each message once, in order."""
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


def test_a_monitor_that_is_replaced_counts_anew_and_not_what_its_predecessor_saw(world: Monitored) -> None:
    """Also what had not been summed up when it came; one that stays goes on counting."""
    other = "other() { event e() /chatter std_msgs/String '{}' { } }"
    world.load(other, GUARD)
    publisher, subscriber = world.typed()
    for text in ("one", "one", "bad"):
        publisher.send(string(text))
    world.until(lambda: data_of(subscriber).count(b"two") == 2)
    world.load(other, BEGINNING.replace("a longer text", "another text"), revision=2)
    publisher.send(string("one"))

    def counted() -> dict[str, tuple[int, int, int]]:
        found = [message.rows for message in world.told if isinstance(message, MonitorsCounted)]
        return {row.name: (row.events, row.changes, row.drops) for row in found[-1]} if found else {}

    world.until(lambda: counted().get("guard", (0, 0, 0))[0] == 1)
    assert counted() == {"guard": (1, 1, 0), "other": (4, 0, 0)}


def test_a_monitor_that_comes_from_another_relay_holds_its_topics_if_it_is_declared_so(
    world: Monitored,
) -> None:
    """It begins in its initial state here, as after a restart; others of the same text do not."""
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
    """So no load forgets an emergency stop; what had not left its beginning, or is declared `begin`, goes on."""
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


def test_a_verdict_says_who_and_which_messages_made_it_so(world: Monitored) -> None:
    """Those that alone give it, by name, though others came between and most went through the module."""
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
    """A host with a registration is told apart; all other hosts are one."""
    middle = world.engine.middle
    world.state(NodePlaced("robot", "/robot", "10.0.0.1"), world.listen())
    numbers = [middle.senders.number(Place("k", "/t", host)) for host in ("10.0.0.1", "10.0.0.8", "10.0.0.9")]
    assert [middle.holder_of(number) for number in (*numbers, 999)] == ["10.0.0.1", "", "", ""]


def test_each_binding_has_its_deadline_in_the_relay(world: Monitored) -> None:
    """A name that is not said again in time is told of, though no message comes: each with its binding."""
    text = """again(std::string name) {
        event said(std::string name) /chatter std_msgs/String '{data:name}' { }
        pattern: globally: said causes said within 50ms @violation { ROS_ERROR("%s is late", name.c_str()); __RESET; }
    }"""
    assert world.load(text) == SpecificationsTaken(1, ["again"], [])
    publisher, _ = world.typed()
    publisher.send(string("one") + string("two"))
    for name in ("one", "two"):
        assert world.event("log", monitor="again", text=f"{name} is late")
