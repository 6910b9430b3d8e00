from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from appliance.channel import admin
from appliance.channel.answers.graph_answers import Graph, Topic
from appliance.channel.messages import MonitorEvent
from appliance.cli.main import app
from appliance.control.errors import SenselessError
from appliance.features.guards import driver_outcomes as sentences
from appliance.features.guards.driver_check import NAME, DriverChecks
from appliance.features.guards.driver_outcomes import status_of
from appliance.features.guards.requests import DriverCheckBegin, DriverCheckWanted
from appliance.specifications.specification_files import SpecificationsRefusedError
from tests.support.core import FakeTrail
from tests.support.virtual_clock import let_time_pass
from tests.unit.features.guards.test_presets import compiled

pytestmark = pytest.mark.anyio
BEGIN = DriverCheckBegin("/cmd_vel", "/odom", 2.0, 30.0)


class Manager:
    confirm_by: float | None = None
    enabled = True

    def __init__(self) -> None:
        self.orders: list[Any] = []
        self.refusals = 0
        self.checked = SimpleNamespace(monitors={"deadman": "deadman.rv", "speed": "speed.rv"})
        self.switches = SimpleNamespace(enabled=lambda _name: self.enabled)
        self.records = SimpleNamespace(told=[])

    async def load(self, request: admin.MonitorLoad, _who: str, *, enable: bool) -> None:
        assert enable  # also where new monitors are disabled
        if self.refusals:
            raise SpecificationsRefusedError(["it would hold /cmd_vel"])
        self.orders.append(request)
        self.checked.monitors = {**self.checked.monitors, NAME: f"{NAME}.rv"}

    async def remove(self, request: admin.MonitorRemove, _who: str) -> None:
        if self.refusals:
            self.refusals -= 1
            raise SpecificationsRefusedError(["not now"])
        self.orders.append(request)
        self.checked.monitors = {name: file for name, file in self.checked.monitors.items() if name != NAME}

    def says(self, text: str, monitor: str = NAME) -> None:
        for tell in self.records.told:
            tell(MonitorEvent("log", monitor, "", "", 0, text, {"level": "WARN"}))

    def removed(self) -> bool:
        return NAME not in self.checked.monitors


class Site:
    def __init__(self, manager: Manager) -> None:
        self.trail = FakeTrail()
        self.pid = 7
        topics = [
            Topic("/cmd_vel", "geometry_msgs/Twist", True, [], [], []),
            Topic("/odom", "nav_msgs/Odometry", True, [], [], []),
        ]
        self.checks = DriverChecks(
            manager, self.trail, lambda: Graph([], topics, []),  # type: ignore[arg-type]  # as much of them as checks need
            lambda: [SimpleNamespace(role="relay", pid=self.pid), SimpleNamespace(role="api", pid=9)],  # type: ignore[list-item]  # as much of them as checks need
        )  # fmt: skip


@pytest.fixture
def manager() -> Manager:
    return Manager()


@pytest.fixture
def site(manager: Manager) -> Site:
    return Site(manager)


@pytest.mark.parametrize(
    ("outcome", "seconds", "status"),
    [("stopped", 0.482, 0), ("moving", 2.004, 1), ("ended", 0.4, 2), ("silent", 0.7, 2), ("idle", 30.01, 2)],
)
async def test_the_line_of_the_monitor_is_the_outcome(
    manager: Manager, site: Site, outcome: str, seconds: float, status: int
) -> None:
    begun = await site.checks.begin(BEGIN, "eve")
    assert (begun.command, begun.outcome) == ("/cmd_vel", "")
    manager.says("driver check: stopped after 9.000 s", "other")
    await site.checks.look()
    assert not manager.removed() and not site.trail.records
    manager.says(f"driver check: {outcome} after {seconds:.3f} s")
    await site.checks.look()
    found = await site.checks.wanted(DriverCheckWanted())
    assert (found.outcome, found.seconds, status_of(found.outcome)) == (outcome, seconds, status)
    assert manager.removed()
    [row] = site.trail.rows
    assert (row["event"], row["reason"], row["who"]) == ("driver checked", f"/cmd_vel: {found.text}", "eve")


