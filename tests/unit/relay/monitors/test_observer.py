from collections.abc import Iterator
from typing import Any

import pytest

from appliance.base import clock
from appliance.channel.messages import MonitorEvent, MonitorsCounted, MonitorsReported
from appliance.relay.monitors import observations
from appliance.relay.monitors.observation_points import ObservationPoint
from rosmop.tests.acting import message
from rosmop.tests.random_specifications import definitions
from tests.support.virtual_clock import VirtualClock
from tests.unit.relay.monitors.test_batch_progress import Monitored, traffic_of

DAY, WALL = 86_400, 1_800_000_000
COMMAND = "geometry_msgs/Twist"
STOP = """stop() { std_msgs::String s; event drive(double v) /cmd geometry_msgs/Twist '{linear:{x:v}}' {
    if (v > 1) { v = 1; ROS_WARN("too fast"); PUBLISH(/alarm, std_msgs/String, s); } } }"""
TURN = "turn() { event drive(double w) /cmd geometry_msgs/Twist '{angular:{z:w}}' { if (w > 1) { w = 1; } } }"
LOOK = """look() { event drive(double y) /cmd geometry_msgs/Twist '{linear:{y:y}}' { if (y > 1) { return; } }
    event on() /cmd geometry_msgs/Twist '{}' { } }"""


class Told:
    def __init__(
        self, *, together: bool, on_fault: str = "drop", texts: tuple[str, ...] = (STOP, TURN, LOOK)
    ) -> None:
        files = {f"{place}.rv": text for place, text in enumerate(texts)}
        self.monitored = Monitored(files, definitions(), together=together, on_fault=on_fault)

    def send(self, *commands: tuple[float, float, float]) -> None:
        bodies = [message(COMMAND, linear__x=x, linear__y=y, angular__z=z) for x, y, z in commands]
        self.monitored.through(traffic_of("/cmd", bodies))

    def events(self, kind: str) -> list[MonitorEvent]:
        self.monitored.interceptor.tick()
        self.monitored.interceptor.observations.flush()
        events: list[Any] = [one for one in self.monitored.sent() if getattr(one, "kind", "") == kind]
        self.monitored.heard.sent.clear()
        return events

    def counts(self) -> dict[str, tuple[int, int]]:
        return {row.name: (row.drops, row.changes) for row in self.monitored.rows()}


@pytest.fixture(params=[False, True], ids=["one by one", "together"])
def told(request: pytest.FixtureRequest) -> Iterator[Told]:
    told = Told(together=request.param)
    yield told
    told.monitored.close()


def test_a_change_is_recorded_under_the_monitor_that_made_it(told: Told) -> None:
    told.send((5, 0, 0))
    [change] = told.events("change")
    assert (change.monitor, change.text) == ("stop", "stop changed a message")
    assert change.detail == {
        "events": ["stop.drive", "turn.drive", "look.drive", "look.on"],
        "changed_by": ["stop.drive"],
        "number": 1,
        "at": ["0.rv:2:18"],
        "conditions": {"0.rv:2:9": {"v": 5.0}},
    }
    assert told.counts() == {"stop": (0, 1), "turn": (0, 0), "look": (0, 0)}


def test_a_change_of_two_monitors_names_both_and_counts_for_both(told: Told) -> None:
    told.send((5, 0, 5), *[(0, 0, 5)] * 3, *[(0.5, 0, 3), (4, 0, 3)] * 2)
    full, *summed = told.events("change")
    assert (full.monitor, full.text) == ("turn", "stop and turn changed a message")
    assert full.detail["changed_by"] == ["stop.drive", "turn.drive"]
    assert sorted((one.monitor, one.count, one.text, str(one.detail)) for one in summed) == [
        ("turn", 2, "stop and turn changed a message", "{'changed_by': ['stop.drive', 'turn.drive']}"),
        ("turn", 5, "turn changed a message", "{}"),
    ]
    assert told.counts() == {"stop": (0, 3), "turn": (0, 8), "look": (0, 0)}


def test_a_drop_is_recorded_under_the_monitor_that_dropped(told: Told) -> None:
    told.send((5, 5, 5))
    [drop] = told.events("drop")
    assert (drop.monitor, drop.text) == ("look", "look.drive dropped it")
    assert told.counts() == {"stop": (0, 0), "turn": (0, 0), "look": (1, 0)}


