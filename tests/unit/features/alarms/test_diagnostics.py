from collections.abc import Iterable
from typing import Any, cast

from appliance.base.clock import using
from appliance.channel.answers.status import Status
from appliance.channel.channel import ChannelFullError
from appliance.channel.messages import OwnHeaderStated, OwnPublished
from appliance.control.core import Alarms, RelayOrders
from appliance.features.alarms.diagnostics import TOPIC, Diagnostics
from rosmop.tests.acting import fields
from tests.support.answers import example
from tests.support.virtual_clock import VirtualClock

GOOD: dict[str, Any] = {
    "name": "carrier", "probe": "passed", "relay": "connected", "rosmaster": "reachable",
    "guards": {"loaded": 2, "acting": []},
}  # fmt: skip
IPSEC = {"troubles": ["problem 0", "problem 1"], "trouble_names": ["a", "b"]}
MANY = {f"m{number}": "no topic" for number in range(80)}


class Desk:
    """Control with a status, and a relay."""

    def __init__(self) -> None:
        self.of_status, self.is_full = GOOD, False
        self.sent: list[dict[str, tuple[int, str]]] = []
        alarms = cast("Alarms", self)
        self.diagnostics = Diagnostics(alarms, cast("RelayOrders", self), "/rosrv")

    def status(self) -> Status:
        return example(Status, **self.of_status)

    def publish_only(self, owner: str, headers: Iterable[OwnHeaderStated]) -> None:
        [header] = headers
        assert (owner, header.topic, header.md5sum) == ("alarms", TOPIC, "60810da900de1dd6ddd437c3503511da")

    def publish(self, message: OwnPublished) -> None:
        if self.is_full:
            raise ChannelFullError("it does not read")
        read = fields("diagnostic_msgs/DiagnosticArray", message.data)
        assert {one.hardware_id for one in read.status} == {"carrier"}
        self.sent.append({one.name: (one.level, one.message) for one in read.status})

    def look(self, **status: Any) -> dict[str, tuple[int, str]] | None:
        """Return level and text by name of what a look at this status publishes, or None if that is nothing."""
        self.of_status, count = GOOD | status, len(self.sent)
        self.diagnostics.look()
        assert len(self.sent) <= count + 1
        return self.sent[-1] if len(self.sent) > count else None


def test_an_alarm_has_its_level_and_text_ends_with_ok_and_leaves() -> None:
    desk, clock = Desk(), VirtualClock()
    with using(clock):
        quiet = {"rosrv: alarms": (0, "no alarms"), "rosrv: guards": (0, "2 loaded")}
        assert desk.look() == quiet
        assert desk.look() is None
        found = desk.look(relay="away", rosmaster="being rebuilt", ipsec=IPSEC)
        assert found is not None
        assert {name: level for name, (level, _text) in found.items()} == {
            "rosrv: alarms": 2, "rosrv: guards": 0, "rosrv: relay": 2, "rosrv: rosmaster": 1,
            "rosrv: ipsec:a": 1, "rosrv: ipsec:b": 1,
        }  # fmt: skip
        assert found["rosrv: alarms"][1] == found["rosrv: relay"][1]
        assert found["rosrv: ipsec:b"][1] == "problem 1"
        assert desk.look() == quiet | {
            f"rosrv: {kind}": (0, "ended") for kind in ("relay", "rosmaster", "ipsec:a", "ipsec:b")
        }
        assert desk.look() is None
        clock.advance(1.0)
        assert desk.look() == quiet


def test_guards_have_the_line_of_the_status_and_the_level_of_their_worst_alarm() -> None:
    guards = {"loaded": 1, "acting": [{"name": "deadman", "since": 0.0}], "never_enabled": {"speed": "off"}}
    found = Desk().look(guards=guards)
    assert found is not None
    text = "1 loaded; deadman has limited or stopped the robot since 1970-01-01 00:00:00Z"
    assert found["rosrv: guards"] == (1, text)
    assert found["rosrv: guard-acts:deadman"][0] == 0


def test_a_flood_of_alarms_is_cut_and_a_full_link_loses_no_end() -> None:
    desk = Desk()
    found = desk.look(monitors={"left_out": MANY}, rosmaster="being rebuilt")
    assert found is not None
    assert len(found) == 52 and "rosrv: rosmaster" not in found
    assert len(desk.sent) == 1
    desk.is_full = True
    assert desk.look() is None
    desk.is_full = False
    ended = desk.look()
    assert ended is not None
    assert len([text for _level, text in ended.values() if text == "ended"]) == 50
