import os
from collections.abc import Callable
from pathlib import Path

import pytest

from appliance.base import clock
from appliance.channel.messages import StateOwner
from appliance.configuration.settings import Audit, Settings
from appliance.features.standby.lease_link import ControlServes
from appliance.features.standby.service_begin import ServiceReport, holds_if_lost
from appliance.specifications.switches import Switches
from tests.support.core import FakeTrail, MemoryLog
from tests.support.virtual_clock import VirtualClock


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    (tmp_path / "control").mkdir()
    return Settings(state=tmp_path)


def report_of(
    settings: Settings,
    log: MemoryLog | None = None,
    *,
    keeps_state: bool = False,
    relays: Callable[[], str] = lambda: "connected",
    probe: Callable[[], str] = lambda: "passed",
    overdue: Callable[[], float] = lambda: 0.0,
) -> ServiceReport:
    log = log or FakeTrail().log
    return ServiceReport(settings, log, lambda: keeps_state, relays=relays, probe=probe, overdue=overdue)


def test_calls_without_an_answer_are_an_obstacle(settings: Settings) -> None:
    """Control reports in time, but answers no call."""
    for seconds, obstacle in ((10.0, ""), (10.4, "no call has been answered for 10 s")):
        assert report_of(settings, overdue=lambda seconds=seconds: seconds).now().obstacle == obstacle  # type: ignore[misc]  # mypy infers no type for a lambda's default


def test_a_full_disk_is_an_obstacle(settings: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hosts are already waiting, and a standby with such a disk could not take over."""
    for free, obstacle in ((1023, "4190208 bytes are free"), (1024, "")):
        disk = os.statvfs_result((4096, 4096, 0, 0, free, 0, 0, 0, 0, 255))
        monkeypatch.setattr("os.statvfs", lambda _folder, disk=disk: disk)
        found = report_of(settings).now().obstacle
        assert (obstacle in found, bool(found)) == (True, bool(obstacle))


def test_a_log_that_fails_is_an_obstacle_only_if_nothing_is_granted_then(settings: Settings) -> None:
    """With `audit.on_audit_failure: allow`, control continues without records."""
    log = FakeTrail().log
    assert report_of(settings, log).now() == ControlServes("", keeps_state=False)
    log.failure = "audit.db: the disk is full"
    assert "cannot be written: audit.db: the disk is full" in report_of(settings, log).now().obstacle
    allowing = Settings(state=settings.state, audit=Audit(on_audit_failure="allow"))
    assert report_of(allowing, log).now().obstacle == ""


@pytest.mark.parametrize("broken", [{"relays": "away"}, {"probe": "it answers"}], ids=str)
def test_damage_that_is_repaired_in_time_is_not_reported(broken: dict[str, str], settings: Settings) -> None:
    present = sound = {"relays": "connected", "probe": "passed"}
    machine = VirtualClock()
    with clock.using(machine):
        report = report_of(settings, relays=lambda: present["relays"], probe=lambda: present["probe"])
        for seconds, state, is_reported in (
            (7, broken, False),
            (7, {}, False),
            (7, broken, False),
            (9, broken, True),
        ):
            present = sound | state
            machine.advance(seconds)
            assert bool(report.now().obstacle) is is_reported


def test_only_monitors_in_force_keep_state(settings: Settings) -> None:
    """A monitor that is disabled or in shadow mode holds nothing after a takeover."""
    holds, stateless = StateOwner("1", frozenset({"/cmd_vel"}), ""), StateOwner("2", frozenset(), "")
    switches = Switches(states={"gun": True, "arm": False, "leg": "shadow"})
    assert holds_if_lost({"gun": holds, "arm": stateless}, switches.is_enabled)
    assert not holds_if_lost({"gun": stateless, "arm": holds, "leg": holds}, switches.is_enabled)
    assert report_of(settings, keeps_state=True).now().keeps_state