def test_a_publication_is_recorded_under_its_monitor(told: Told) -> None:
    told.send((5, 0, 0))
    [published] = told.events("publish")
    assert (published.monitor, published.resource) == ("stop", "/alarm")


def test_a_fault_that_was_passed_over_is_not_what_dropped() -> None:
    faulty = STOP.replace("v = 1;", "v = 1 / (int) (v - 5);")
    told = Told(together=False, on_fault="pass", texts=(faulty, LOOK))
    told.send((5, 5, 0))
    [drop] = told.events("drop")
    assert (drop.monitor, drop.text) == ("look", "look.drive dropped it")
    told.monitored.close()


def test_a_fault_drops_under_the_name_of_its_monitor() -> None:
    faulty = LOOK.replace("'{linear:{y:y}}'", "'{linear:{y:y}}' when (1 / (int) (y - 5) == 0)")
    told = Told(together=False, texts=(STOP, faulty))
    told.send((5, 5, 0))
    [drop] = told.events("drop")
    assert (drop.monitor, drop.text) == ("look", "fault in look: division by zero")
    assert drop.detail["events"] == ["stop.drive"]
    told.monitored.close()


@pytest.mark.parametrize("together", [False, True])
def test_changes_of_very_many_sets_of_monitors_are_few_records_and_exact_counts(together: bool) -> None:
    texts = {
        f"{bit}.rv": f"m{bit}() {{ event e(double v) /pose geometry_msgs/PoseWithCovariance '{{covariance[{bit}]:v}}'"
        " { if (v > 1) { v = 1; } } }"
        for bit in range(9)
    }
    monitored = Monitored(texts, definitions(), together=together)
    bodies = [
        message("geometry_msgs/PoseWithCovariance", covariance=[2.0 * (who >> bit & 1) for bit in range(36)])
        for who in range(256, 512)
    ]
    monitored.through(traffic_of("/pose", bodies))
    monitored.interceptor.tick()
    assert {row.name: row.changes for row in monitored.rows()} == dict.fromkeys(
        (f"m{bit}" for bit in range(8)), 128
    ) | {"m8": 256}
    monitored.interceptor.observations.flush()
    changes: list[Any] = [one for one in monitored.sent() if getattr(one, "kind", "") == "change"]
    assert {change.monitor for change in changes} == {"m8"}
    assert sum(change.count or 1 for change in changes) == 256
    assert len(changes) <= 102
    monitored.close()


def test_a_report_says_how_far_the_system_clock_is_ahead_of_that_of_monitors() -> None:
    with clock.using(machine := VirtualClock()):
        told = Told(together=False)
        ahead = []
        for days in (0, 1, -1):
            machine.set_wall(WALL + days * DAY)
            told.send((1, 5, 0))
            told.monitored.interceptor.tick()
            told.monitored.interceptor.observations.flush()
            (report,) = (one for one in told.monitored.heard.sent if isinstance(one, MonitorsReported))
            ahead.append(report.ahead)
            told.monitored.heard.sent.clear()
        told.monitored.close()
    assert [one - ahead[0] for one in ahead] == [0, DAY * 10**9, -DAY * 10**9]


def test_counters_come_with_the_event_that_they_count_not_a_second_later(told: Told) -> None:
    told.send((1, 5, 0))
    told.monitored.interceptor.observations.flush()
    *_before, events, counters = told.monitored.heard.sent
    assert isinstance(events, MonitorsReported)
    assert isinstance(counters, MonitorsCounted)
    assert [event.kind for event in events.events] == ["drop"]
    rows = {row.name: (row.events, row.drops) for row in counters.rows}
    assert rows == {"stop": (1, 0), "turn": (1, 0), "look": (1, 1)}


