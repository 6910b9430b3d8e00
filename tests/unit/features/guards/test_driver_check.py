from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from appliance.base import clock
from appliance.channel import admin
from appliance.channel.answers.graph_answers import Graph, Topic
from appliance.channel.answers.status import ProcessInfo
from appliance.channel.messages import MonitorEvent, MonitorsReported
from appliance.cli.main import app
from appliance.control.errors import SenselessError
from appliance.features.guards import driver_outcomes as sentences
from appliance.features.guards.control_part import NAME, DriverChecks
from appliance.features.guards.driver_outcomes import status_of
from appliance.features.guards.presets import PRESETS, Guard, text_of
from appliance.features.guards.requests import DriverCheckBegin, DriverCheckWanted
from appliance.specifications.specification_files import SpecificationsRefusedError
from appliance.specifications.specification_manager import SpecificationManager
from tests.support.core import FakeTrail
from tests.support.virtual_clock import let_time_pass
from tests.unit.features.guards.guard_desk import monitors_of
from tests.unit.features.guards.test_presets import compiled

pytestmark = pytest.mark.anyio
BEGIN = DriverCheckBegin("/cmd_vel", "/odom", 2.0, 30.0)
FILES = {f"{name}.rv": text_of(Guard(name, PRESETS[name])) for name in ("deadman", "speed")}
SPEED = text_of(Guard("speed", PRESETS["speed"], values={"vMax": "0.3"}))


class Site:
    """A control with checks of drivers; `pid` is that of its relay."""

    def __init__(self, monitors: SpecificationManager) -> None:
        self.monitors, self.trail, self.pid = monitors, FakeTrail(), 7
        topics = [
            Topic("/cmd_vel", "geometry_msgs/Twist", True, [], [], []),
            Topic("/odom", "nav_msgs/Odometry", True, [], [], []),
        ]
        self.checks = DriverChecks(monitors, self.trail, lambda: Graph([], topics, []), self.processes)

    def processes(self) -> list[ProcessInfo]:
        return [ProcessInfo("relay", self.pid, "", 0), ProcessInfo("api", 9, "", 0)]

    def says(self, text: str, monitor: str = NAME) -> None:
        event = MonitorEvent("log", monitor, "", "", 0, text, {"level": "WARN"})
        self.monitors.received(MonitorsReported([event]))

    def removed(self) -> bool:
        return NAME not in self.monitors.checked.monitors

    def refuse(self, monkeypatch: pytest.MonkeyPatch, order: str, times: int) -> None:
        """Let the specifications refuse an order this many times."""
        real, left = getattr(self.monitors, order), iter(range(times))

        async def refused(*given: Any, **how: Any) -> Any:
            if next(left, None) is None:
                return await real(*given, **how)
            raise SpecificationsRefusedError(["not now"])

        monkeypatch.setattr(self.monitors, order, refused)


@pytest.fixture
async def site(tmp_path: Path) -> AsyncIterator[Site]:
    async with monitors_of(tmp_path, FILES) as monitors:
        yield Site(monitors)


@pytest.mark.parametrize(
    ("outcome", "seconds", "status"),
    [("stopped", 0.482, 0), ("moving", 2.004, 1), ("ended", 0.4, 2), ("silent", 0.7, 2), ("idle", 30.01, 2)],
)
async def test_the_line_of_the_monitor_is_the_outcome(
    site: Site, outcome: str, seconds: float, status: int
) -> None:
    begun = await site.checks.begin(BEGIN, "eve")
    assert (begun.command, begun.outcome) == ("/cmd_vel", "")
    site.says("driver check: stopped after 9.000 s", "other")
    await site.checks.look()
    assert not site.removed() and not site.trail.records
    site.says(f"driver check: {outcome} after {seconds:.3f} s")
    await site.checks.look()
    check = await site.checks.check_drivers(DriverCheckWanted())
    assert (check.outcome, check.seconds, status_of(check.outcome)) == (outcome, seconds, status)
    assert site.removed()
    [row] = site.trail.rows
    assert (row["event"], row["reason"], row["who"]) == ("driver checked", f"/cmd_vel: {check.text}", "eve")


async def test_its_monitor_is_removed_before_the_client_reads_the_outcome(site: Site) -> None:
    """The next order would find it loaded, and `rosrv status` a change that waits for its confirmation."""
    await site.checks.begin(BEGIN, "eve")
    site.says("driver check: idle after 30.000 s")
    assert not site.removed()
    assert (await site.checks.check_drivers(DriverCheckWanted())).outcome == "idle"
    assert site.removed()
    assert site.monitors.confirm_by is None


async def test_its_end_does_not_confirm_a_change_during_the_check(site: Site) -> None:
    await site.checks.begin(BEGIN, "eve")
    change = admin.MonitorLoad({"speed.rv": SPEED}, confirm_within=600.0)
    loaded = await site.monitors.load(change, "ann")
    site.says("driver check: idle after 30.000 s")
    await site.checks.look()
    assert site.removed()
    assert site.monitors.confirm_by == loaded.confirm_by


