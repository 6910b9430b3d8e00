"""An action that goes on takes few records, with the right sum; a stop has one begin and one end."""

import contextlib
import itertools
import math
import random
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from appliance.audit.log.record import AuditRecord
from appliance.audit.search.query import Filter
from appliance.audit.search.search import export
from appliance.base import clock
from appliance.channel.messages import MonitorEvent, MonitorsReported
from appliance.features.guards.presets import PRESETS, Guard, text_of
from appliance.relay.monitors.observation_points import ObservationPoint
from appliance.specifications.records import MonitorRecords
from appliance.telemetry.audit_trail import AuditTrail
from rosmop.tests.acting import message
from tests.support.audit import settle
from tests.support.engines import open_log
from tests.support.examples import ALL
from tests.support.virtual_clock import VirtualClock
from tests.unit.relay.monitors.quiet import QuietMonitors

DAY = 86_400
SECOND = 10**9
BASE = ObservationPoint("key", "/cmd_vel", "10.0.0.7", "/teleop")
ODOM = ObservationPoint("other", "/odom", "10.0.0.2", "/base")
FAST = message("geometry_msgs/Twist", linear__x=9.0)
OUTSIDE = message("nav_msgs/Odometry", pose__pose__position__x=7.0, pose__pose__orientation__w=1.0)


@pytest.fixture
def time() -> Iterator[VirtualClock]:
    virtual = VirtualClock(wall=1.7e9)
    with clock.using(virtual):
        yield virtual


class Site:
    """Monitors of a relay, and the records that control makes of their reports."""

    def __init__(self, folder: Path, time: VirtualClock) -> None:
        self.time, self.file = time, folder / "audit.db"
        self._log = open_log(self.file)
        self.kept = "[]"
        self.records = self._records()

    def _records(self) -> MonitorRecords:
        trail = AuditTrail(self._log, strict=False, deny_when_failed=False)
        return MonitorRecords(
            trail, lambda _topic, _data: None, [], lambda stops: setattr(self, "kept", stops)
        )

    def restart(self) -> None:
        """Replace control, as after a crash or on the other appliance."""
        self.records = self._records()
        self.records.start(self.kept)

    def second(self, events: list[MonitorEvent]) -> None:
        shifted = [_at(event, self.time.wall_ns()) for event in events]
        self.records.reported(shifted, 0, 0)
        self.time.advance(1)
        self.records.tick()

    def found(self, event: str = "") -> list[AuditRecord]:
        settle(self._log)
        found = [each.record for each in export(self.file, Filter())]
        return [one for one in found if one.category == "monitor" and event in ("", one.event)]

    def close(self) -> None:
        self._log.close()


def _at(event: MonitorEvent, now: int) -> MonitorEvent:
    return msgspec.structs.replace(event, time=now, first=now if event.first else 0)


@pytest.fixture
def site(tmp_path: Path, time: VirtualClock) -> Iterator[Site]:
    made = Site(tmp_path, time)
    yield made
    made.close()


class Robot:
    """A guarded base: what the relay reports of each second."""

    def __init__(self, preset: str, time: VirtualClock) -> None:
        self.monitors, self._time = QuietMonitors(), time
        self.monitors.load(text_of(Guard(preset, PRESETS[preset])))

    def give(self, point: ObservationPoint, data: bytes) -> None:
        interceptor = self.monitors.interceptor
        monitors, now = interceptor.monitors, interceptor.now()
        assert monitors is not None
        outcome = monitors.process(point.resource, bytearray(data), now)
        interceptor.observer.report(outcome, point)
        if outcome.result == "changed":
            interceptor.observer.changed(outcome, point, data, len(data))

    def second(self, *rows: tuple[ObservationPoint, bytes], rate: int = 20) -> list[MonitorEvent]:
        interceptor = self.monitors.interceptor
        for _ in range(rate):
            for point, data in rows:
                self.give(point, data)
            self._time.advance(1 / rate)
            assert interceptor.monitors is not None
            for outcome in interceptor.monitors.advance(interceptor.now()):
                interceptor.observer.report(outcome, ObservationPoint("", ""))
        interceptor.tick()
        interceptor.observations.flush()
        reports = [one for one in self.monitors.reports.sent if isinstance(one, MonitorsReported)]
        self.monitors.reports.sent.clear()
        return [event for report in reports for event in report.events]


def parked(robot: Robot) -> tuple[tuple[ObservationPoint, bytes], ...]:
    robot.give(BASE, FAST)
    return ()


def at_the_limit(_robot: Robot) -> tuple[tuple[ObservationPoint, bytes], ...]:
    return ((BASE, FAST),)


def leaning_on_a_fence(_robot: Robot) -> tuple[tuple[ObservationPoint, bytes], ...]:
    return ((ODOM, OUTSIDE), (BASE, FAST))


