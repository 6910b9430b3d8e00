import asyncio
from pathlib import Path
from typing import Any

import pytest

from appliance.base.clock import using
from appliance.channel.alarms import Alarm
from appliance.channel.answers.status import Status
from appliance.control.core import Alarms
from appliance.control.errors import UnknownThingError
from appliance.control.operators.handled_alarms import HandledAlarms
from appliance.features.alarms.control_part import AlarmOrders
from appliance.features.alarms.requests import AlarmAcknowledge, AlarmSilence, AlarmsWanted
from tests.support.answers import example
from tests.support.core import Core
from tests.support.virtual_clock import VirtualClock

GOOD: dict[str, Any] = {"probe": "passed", "relay": "connected", "rosmaster": "reachable"}
BAD = {**GOOD, "rosmaster": "being rebuilt"}


class Robot:
    def __init__(self, state: Path) -> None:
        self.core = Core(state)
        self.fields = BAD
        self.restart()

    def restart(self) -> None:
        self.core.restart()
        handled = HandledAlarms(self.core.store, self.core.ends)
        alarms = Alarms(lambda: handled.with_marks(example(Status, **self.fields)), handled)
        self.orders = AlarmOrders(alarms, self.core.trail)

    @property
    def events(self) -> list[str]:
        return [f"{row['event']} by {row['who']}: {row['reason']}" for row in self.core.trail.rows]

    def alarms(self) -> list[Alarm]:
        return asyncio.run(self.orders.list_alarms(AlarmsWanted())).alarms

    def silence(self, seconds: float | None) -> None:
        asyncio.run(self.orders.silence(AlarmSilence("rosmaster", seconds), "ann"))

    def acknowledge(self) -> None:
        asyncio.run(self.orders.acknowledge(AlarmAcknowledge("rosmaster", "spare part"), "ann"))


@pytest.fixture(name="robot")
def robot_of(tmp_path: Path) -> Robot:
    return Robot(tmp_path)


def test_an_acknowledged_alarm_stays_one_until_it_is_over(robot: Robot) -> None:
    robot.acknowledge()
    robot.restart()
    [alarm] = robot.alarms()
    assert (alarm.severity, alarm.handled) == ("warning", "acknowledged by ann: spare part")
    assert alarm.text.endswith("(acknowledged by ann: spare part)")
    robot.fields = GOOD
    assert robot.alarms() == []
    robot.fields = BAD
    assert [one.handled for one in robot.alarms()] == [""]
    assert robot.events == ["alarm acknowledged by ann: rosmaster is acknowledged: spare part"]


@pytest.mark.parametrize(("after", "handled"), [(0, True), (1, True), (61, True), (299, True), (301, False)])
def test_an_acknowledgement_survives_a_restart_until_its_alarm_returns(
    robot: Robot, after: float, handled: bool
) -> None:
    """Many conditions are alarms only some time after a start: at first, one line says `starting`."""
    clock = VirtualClock()
    with using(clock):
        for start in range(2):
            robot.fields = BAD
            if start == 0:
                robot.acknowledge()
            robot.fields = GOOD
            robot.restart()
            for _second in range(round(after)):
                assert robot.alarms() == []
                clock.advance(1)
            robot.fields = BAD
            assert [bool(alarm.handled) for alarm in robot.alarms()] == [handled], start
        robot.fields = GOOD
        assert robot.alarms() == []
        robot.fields = BAD
        assert [one.handled for one in robot.alarms()] == [""], "it was present since the start, and ended"


@pytest.mark.parametrize(("passed", "severity"), [(3599, "notice"), (3601, "warning"), (-1, "notice")])
def test_a_silenced_alarm_is_a_notice_for_its_time(robot: Robot, passed: float, severity: str) -> None:
    clock = VirtualClock()
    with using(clock):
        robot.silence(3600)
        robot.fields = GOOD
        robot.alarms()
        robot.fields = BAD
        clock.set_wall(clock.wall_ns() / 1e9 + passed)
        robot.restart()
        assert [alarm.severity for alarm in robot.alarms()] == [severity]


@pytest.mark.parametrize(("left", "severity"), [(1, "notice"), (-1, "warning")])
def test_a_clock_that_is_set_back_does_not_extend_a_silence(robot: Robot, left: float, severity: str) -> None:
    clock = VirtualClock()
    with using(clock):
        robot.silence(7200)
        clock.advance(5400)
        clock.set_wall(clock.wall_ns() / 1e9 - 3600)
        clock.advance(1800 - left)
        assert [alarm.severity for alarm in robot.alarms()] == [severity]


def test_a_silence_is_ended_by_an_order(robot: Robot) -> None:
    robot.silence(3600)
    robot.silence(None)
    assert [alarm.severity for alarm in robot.alarms()] == ["warning"]
    assert [event.partition(":")[0] for event in robot.events] == [
        "alarm silenced by ann",
        "alarm sounds again by ann",
    ]


def test_an_order_with_the_name_alone_is_for_the_alarms_that_are_present(robot: Robot) -> None:
    def failing(*roles: str) -> dict[str, Any]:
        return {**GOOD, "processes": [{"role": role, "failing": "it ends"} for role in roles]}

    def order(seconds: float | None = None) -> dict[str, bool]:
        body = asyncio.run(robot.orders.silence(AlarmSilence("process-failing", seconds), "ann"))
        return {alarm.kind.partition(":")[2]: bool(alarm.handled) for alarm in body.alarms}

    robot.fields = failing("hook", "signer")
    assert order(3600.0) == {"hook": True, "signer": True}
    robot.fields = failing("hook", "recorder")
    assert [(alarm.severity, alarm.kind) for alarm in robot.alarms()] == [
        ("alarm", "process-failing:recorder"), ("notice", "process-failing:hook"),
    ]  # fmt: skip
    body = asyncio.run(robot.orders.acknowledge(AlarmAcknowledge("process-failing:recorder"), "ann"))
    assert all(alarm.handled for alarm in body.alarms)
    assert order() == {"hook": False, "recorder": False}


def test_only_a_present_alarm_is_handled(robot: Robot) -> None:
    with pytest.raises(UnknownThingError, match="neither silenced"):
        robot.silence(None)
    robot.fields = GOOD
    with pytest.raises(UnknownThingError, match="'rosmaster'; there is none now"):
        robot.acknowledge()
