"""Monitors on trial in the whole relay: messages go on as if they were not there, and what they say is told as such."""

import time
from collections.abc import Iterator

import pytest

from appliance.channel.messages import (
    MonitorRow,
    MonitorsCounted,
    MonitorsReported,
    PublicationRefused,
    SpecificationsTaken,
)
from appliance.relay.monitors import shadow
from roswire.tcpros import encode_frame, encode_header, encode_service_reply
from tests.support.stated import stated
from tests.unit.relay.monitors.test_interceptor import (
    GUARD,
    TYPED,
    WANTED,
    Monitored,
    _called,
    data_of,
    string,
)


class Trying(Monitored):
    """A relay whose control states specifications, some of them on trial."""

    def state_trials(self, *texts: str, tried: tuple[str, ...] = (), revision: int = 1) -> list[str]:
        """State these; those that began."""
        files = [(f"{number}.rv", text) for number, text in enumerate(texts)]
        self.state(stated(revision, files, {}, {}, False, trials=tried))
        taken: SpecificationsTaken = self.until(lambda: self.taken(SpecificationsTaken, revision))
        return taken.began

    def row(self, name: str) -> MonitorRow:
        """The counters of a monitor, as control was told last."""
        self.engine.middle.observations.tell_counters()
        self.link.catch_up()

        def last() -> MonitorRow | None:
            rows = [row for one in self.told if isinstance(one, MonitorsCounted) for row in one.rows]
            return next((row for row in reversed(rows) if row.name == name), None)

        found: MonitorRow = self.until(last)
        return found

    def kinds(self) -> set[str]:
        """What control was told that monitors did."""
        return {event.kind for one in self.told if isinstance(one, MonitorsReported) for event in one.events}


@pytest.fixture
def world() -> Iterator[Trying]:
    """A relay with one node."""
    world = Trying()
    yield world
    world.close()


def test_what_it_would_have_done_is_told_and_not_done(world: Trying) -> None:
    """With the messages it was about, their numbers and who said them; nothing of it is a drop or a change."""
    assert world.state_trials(GUARD, tried=("guard",)) == ["guard"]
    publisher, subscriber = world.typed()
    frames = b"".join(map(string, ("a", "bad", "one", "long", "z")))
    publisher.send(frames)
    world.gets(subscriber, frames)
    drop = world.event("trial drop", monitor="guard", count=0)
    assert (drop.resource, drop.before, drop.detail["number"]) == ("/chatter", string("bad")[4:], 2)
    assert (drop.text, drop.caller_id) == ("guard.said dropped it: no such word", "/talker")
    change = world.event("trial change", monitor="guard", count=0)
    assert (change.before, change.after) == (string("one")[4:], string("two")[4:])
    assert change.detail["number"] == 3
    assert world.event("trial log", monitor="guard").text == "no such word"
    world.event("trial change", count=1)
    row = world.row("guard")
    assert (row.trial, row.enabled, row.drops, row.changes, row.missed) == (True, True, 1, 2, 0)
    assert all(kind.startswith("trial ") for kind in world.kinds())


def test_it_is_promoted_between_two_messages_with_its_state_and_goes_back_on_trial(world: Trying) -> None:
    """The counters are of the trial or of what was done, never of both."""
    world.state_trials(GUARD, tried=("guard",))
    publisher, subscriber = world.typed()
    publisher.send(string("bad") + string("count"))
    world.gets(subscriber, string("bad") + string("count"))
    assert world.state_trials(GUARD, revision=2) == []
    publisher.send(string("bad") + string("count"))
    world.gets(subscriber, string("4"))
    assert world.event("drop", monitor="guard", count=0).detail["number"] == 3
    row = world.row("guard")
    assert (row.trial, row.drops, row.changes) == (False, 1, 1)
    assert world.state_trials(GUARD, tried=("guard",), revision=3) == []
    publisher.send(string("count"))
    world.gets(subscriber, string("count"))
    world.event("trial change")
    assert world.row("guard").trial
    assert world.state_trials(GUARD, revision=4) == []
    publisher.send(string("count"))
    world.gets(subscriber, string("6"))