DAYS: list[tuple[str, Callable[[Robot], Any], int, int]] = [
    ("deadman", parked, 40, 100_000),
    ("fence", leaning_on_a_fence, 1_600, 3_000_000),
    *((("speed", at_the_limit, 1_500, 3_000_000),) if ALL else ()),
]


@pytest.mark.parametrize(("preset", "situation", "most", "size"), DAYS)
def test_a_day_of_a_guard_that_acts_takes_few_records(
    site: Site, preset: str, situation: Callable[[Robot], Any], most: int, size: int
) -> None:
    robot = Robot(preset, site.time)
    rows = situation(robot)
    seconds = [robot.second(*rows) for _ in range(4)]
    assert [_kinds(second) for second in seconds[1:]] == [_kinds(seconds[-1])] * 3
    begun = site.file.stat().st_size
    for events in [*seconds, *[seconds[-1]] * (DAY - len(seconds))]:
        site.second(events)
    for _ in range(200):
        site.second([])
    records = site.found()
    assert len(records) <= most
    assert site.file.stat().st_size - begun < size
    for kind, name in (
        ("change", "message changed"),
        ("publish", "monitor published"),
        ("log", "monitor log"),
    ):
        reported = [event for second in seconds for event in second if event.kind == kind and not event.safe]
        numbers = sum(event.count or 1 for event in reported)
        numbers += (DAY - len(seconds)) * sum(
            event.count or 1 for event in seconds[-1] if event.kind == kind and not event.safe
        )
        assert sum(record.detail.get("count", 1) for record in records if record.event == name) == numbers
    acts = sum(event.count or 1 for second in seconds for event in second if event.safe)
    acts += (DAY - len(seconds)) * sum(event.count or 1 for event in seconds[-1] if event.safe)
    begins, ends = (site.found(event) for event in ("stop begun", "stop ended"))
    assert len(begins) == len(ends) == (0 if preset == "speed" else 1)
    for begin, end in zip(begins, ends, strict=True):
        assert (end.detail["actions"], end.detail["begun_in"]) == (acts, begin.id)
        assert DAY - 5 < end.detail["seconds"] < DAY + 5
        assert begin.detail["monitor"] == preset
        assert begin.resource == end.resource == "/cmd_vel"
        assert begin.detail["cause"] in begin.reason


def _kinds(events: list[MonitorEvent]) -> Counter[tuple[str, bool]]:
    return Counter((event.kind, event.safe) for event in events)


def drop(text: str = "", count: int = 0, kind: str = "drop", host: str = "10.0.0.7") -> MonitorEvent:
    first = 1 if count else 0
    return MonitorEvent(kind, "gun", "key", "/trigger", 0, text, {}, count=count, host=host, first=first)


def stop(count: int = 0, cause: str = "the scan is silent") -> MonitorEvent:
    return MonitorEvent("publish", "scan", "", "/cmd_vel", 0, "", {"cause": cause}, count=count, safe=True)


def test_rare_actions_are_recorded_in_full(site: Site) -> None:
    for second in range(3600):
        site.second([drop("no")] if second % 90 == 0 else [])
    assert [one.detail.get("count") for one in site.found()] == [None] * 40


def test_ten_seconds_are_recorded_as_before_and_the_end_with_the_number_and_the_time(site: Site) -> None:
    for _ in range(70):
        site.second([drop("no"), drop(count=9)])
    for _ in range(70):
        site.second([])
    records = site.found("message dropped")
    assert [record.detail.get("count") for record in records][:20] == [None, 9] * 10
    assert sum(record.detail.get("count", 1) for record in records) == 700
    assert (records[-1].detail["total"], records[-1].detail["seconds"]) == (700, 69)
    assert len(records) <= 23


@pytest.mark.parametrize("seed", range(5))
def test_no_action_is_lost_and_each_kind_has_one_record_a_minute(site: Site, seed: int) -> None:
    rng = random.Random(seed)  # noqa: S311  of a test
    given: Counter[str] = Counter()
    for _ in range(3000):
        events = []
        for kind in ("drop", "change", "fault", "shadow drop"):
            for host in ("10.0.0.7", "10.0.0.8"):
                if rng.random() < 0.4:
                    events.append(drop("no", rng.randint(0, 3), kind, host))
                    given[kind] += events[-1].count or 1
        site.second(events)
    for _ in range(130):
        site.second([])
    records = site.found()
    assert len(records) <= 4 * 2 * (20 + 3130 / 60 + 1)
    names = {"drop": "message dropped", "change": "message changed", "fault": "monitor fault"}
    for kind, name in [*names.items(), ("shadow drop", "shadow observed")]:
        assert sum(record.detail.get("count", 1) for record in records if record.event == name) == given[kind]
    assert not site.records.some or not site.records.repetitions.waits


