import socket
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from appliance.channel.channel import Channel
from appliance.channel.messages import (
    ConnectionClosed,
    ConnectionOpened,
    ConnectionRefused,
    MessagesLimited,
    RelayLink,
    TopicTraffic,
    TrafficReported,
)
from appliance.relay.loop import EventLoop
from appliance.relay.relay_limits import RelayLimits
from appliance.relay.report import Reporter
from appliance.relay.transport.loop_channel import LoopLink

pytestmark = pytest.mark.usefixtures("sockets")

ROW = TopicTraffic("k", "/chatter", 1, 2, 0, 1)


class Control:
    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        self.loop = EventLoop()
        self.ended: list[str] = []
        self.link = LoopLink(self.loop, Channel(theirs, RelayLink), lambda *_: None, self.ended.append)
        self._channel = Channel(ours, RelayLink)

    def heard(self) -> list[Any]:
        return [message for message, _fds in self._channel.receive()]

    def close(self) -> None:
        self.link.close()
        self._channel.close()
        self.loop.close()


@pytest.fixture
def control() -> Iterator[Control]:
    control = Control()
    yield control
    control.close()


@pytest.fixture
def reporter(control: Control) -> Reporter:
    reporter = Reporter(replace(RelayLimits(), refusals=3))
    reporter.attach(control.link)
    return reporter


def test_equal_refusals_are_one_message_and_a_count(control: Control, reporter: Reporter) -> None:
    for _ in range(5):
        reporter.refused("k", ("topic", "/chatter"), "10.0.0.2", "/x", "no grant")
    assert control.heard() == [ConnectionRefused("k", "topic", "/chatter", "10.0.0.2", "/x", "no grant", 1)]
    reporter.tick(list, {})
    assert control.heard() == [ConnectionRefused("k", "topic", "/chatter", "10.0.0.2", "/x", "no grant", 4)]
    reporter.tick(list, {})
    assert control.heard() == []


def test_many_different_refusals_are_bounded(control: Control, reporter: Reporter) -> None:
    for number in range(1000):
        reporter.refused("k", ("topic", "/chatter"), "10.0.0.2", f"/x{number}", "no grant")
    reporter.tick(list, {})
    heard = control.heard()
    assert len(heard) == 4
    assert sum(message.count for message in heard) == 1000


def test_a_flood_of_a_host_hides_no_other_host(control: Control, reporter: Reporter) -> None:
    for number in range(1100):
        reporter.refused("k", ("topic", "/chatter"), "10.0.0.66", f"/x{number}", "no grant")
        reporter.limited(("k", f"/t{number}", "publisher", "10.0.0.66", "/x"), 1, 8)
    reporter.refused("k", ("topic", "/chatter"), "10.0.0.7", "/y", "no grant")
    reporter.limited(("k", "/chatter", "publisher", "10.0.0.7", "/y"), 1, 8)
    reporter.tick(list, {})
    heard = control.heard()
    refused = [one for one in heard if isinstance(one, ConnectionRefused)]
    (limited,) = [one.rows for one in heard if isinstance(one, MessagesLimited)]
    assert [(one.caller_id, one.count) for one in refused if one.host == "10.0.0.7"] == [("/y", 1)]
    assert sum(one.count for one in refused if one.host == "10.0.0.66") == 1100
    assert [(one.topic, one.messages) for one in limited if one.host == "10.0.0.7"] == [("/chatter", 1)]
    assert sum(one.messages for one in limited if one.host == "10.0.0.66") == 1100
    assert len(limited) < 1000


def test_long_claims_are_cut(control: Control, reporter: Reporter) -> None:
    reporter.refused("k", ("topic", "/" + "t" * 60_000), "10.0.0.2", "/" + "c" * 60_000, "r" * 60_000)
    (message,) = control.heard()
    assert max(len(message.resource), len(message.caller_id), len(message.reason)) <= 300


def test_a_new_control_hears_of_what_is_open_only(control: Control, reporter: Reporter) -> None:
    first = reporter.opened("k", "/chatter", "topic", "10.0.0.2", "/a")
    second = reporter.opened("k", "/chatter", "topic", "10.0.0.2", "/b")
    reporter.closed(first, "")
    control.heard()
    reporter.attach(None)
    third = reporter.opened("k", "/chatter", "topic", "10.0.0.2", "/c")
    reporter.attach(control.link)
    reporter.repeat_connections()
    heard = control.heard()
    assert [(type(message), message.number) for message in heard] == [
        (ConnectionOpened, second),
        (ConnectionOpened, third),
    ]
    reporter.closed(second, "gone")
    reporter.closed(second, "again")
    assert control.heard() == [ConnectionClosed(second, "gone")]


def test_traffic_is_one_message_per_tick(control: Control, reporter: Reporter) -> None:
    reporter.tick(lambda: [ROW, ROW], {})
    reporter.tick(list, {})
    assert control.heard() == [TrafficReported([ROW, ROW])]


def test_refusals_without_a_control_reach_the_next_one(control: Control, reporter: Reporter) -> None:
    reporter.attach(None)
    taken: list[int] = []
    for _ in range(3):
        reporter.refused("k", ("topic", "/chatter"), "10.0.0.2", "/x", "no grant")
        reporter.tick(lambda: taken.append(1) or [ROW], {})  # type: ignore[func-returns-value]  # the call is noted
    assert taken == []
    reporter.attach(control.link)
    reporter.tick(lambda: [ROW], {})
    assert control.heard() == [
        ConnectionRefused("k", "topic", "/chatter", "10.0.0.2", "/x", "no grant", 3),
        TrafficReported([ROW], 4.0),
    ]
    reporter.tick(lambda: [ROW], {})
    assert control.heard() == [TrafficReported([ROW])]


def test_connections_that_ended_without_a_control_are_reported_or_counted(
    control: Control, reporter: Reporter
) -> None:
    before = reporter.opened("k", "/chatter", "topic", "10.0.0.2", "/a")
    control.heard()
    reporter.attach(None)
    reporter.closed(before, "gone")
    for _ in range(1001):
        reporter.closed(reporter.opened("k", "/chatter", "topic", "10.0.0.2", "/b"), "")
    reporter.attach(control.link)
    reporter.repeat_connections()
    heard = control.heard()
    for _ in range(2000):
        control.loop.turn(0)
        heard += control.heard()
    assert (type(heard[0]), heard[1]) == (ConnectionOpened, ConnectionClosed(before, "gone"))
    assert len(heard) == 2000
    reporter.tick(list, {})
    reporter.tick(list, {})
    assert control.heard() == [TrafficReported([], 1.0, 2)]
