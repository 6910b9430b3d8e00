import random
import time
from collections.abc import Iterator
from typing import Any

import pytest

from appliance.channel.messages import (
    FactWithdrawn,
    MonitorRow,
    MonitorsCounted,
    MonitorsReported,
    NodePlaced,
    PublicationPlaced,
    SpecificationsTaken,
    UpstreamFound,
    UpstreamWanted,
)
from appliance.relay.monitors import shadow
from appliance.relay.monitors.observation_points import ObservationPoint
from appliance.relay.monitors.observer import Observer
from roswire.tcpros import encode_header
from tests.support.stated import stated
from tests.unit.relay.monitors.monitored import (
    GUARD,
    TYPED,
    Monitored,
    string,
)
from tests.unit.relay.world import LOOPBACK, Peer

pytestmark = pytest.mark.usefixtures("sockets")


class Trying(Monitored):
    def state_shadows(self, *texts: str, shadowed: tuple[str, ...] = (), revision: int = 1) -> list[str]:
        files = [(f"{number}.rv", text) for number, text in enumerate(texts)]
        self.state(stated(revision, files, {}, {}, False, shadows=shadowed))
        taken: SpecificationsTaken = self.until(lambda: self.taken(SpecificationsTaken, revision))
        return taken.began

    def row(self, name: str) -> MonitorRow:
        self.engine.interceptor.observations.tell_counters()
        self.link.catch_up()

        def last() -> MonitorRow | None:
            rows = [row for one in self.told if isinstance(one, MonitorsCounted) for row in one.rows]
            return next((row for row in reversed(rows) if row.name == name), None)

        monitor_row: MonitorRow = self.until(last)
        return monitor_row

    def kinds(self) -> set[str]:
        return {event.kind for one in self.told if isinstance(one, MonitorsReported) for event in one.events}


@pytest.fixture
def world() -> Iterator[Trying]:
    world = Trying()
    yield world
    world.close()


def test_waiting_messages_are_judged_before_it_is_promoted(
    world: Trying, monkeypatch: pytest.MonkeyPatch
) -> None:
    world.state_shadows(GUARD, shadowed=("guard",))
    publisher, subscriber = world.typed()
    interceptor = world.engine.interceptor
    monkeypatch.setattr(interceptor.shadow, "have_turn", lambda: None)  # the monitor never gets its turn
    publisher.send(string("a") * 3)
    world.gets(subscriber, string("a") * 3)
    assert len(interceptor.shadow.waiting) == 3
    monkeypatch.undo()
    assert world.state_shadows(GUARD, revision=2) == []
    publisher.send(string("count"))
    world.gets(subscriber, string("4"))


@pytest.mark.nightly
def test_a_loop_without_end_delays_and_drops_nothing(world: Trying, monkeypatch: pytest.MonkeyPatch) -> None:
    world.state_shadows(GUARD, shadowed=("guard",))
    publisher, subscriber = world.typed()
    monkeypatch.setattr(shadow.ShadowMonitors, "tick", lambda _self: None)  # the second is not over
    for _ in range(20):
        publisher.send(string("loop") + string("bad"))
    world.gets(subscriber, (string("loop") + string("bad")) * 20)
    assert "of processor time for one message" in world.event("shadow fault", monitor="guard", count=0).text
    assert "the limit in shadow mode" in world.event("shadow missed", monitor="guard", count=0).text
    world.until(lambda: not world.engine.interceptor.shadow.waiting)
    monkeypatch.undo()
    world.engine.interceptor.shadow.tick()
    row = world.row("guard")
    assert (row.events, row.missed, row.drops) == (1, 40, 0)
    assert world.state_shadows(GUARD, revision=2) == ["guard"]
    publisher.send(string("count"))
    world.gets(subscriber, string("1"))


def test_ticks_without_end_rest_for_the_second(world: Trying, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shadow.ShadowMonitors, "tick", lambda _self: None)
    text = "s() { int n = 0; event tick() every 1ms { while (true) { n = n; } } }"
    world.state_shadows(text, shadowed=("s",))
    assert "the limit in shadow mode" in world.event("shadow missed", monitor="s").text
    turned: list[bool] = []
    world.loop.after(0.1, lambda: turned.append(True))
    world.until(lambda: turned)
    assert world.row("s").missed == 1
    monkeypatch.undo()
    world.engine.interceptor.shadow.tick()
    world.until(lambda: world.row("s").missed > 1)


def test_shadow_mode_has_a_bounded_part_of_the_processor(
    world: Trying, monkeypatch: pytest.MonkeyPatch
) -> None:
    world.state_shadows(GUARD, shadowed=("guard",))
    publisher, subscriber = world.typed()
    thread_time, more = time.thread_time, [0.0]

    def slow() -> float:
        more[0] += 0.03
        return thread_time() + more[0]

    monkeypatch.setattr("appliance.relay.monitors.shadow.time.thread_time", slow)
    monkeypatch.setattr(shadow.ShadowMonitors, "tick", lambda _self: None)  # the second is not over
    publisher.send(string("a") * 100)
    world.gets(subscriber, string("a") * 100)
    world.until(lambda: not world.engine.interceptor.shadow.waiting)
    monkeypatch.undo()
    world.engine.interceptor.shadow.tick()
    row = world.row("guard")
    assert row.events + row.missed == 100
    assert 0 < row.events < 10
    assert "take more than 20%" in world.event("shadow missed", count=0).text