async def test_the_monitor_is_loaded_behind_all_others_and_for_a_time(site: Site) -> None:
    await site.checks.begin(BEGIN, "eve")
    text = site.monitors.sources.files[f"{NAME}.rv"]
    compiled(text.replace("order deadman < driver_check;", "").replace("order speed < driver_check;", ""))
    assert "order deadman < driver_check;" in text and "order speed < driver_check;" in text
    assert "double longest = 2 s" in text and "double patience = 30 s" in text
    assert site.monitors.confirm_by is not None and site.monitors.confirm_by > clock.wall() + 32
    assert [*site.monitors.checked.monitors][-1] == NAME


async def gone(_site: Site) -> None:
    let_time_pass(3.1)


async def relay_dies(site: Site) -> None:
    site.pid = 8


async def no_line(site: Site) -> None:
    for _second in range(45):
        let_time_pass(1)
        await site.checks.check_drivers(DriverCheckWanted())


async def removed(site: Site) -> None:
    await site.monitors.remove(admin.MonitorRemove([f"{NAME}.rv"]), "bob")


@pytest.mark.parametrize(
    ("disturb", "why"),
    [
        (gone, "its client no longer asks"),
        (relay_dies, "a relay process was replaced"),
        (no_line, "the relay does not report"),
        (removed, "its monitor was removed"),
    ],
)
async def test_a_disturbed_check_ends_and_its_monitor_is_removed(site: Site, disturb: Any, why: str) -> None:
    await site.checks.begin(BEGIN, "eve")
    await site.checks.look()
    assert not site.removed()
    await disturb(site)
    await site.checks.look()
    assert site.removed()
    check = await site.checks.check_drivers(DriverCheckWanted())
    assert check.outcome == "interrupted" and why in check.text and status_of(check.outcome) == 2


async def test_a_control_that_starts_removes_the_monitor_of_the_last_one(site: Site) -> None:
    await site.checks.begin(BEGIN, "eve")
    again = Site(site.monitors)
    assert (await again.checks.check_drivers(DriverCheckWanted())).command == ""
    await again.checks.look()
    assert site.removed() and not again.trail.records
    assert site.monitors.confirm_by is None  # else all changes of the next minutes would be undone


async def test_a_removal_that_fails_is_tried_again(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    await site.checks.begin(BEGIN, "eve")
    site.says("driver check: stopped after 0.100 s")
    site.refuse(monkeypatch, "remove", 2)
    for tries in range(3):
        assert not site.removed(), tries
        await site.checks.look()
    assert site.removed()


async def test_one_check_at_a_time_and_none_beside_an_unconfirmed_change(site: Site) -> None:
    monitors = site.monitors
    await monitors.load(admin.MonitorLoad({"speed.rv": SPEED}, confirm_within=60.0), "eve")
    with pytest.raises(SenselessError, match="rosrv monitor confirm"):
        await site.checks.begin(BEGIN, "eve")
    await monitors.confirm(admin.MonitorConfirm(), "eve")
    before = monitors.tag
    for wrong in (DriverCheckBegin("/scan", "/odom"), DriverCheckBegin("/cmd_vel", "/odom", 11.0)):
        with pytest.raises(SenselessError):
            await site.checks.begin(wrong, "eve")
    assert monitors.tag == before
    await site.checks.begin(BEGIN, "eve")
    with pytest.raises(SenselessError, match="is being checked"):
        await site.checks.begin(BEGIN, "eve")


async def test_a_check_that_is_refused_does_not_begin(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    site.refuse(monkeypatch, "load", 1)
    with pytest.raises(SpecificationsRefusedError):
        await site.checks.begin(BEGIN, "eve")
    assert (await site.checks.check_drivers(DriverCheckWanted())).command == ""


async def test_a_check_in_shadow_mode_does_not_begin(tmp_path: Path) -> None:
    async with monitors_of(tmp_path, FILES, enable="shadow") as monitors:
        site = Site(monitors)
        assert (await site.checks.begin(BEGIN, "eve")).outcome == "interrupted"
        await site.checks.look()
        assert site.removed()


@pytest.mark.parametrize(
    "sentence", [sentences.CONSENT, sentences.QUESTION, sentences.REQUEST, sentences.RESTARTED]
)
def test_the_console_asks_and_warns_as_the_command_does(sentence: str) -> None:
    page = (Path(sentences.__file__).parent / "console" / "driver.js").read_text()
    assert sentence.replace("{:g}", "${seconds}") in page


def test_a_time_out_of_range_is_refused_before_the_warning() -> None:
    arguments = ["guard", "check-driver", "/cmd_vel", "--by", "/odom", "--for", "20s", "--yes"]
    answer = CliRunner().invoke(app, arguments)
    assert answer.exit_code == 2
    assert "--for 20s is out of bounds: write 0.2s to 10s" in answer.output
    assert "driven slowly" not in answer.output