def test_many_texts_take_no_more_records_than_a_thousand_kinds(site: Site) -> None:
    for second in range(50):
        site.second([drop("x" * (100 * second + number), kind="log") for number in range(100)])
    assert len(site.found("monitor log")) <= 1100
    for _ in range(2):
        site.time.advance(10_000)
        site.second([])
    assert not site.records.some


def test_a_stop_has_one_begin_and_one_end(site: Site) -> None:
    for _ in range(30):
        site.second([stop(), stop(9)])
    assert [one.event for one in site.found()] == ["stop begun"]
    for _ in range(3):
        site.second([])
    begin, end = site.found()
    assert (begin.reason, begin.severity.name) == ("scan stops /cmd_vel: the scan is silent", "WARNING")
    assert end.reason == "scan stopped /cmd_vel for 29.0 s, 300 times: the scan is silent"
    assert (end.detail["begun_in"], end.detail["actions"], end.detail["seconds"]) == (begin.id, 300, 29)
    assert site.records.stops.last["scan"].record == begin.id


ANY_VALUES: tuple[Any, ...] = (-(1 << 63), -1, 0, 1, (1 << 32) - 1, 10**19, (1 << 64) - 1, 1e308, math.nan, "9" * 30,
    "", b"\xff", None, True, [], [1], [{}], [{"host": 1}], {}, {"x": [None]})  # fmt: skip
DETAILS = (
    "cause",
    "publishers",
    "changed_by",
    "level",
    "category",
    "first_time",
    "last_time",
    "seconds",
    "total",
)


def test_no_report_of_another_relay_ends_the_record_of_stops(site: Site) -> None:
    """A relay may send any value in each field, and in each detail that control reads."""
    fields = {field: index for index, field in enumerate(MonitorEvent.__struct_fields__)}
    decoder = msgspec.msgpack.Decoder(MonitorsReported)
    names = fields | dict.fromkeys(DETAILS)
    for number, (name, value, count) in enumerate(itertools.product(names, ANY_VALUES, (0, 1))):
        good = MonitorEvent("log", f"ghost{number}", "k", "/cmd_vel", 1, "", {}, count=count, safe=True)
        row = [getattr(good, field) for field in fields]
        if name in fields:
            row[fields[name]] = value
        else:
            row[fields["detail"]] = {name: value}
        plain = [*row]
        plain[fields["safe"]] = False
        hostile = {"message": "MonitorsReported", "events": [row, row, plain], "ahead": (1 << 64) - 1}
        with contextlib.suppress(Exception):  # the event loop logs it
            report = decoder.decode(msgspec.msgpack.encode(hostile))
            site.records.reported(report.events, 0, report.ahead)
    for _ in range(2):
        site.second([stop()])
        for _ in range(130):
            site.second([])
    ours = [one.event for one in site.found() if one.detail.get("monitor") == "scan"]
    assert ours == ["stop begun", "stop ended"] * 2
    msgspec.msgpack.encode(site.records.counts.most_common())  # answers to operators have the counts
    site.restart()


def test_stops_that_follow_each_other_closely_become_one(site: Site) -> None:
    for second in range(DAY // 4):
        site.second([stop()] if second % 4 == 0 else [])
    for _ in range(130):
        site.second([])
    records = site.found()
    assert len(records) <= 2 * 5 + DAY / 4 / 60 + 2
    ends = [record for record in records if record.event == "stop ended"]
    assert len(ends) * 2 == len(records)
    assert sum(end.detail["actions"] for end in ends) == DAY // 16


def test_a_stop_that_was_open_when_control_ended_is_closed_with_an_unknown_end(site: Site) -> None:
    for _ in range(3):
        site.second([stop()])
    site.restart()
    [begin, end] = site.found()
    assert (end.event, end.detail["unknown_end"], end.detail["begun_in"]) == ("stop ended", True, begin.id)
    assert "seconds" not in end.detail
    assert "its end is not known" in end.reason
    site.second([stop()])  # the relay goes on
    site.restart()
    assert [one.event for one in site.found()] == ["stop begun", "stop ended"] * 2
    site.restart()
    assert len(site.found()) == 4


def test_a_clock_that_is_set_changes_no_duration(site: Site) -> None:
    events = [msgspec.structs.replace(stop(), time=SECOND * number) for number in range(5)]
    for number, event in enumerate(events):
        site.records.reported([event], 0, 0)
        site.time.set_wall(1.7e9 + (1e6 if number % 2 else -1e6))
        site.time.advance(1)
        site.records.tick()
    for _ in range(3):
        site.second([])
    assert site.found("stop ended")[0].detail["seconds"] == 4