def test_waiting_messages_are_bounded(world: Trying, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shadow, "_MAX_WAITING", 5)
    world.state_shadows(GUARD, shadowed=("guard",))
    publisher, subscriber = world.typed()
    publisher.send(string("a") * 30)
    world.gets(subscriber, string("a") * 30)
    assert "queue for monitors in shadow mode is full" in world.event("shadow missed", count=0).text


def test_each_message_that_is_missed_has_the_reason_of_the_rest(
    world: Trying, monkeypatch: pytest.MonkeyPatch
) -> None:
    reasons: list[str] = []
    missed = Observer.missed

    def noted(
        self: Observer, monitor: str, point: ObservationPoint, time: int, text: str, *rest: Any
    ) -> None:
        reasons.append(text)
        missed(self, monitor, point, time, text, *rest)

    monkeypatch.setattr(Observer, "missed", noted)
    monkeypatch.setattr(shadow.ShadowMonitors, "tick", lambda _self: None)
    world.state_shadows(GUARD, shadowed=("guard",))
    publisher, subscriber = world.typed()
    for _ in range(5):
        publisher.send(string("loop"))
    world.gets(subscriber, string("loop") * 5)
    world.until(lambda: len(reasons) == 5)
    assert all("the limit in shadow mode" in reason for reason in reasons), reasons


def test_a_defect_in_it_ends_no_message(world: Trying) -> None:
    world.state_shadows(GUARD, shadowed=("guard",))
    publisher, subscriber = world.typed()
    assert world.engine.interceptor.monitors is not None
    (shadow,) = world.engine.interceptor.monitors.shadows
    shadow.steps = {"/chatter": (None,)}  # type: ignore[dict-item]  # the defect
    publisher.send(string("a"))
    world.gets(subscriber, string("a"))
    assert "a defect of rosrv" in world.event("shadow fault").text
    assert world.row("guard").missed == 1


class Publisher:
    """A node that publishes /chatter, of a type that a monitor in shadow mode can read or of another one."""

    def __init__(self, world: Trying, key: str) -> None:
        self.world, self.key = world, key
        self.listening = world.listen()
        world.state(NodePlaced(key, f"/{key}", LOOPBACK), world.listen())
        self.fits = False
        self.peer: Peer | None = None

    def leave(self) -> None:
        if self.peer is not None:
            self.world.state(FactWithdrawn(("publication", self.key, "/chatter")))
            self.world.ends(self.peer)
            self.peer = None

    def connect(self, *, fits: bool) -> None:
        """Publish with this type; a publisher that is connected loses its connection, and returns with it."""
        world, self.fits = self.world, fits
        if self.peer is None:
            world.state(PublicationPlaced(self.key, "/chatter", "*"))
        else:
            self.peer.sock.close()
        world.hears(UpstreamWanted, key=self.key)
        world.state(UpstreamFound(self.key, "/chatter", LOOPBACK, self.listening.getsockname()[1]))
        self.peer = world.accept(self.listening)
        world.gets_header(self.peer)
        self.peer.send(encode_header(TYPED if fits else TYPED | {"type": "my/Label", "md5sum": "f" * 32}))

    def send(self) -> None:
        if self.peer is not None:
            topic = self.world.engine.topics[self.key, "/chatter"]
            before = topic.counters.following
            self.peer.send(string("bad"))
            self.world.until(lambda: topic.counters.following > before)


@pytest.mark.parametrize("seed", range(6))
def test_it_gets_exactly_the_messages_of_the_publishers_that_it_can_read(world: Trying, seed: int) -> None:
    chance = random.Random(seed)  # noqa: S311  the same story in every run
    revision, read, missed = 1, 0, 0
    world.state_shadows(GUARD, shadowed=("guard",))
    world.state(FactWithdrawn(("publication", "k", "/chatter")))
    publishers = [Publisher(world, f"p{number}") for number in range(3)]
    for _ in range(25):
        publisher = chance.choice(publishers)
        match chance.choice(("connect", "connect", "leave", "reload", "switch")):
            case "connect":
                publisher.connect(fits=chance.random() < 0.5)
            case "leave":
                publisher.leave()
            case "reload":
                revision += 1
                other = f"other() {{ int n = {revision}; event tick() every 1s {{ }} }}"
                assert "guard" not in world.state_shadows(
                    GUARD, other, shadowed=("guard",), revision=revision
                )
            case _:
                world.engine.interceptor.switch("guard", enabled=False)
                world.engine.interceptor.switch("guard", enabled=True)
        for sender in publishers:
            sender.send()
        read += sum(sender.peer is not None and sender.fits for sender in publishers)
        missed += sum(sender.peer is not None and not sender.fits for sender in publishers)
        world.until(lambda: not world.engine.interceptor.shadow.waiting)
        row = world.row("guard")
        assert (row.events, row.missed) == (read, missed)
    assert read
    assert missed