async def test_its_monitor_is_removed_before_the_client_reads_the_outcome(
    manager: Manager, site: Site
) -> None:
    """The next order would find it loaded, and `rosrv status` a change that waits for its confirmation."""
    await site.checks.begin(BEGIN, "eve")
    manager.says("driver check: idle after 30.000 s")
    assert not manager.removed()
    assert (await site.checks.wanted(DriverCheckWanted())).outcome == "idle"
    assert manager.removed()


async def test_the_monitor_is_loaded_behind_all_others_and_for_a_time(manager: Manager, site: Site) -> None:
    await site.checks.begin(BEGIN, "eve")
    [load] = manager.orders
    [text] = load.files.values()
    compiled(text.replace("order deadman < driver_check;", "").replace("order speed < driver_check;", ""))
    assert "order deadman < driver_check;" in text and "order speed < driver_check;" in text
    assert "double longest = 2 s" in text and "double patience = 30 s" in text
    assert load.confirm_within > 32


async def gone(site: Site, _manager: Manager) -> None:
    let_time_pass(3.1)


async def relay_dies(site: Site, _manager: Manager) -> None:
    site.pid = 8


async def no_line(site: Site, _manager: Manager) -> None:
    for _second in range(45):
        let_time_pass(1)
        await site.checks.wanted(DriverCheckWanted())


async def removed(_site: Site, manager: Manager) -> None:
    del manager.checked.monitors[NAME]


@pytest.mark.parametrize(
    ("disturb", "why"),
    [
        (gone, "its client no longer asks"),
        (relay_dies, "a relay process was replaced"),
        (no_line, "the relay does not report"),
        (removed, "its monitor was removed"),
    ],
)
async def test_a_disturbed_check_ends_and_its_monitor_is_removed(
    manager: Manager, site: Site, disturb: Any, why: str
) -> None:
    await site.checks.begin(BEGIN, "eve")
    await site.checks.look()
    assert not manager.removed()
    await disturb(site, manager)
    await site.checks.look()
    assert manager.removed()
    found = await site.checks.wanted(DriverCheckWanted())
    assert found.outcome == "interrupted" and why in found.text and status_of(found.outcome) == 2


async def test_a_control_that_starts_removes_the_monitor_of_the_last_one(manager: Manager) -> None:
    await Site(manager).checks.begin(BEGIN, "eve")
    again = Site(manager)
    assert (await again.checks.wanted(DriverCheckWanted())).command == ""
    await again.checks.look()
    assert manager.removed() and not again.trail.records


async def test_a_removal_that_fails_is_tried_again(manager: Manager, site: Site) -> None:
    await site.checks.begin(BEGIN, "eve")
    manager.says("driver check: stopped after 0.100 s")
    manager.refusals = 2
    for tries in range(3):
        assert not manager.removed(), tries
        await site.checks.look()
    assert manager.removed()


async def test_one_check_at_a_time_and_none_beside_an_unconfirmed_change(
    manager: Manager, site: Site
) -> None:
    manager.confirm_by = 1.0
    with pytest.raises(SenselessError, match="rosrv monitor confirm"):
        await site.checks.begin(BEGIN, "eve")
    manager.confirm_by = None
    for wrong in (DriverCheckBegin("/scan", "/odom"), DriverCheckBegin("/cmd_vel", "/odom", 11.0)):
        with pytest.raises(SenselessError):
            await site.checks.begin(wrong, "eve")
    assert not manager.orders
    await site.checks.begin(BEGIN, "eve")
    with pytest.raises(SenselessError, match="is being checked"):
        await site.checks.begin(BEGIN, "eve")


async def test_a_check_that_is_refused_or_in_shadow_mode_does_not_begin(manager: Manager, site: Site) -> None:
    manager.refusals = 1
    with pytest.raises(SpecificationsRefusedError):
        await site.checks.begin(BEGIN, "eve")
    assert (await site.checks.wanted(DriverCheckWanted())).command == ""
    manager.refusals, manager.enabled = 0, False
    assert (await site.checks.begin(BEGIN, "eve")).outcome == "interrupted"
    await site.checks.look()
    assert manager.removed()


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