@pytest.mark.parametrize("together", [False, True], ids=["one by one", "together"])
@pytest.mark.parametrize("equal", [False, True], ids=["of any length", "equally long"])
def test_reports_name_publisher_and_message(together: bool, equal: bool) -> None:
    look = """look() { event far(int seq) /scan geometry_msgs/PoseStamped '{header:{seq:seq}}' {
        if (seq == 7 || seq == 9) { seq = 0; return; } if (seq == 8) { int zero = 0; seq = 1 / zero; } } }"""
    told = Told(together=together, texts=(look,), on_fault="pass")
    header: dict[str, object] = {"header__stamp__sec": 1_700_000_000, "header__stamp__nanosec": 5}
    bodies = []
    for seq in range(1, 11):
        frame = "m" * (3 if equal else seq)
        header |= {"header__seq": seq, "header__frame_id": frame}
        bodies.append(message("geometry_msgs/PoseStamped", **header))
    told.monitored.through(traffic_of("/scan", bodies), first=101)
    told.monitored.interceptor.tick()
    told.monitored.interceptor.observations.flush()
    found: list[Any] = [one for one in told.monitored.sent() if isinstance(one, MonitorEvent)]
    [drop, more] = [one for one in found if one.kind == "drop"]
    [fault] = [one for one in found if one.kind == "fault"]
    assert {(one.host, one.caller_id) for one in (drop, more, fault)} == {("10.0.0.7", "/talker")}
    places = [(one.detail["number"], one.detail["seq"], one.detail["stamp"]) for one in (drop, fault)]
    assert places == [(107, 7, "1700000000.000000005"), (108, 8, "1700000000.000000005")]
    assert (more.count, "number" in more.detail) == (1, False)
    told.monitored.close()


def test_clients_of_one_host_are_counted_together_and_those_of_two_are_not() -> None:
    told = Told(together=True)
    observations = told.monitored.interceptor.observations
    for number in range(50):
        for host in ("10.0.0.1", "10.0.0.2"):
            observations.note(
                "drop", "gate", ObservationPoint("k", "/mode", host, f"/client{number}"), 1, "no"
            )
    first, second, *counts = told.events("drop")
    assert [(one.host, one.caller_id, one.count) for one in (first, second)] == [
        ("10.0.0.1", "/client0", 0),
        ("10.0.0.2", "/client0", 0),
    ]
    assert [(count.host, count.caller_id, count.count) for count in counts] == [
        ("10.0.0.1", "", 49),
        ("10.0.0.2", "", 49),
    ]
    told.monitored.close()


@pytest.mark.parametrize("together", [False, True])
def test_a_verdict_names_its_binding(together: bool) -> None:
    turns = (
        "turns(double x) { event on(double x) /cmd geometry_msgs/Twist '{linear.x:x}' { } "
        'ere: on on @match { ROS_INFO("twice"); } }'
    )
    told = Told(together=together, texts=(turns,))
    told.send((5, 0, 0), (6, 0, 0), (5, 0, 0), (6, 0, 0))
    verdicts = told.events("verdict")
    assert [(verdict.text, verdict.detail["binding"]) for verdict in verdicts] == [
        ("property 1 of turns (ere) with x = 5.0: match", {"x": 5.0}),
        ("property 1 of turns (ere) with x = 6.0: match", {"x": 6.0}),
    ]
    told.monitored.close()


def test_how_many_slices_there_are() -> None:
    told = Told(together=False, texts=(AGAIN, TURNED))
    told.send((5, 0, 0), (6, 0, 0), (5, 0, 0))
    rows = {row.name: (row.slices, row.slice_limit) for row in told.monitored.rows()}
    assert rows == {"again": (2, 100_000), "turned": (0, 0)}
    told.monitored.close()


AGAIN = """again(double x) { event on(double x) /cmd geometry_msgs/Twist '{linear.x:x}' { }
    ptltl: on @validation { ROS_INFO("again"); } }"""
TURNED = """turned() { event on(double z) /cmd geometry_msgs/Twist '{angular.z:z}' when (z > 1) { }
    ptltl: on @validation { ROS_INFO("turned"); } }"""