def test_messages_that_wait_are_given_before_it_is_promoted(
    world: Trying, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So what it has seen is complete."""
    world.state_trials(GUARD, tried=("guard",))
    publisher, subscriber = world.typed()
    middle = world.engine.middle
    monkeypatch.setattr(middle.trials, "have_turn", lambda: None)  # it never has its turn
    publisher.send(string("a") * 3)
    world.gets(subscriber, string("a") * 3)
    assert len(middle.trials.waiting) == 3
    monkeypatch.undo()
    assert world.state_trials(GUARD, revision=2) == []
    publisher.send(string("count"))
    world.gets(subscriber, string("4"))


def test_a_loop_without_end_delays_and_drops_nothing(world: Trying, monkeypatch: pytest.MonkeyPatch) -> None:
    """It ends at a tenth of what others may take, once in a second; what it saw is not complete: it begins anew."""
    world.state_trials(GUARD, tried=("guard",))
    publisher, subscriber = world.typed()
    monkeypatch.setattr(shadow.Trials, "tick", lambda _self: None)  # the second is not over
    for _ in range(20):
        publisher.send(string("loop") + string("bad"))
    world.gets(subscriber, (string("loop") + string("bad")) * 20)
    assert "of processor time for one message" in world.event("trial fault", monitor="guard", count=0).text
    assert "one on trial may not take" in world.event("trial missed", monitor="guard", count=0).text
    world.until(lambda: not world.engine.middle.trials.waiting)
    monkeypatch.undo()
    world.engine.middle.trials.tick()
    row = world.row("guard")
    assert (row.events, row.missed, row.drops) == (1, 40, 0)
    assert world.state_trials(GUARD, revision=2) == ["guard"]
    publisher.send(string("count"))
    world.gets(subscriber, string("1"))


def test_ticks_without_end_rest_for_the_second(world: Trying, monkeypatch: pytest.MonkeyPatch) -> None:
    """One is tried, and the loop goes on; another when the second is over."""
    monkeypatch.setattr(shadow.Trials, "tick", lambda _self: None)
    text = "s() { int n = 0; event tick() every 1ms { while (true) { n = n; } } }"
    world.state_trials(text, tried=("s",))
    assert "one on trial may not take" in world.event("trial missed", monitor="s").text
    turned: list[bool] = []
    world.loop.after(0.1, lambda: turned.append(True))
    world.until(lambda: turned)
    assert world.row("s").missed == 1
    monkeypatch.undo()
    world.engine.middle.trials.tick()
    world.until(lambda: world.row("s").missed > 1)


def test_trials_have_a_share_of_the_processor_and_no_more(
    world: Trying, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is beyond it they are not given; messages go on."""
    world.state_trials(GUARD, tried=("guard",))
    publisher, subscriber = world.typed()
    thread_time, more = time.thread_time, [0.0]

    def slow() -> float:
        more[0] += 0.03
        return thread_time() + more[0]

    monkeypatch.setattr("appliance.relay.monitors.shadow.time.thread_time", slow)
    monkeypatch.setattr(shadow.Trials, "tick", lambda _self: None)  # the second is not over
    publisher.send(string("a") * 100)
    world.gets(subscriber, string("a") * 100)
    world.until(lambda: not world.engine.middle.trials.waiting)
    monkeypatch.undo()
    world.engine.middle.trials.tick()
    row = world.row("guard")
    assert row.events + row.missed == 100
    assert 0 < row.events < 10
    assert "take more than 20%" in world.event("trial missed", count=0).text


def test_what_waits_is_bounded(world: Trying, monkeypatch: pytest.MonkeyPatch) -> None:
    """More messages than can be kept are missed by the trial, not by the subscriber."""
    monkeypatch.setattr(shadow, "_MOST_WAITING", 5)
    world.state_trials(GUARD, tried=("guard",))
    publisher, subscriber = world.typed()
    publisher.send(string("a") * 30)
    world.gets(subscriber, string("a") * 30)
    assert "more messages wait" in world.event("trial missed", count=0).text


def test_a_defect_in_it_ends_no_message(world: Trying) -> None:
    """An exception that no action explains is told, and the relay goes on."""
    world.state_trials(GUARD, tried=("guard",))
    publisher, subscriber = world.typed()
    assert world.engine.middle.monitors is not None
    (trial,) = world.engine.middle.monitors.trials
    trial.steps = {"/chatter": (None,)}  # type: ignore[dict-item]  # the defect
    publisher.send(string("a"))
    world.gets(subscriber, string("a"))
    assert "a defect of rosrv" in world.event("trial fault").text
    assert world.row("guard").missed == 1


def test_a_publisher_with_another_definition_is_not_refused_for_its_sake(world: Trying) -> None:
    """It is not given what it would not understand, and that is told."""
    world.state_trials(GUARD, tried=("guard",))
    publisher, subscriber = world.subscribed()
    publisher.send(string("bad"))
    world.gets(subscriber, string("bad"))
    assert "std_msgs/String" in world.event("trial missed", monitor="guard").text
    assert not [one for one in world.told if isinstance(one, PublicationRefused)]
    assert not world.row("guard").events
    world.state_trials(GUARD, revision=2)
    world.hears(PublicationRefused, key="k", resource="/chatter")
    world.ends(publisher)


def test_it_hears_a_topic_that_nobody_subscribes_to_and_its_ticks(world: Trying) -> None:
    """As an enabled one does; and what it would have published nobody gets."""
    text = """s() { std_msgs::String said; event e(std::string t) /chatter std_msgs/String '{data:t}' {
        said.data = t; PUBLISH(/alarm, std_msgs/String, said); } event tick() every 10ms { ROS_INFO("tick"); } }"""
    world.state_trials(text, tried=("s",))
    publisher = world.upstream(TYPED)
    publisher.send(string("fire"))
    published = world.event("trial publish", monitor="s")
    assert (published.resource, published.after) == ("/alarm", string("fire")[4:])
    assert world.event("trial log", monitor="s").text == "tick"


def test_what_it_would_have_published_at_a_deadline_is_told(world: Trying) -> None:
    """Without another message."""
    text = """s() { std_msgs::String said; warn() { said.data = "late"; PUBLISH(/alarm, std_msgs/String, said); }
        event e() /chatter std_msgs/String '{}' { } event done() /done std_msgs/String '{}' { }
        pattern: globally: e causes done within 10ms enforced by warn @violation { } }"""
    world.state_trials(text, tried=("s",))
    publisher = world.upstream(TYPED)
    publisher.send(string("fire"))
    published = world.event("trial publish", monitor="s")
    assert (published.resource, published.after) == ("/alarm", string("late")[4:])
    assert world.event("trial verdict", monitor="s").detail["category"] == "enforced"


def test_requests_and_replies_pass_as_they_are(world: Trying) -> None:
    """What it would have refused is told."""
    text = """s() { event ask(bool on) service /mode std_srvs/SetBool request '{data:on}' { if (on) { return; } }
        event told(std::string m) service /mode std_srvs/SetBool response '{message:m}' { m = "changed"; } }"""
    world.state_trials(text, tried=("s",))
    client, service = _called(world)
    client.send(encode_frame(b"\x01"))
    world.gets(service, encode_frame(b"\x01"))
    reply = encode_service_reply(b"\x01" + string("as it was")[4:])
    service.send(reply)
    world.gets(client, reply)
    assert world.event("trial drop", monitor="s").resource == "/mode"
    assert world.event("trial change", monitor="s").resource == "/mode"
    assert data_of(client) == b""


def test_a_late_subscriber_of_a_latched_topic_gets_what_was_said(world: Trying) -> None:
    """Nothing is kept back on trial; once it is promoted, the last message is as it was when it came."""
    world.state_trials(GUARD, tried=("guard",))
    publisher = world.upstream(TYPED | {"latching": "1"})
    publisher.send(string("one"))
    world.event("trial change")
    subscriber = world.connect(encode_header(WANTED))
    world.gets_header(subscriber)
    world.gets(subscriber, string("one"))