@pytest.mark.parametrize("together", [False, True])
@pytest.mark.parametrize("bindings", [[5.0] * 20, [float(number) for number in range(20)]])
def test_counted_events_have_no_explanation(
    together: bool, bindings: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(observations, "_DISTINCT", 2)
    told = Told(together=together, texts=(AGAIN, TURNED))
    told.send(*[(x, 0, 0) for x in bindings], (5.0, 0, 2))
    full = [event for event in told.events("verdict") if not event.count]
    assert full[-1].monitor == "turned"
    assert [len(one.detail["why"]["events"]) for one in full] == [1] * len(full)
    told.monitored.close()


SAYS = """says() { event drive(double v, double w) /cmd geometry_msgs/Twist '{linear:{x:v}, angular:{z:w}}' {
    if (w > 1) { ROS_WARN("turn %g", w); return; } ROS_INFO("speed %g", v); } }"""


@pytest.mark.parametrize("together", [False, True])
def test_lines_that_differ_only_in_numbers_are_one_count(together: bool) -> None:
    told = Told(together=together, texts=(SAYS,))
    told.send(*[(speed, 0, 0) for speed in (0.25, 0.5, 0.75, 1)], (0, 0, 5))
    first, warning, more = told.events("log")
    assert (first.text, first.count) == ("speed 0.25", 0)
    assert (warning.text, warning.detail["level"]) == ("turn 5", "WARN")
    assert (more.text, more.count) == ("speed 1", 3)
    assert 0 < more.first <= more.time
    assert more.detail == {"level": "INFO", "first_text": "speed 0.5", "last_text": "speed 1"}
    told.monitored.close()


@pytest.mark.parametrize("together", [False, True])
def test_further_drops_have_a_number_and_times(together: bool) -> None:
    """The fast path does not know the texts of later drops, so their count has no text."""
    told = Told(together=together, texts=(SAYS,))
    told.send(*[(0, 0, turn) for turn in (5, 6, 7)])
    first, more = told.events("drop")
    assert (first.text, first.count) == ("says.drive dropped it: turn 5", 0)
    assert (more.text, more.count, more.detail, 0 < more.first <= more.time) == ("", 2, {}, True)
    told.monitored.close()


def test_a_count_of_different_words_has_no_text() -> None:
    told = Told(together=True)
    observations, point = told.monitored.interceptor.observations, ObservationPoint("k", "/t", "h", "/n")
    for number, words in enumerate(["a" * (length + 1) for length in range(110)]):
        observations.note("log", "gate", point, number + 1, words, distinction=f"INFO {words}")
    *full, more = told.events("log")
    assert (len(full), more.count, more.text) == (101, 9, "")
    assert (more.first, more.time) == (102, 110)
    told.monitored.close()


HALT = """halt() { safe geometry_msgs/Twist { } on /cmd every 100ms;
    event drive(double v) /cmd geometry_msgs/Twist '{linear:{x:v}}' {
        if (v > 1) { ROS_WARN("too fast: %.1f", v); STOP; } } }"""


@pytest.mark.parametrize("together", [False, True])
@pytest.mark.parametrize("kind", ["change", "publish"])
def test_a_stop_is_marked_and_has_its_cause(kind: str, *, together: bool) -> None:
    """Also the stops that are only counted, and those that the module makes."""
    told = Told(together=together, texts=(HALT, TURN))
    if kind == "publish":
        monitors = told.monitored.interceptor.monitors
        assert monitors is not None
        monitors.hold(monitors.monitor("halt"), "its state is lost")
        for time in range(3):
            told.monitored.interceptor.observer.report(
                monitors.advance(told.monitored.interceptor.now() + time * 10**8)[0], ObservationPoint("", "")
            )
    else:
        told.send(*[(5, 0, 0)] * 30, (0.5, 0, 5))
    first, *counts = [event for event in told.events(kind) if event.monitor == "halt"]
    assert first.safe
    assert all(event.safe for event in counts)
    assert 1 + sum(event.count for event in counts) == (30 if kind == "change" else 3)
    assert first.detail["cause"] == (
        "too fast: 5.0"
        if kind == "change"
        else "it holds its topics until an operator resumes it: its state is lost"
    )
    told.monitored.close()


def test_a_limit_is_not_a_stop() -> None:
    told = Told(together=True, texts=(HALT, TURN))
    told.send(*[(0.5, 0, 5)] * 30)
    changes = told.events("change")
    assert {(event.monitor, event.safe) for event in changes} == {("turn", False)}
    told.monitored.close()
