from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from appliance.base import clock
from appliance.features.standby.lease_link import ControlServes
from appliance.features.standby.service_begin import ServiceReport
from tests.support.virtual_clock import VirtualClock


class Control:
    def __init__(self, state: Path) -> None:
        (state / "control").mkdir()
        self.state = state
        self.audit = SimpleNamespace(failed=None)
        self.policy = SimpleNamespace(on_audit_failure="deny")
        self.surroundings = SimpleNamespace(probe="passed")
        self.relay = SimpleNamespace(presence="connected")
        self.switches = SimpleNamespace(enabled=lambda name: name == "gun")
        self.checked = SimpleNamespace(states={"gun": SimpleNamespace(held=False)})

    def report(self) -> ServiceReport:
        control: Any = SimpleNamespace(
            audit=self.audit,
            settings=SimpleNamespace(audit=self.policy, state=self.state),
            monitors=SimpleNamespace(switches=self.switches, checked=self.checked),
            relays=lambda: self.relay.presence,
            probe=lambda: self.surroundings.probe,
        )
        return ServiceReport(control)


@pytest.fixture
def control(tmp_path: Path) -> Control:
    return Control(tmp_path)


def test_a_full_disk_is_an_obstacle(control: Control, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hosts are already waiting, and a standby with such a disk could not take over."""
    report = control.report()
    monkeypatch.setattr("os.statvfs", lambda _folder: SimpleNamespace(f_bavail=1023, f_frsize=4096))
    assert "4190208 bytes are free" in report.now().obstacle
    monkeypatch.setattr("os.statvfs", lambda _folder: SimpleNamespace(f_bavail=1024, f_frsize=4096))
    assert report.now().obstacle == ""


def test_a_log_that_fails_is_an_obstacle_only_if_nothing_is_granted_then(control: Control) -> None:
    """With `audit.on_audit_failure: allow`, control continues without records."""
    report = control.report()
    assert report.now() == ControlServes("", keeps_state=False)
    control.audit.failed = "audit.db: the disk is full"
    assert "cannot be written: audit.db: the disk is full" in report.now().obstacle
    control.policy.on_audit_failure = "allow"
    assert report.now().obstacle == ""


@pytest.mark.parametrize("broken", [("relay", "presence", "away"), ("surroundings", "probe", "it answers")])
def test_damage_that_is_repaired_in_time_is_not_reported(
    broken: tuple[str, str, str], control: Control
) -> None:
    part, field, value = broken
    machine = VirtualClock()
    with clock.using(machine):
        report = control.report()
        before = getattr(getattr(control, part), field)
        for seconds, state, found in (
            (7, value, False),
            (7, before, False),
            (7, value, False),
            (9, value, True),
        ):
            setattr(getattr(control, part), field, state)
            machine.advance(seconds)
            assert bool(report.now().obstacle) is found


def test_only_monitors_in_force_keep_state(control: Control) -> None:
    """A monitor that is disabled or in shadow mode holds nothing after a takeover."""
    control.checked.states = {"gun": SimpleNamespace(held=True), "arm": SimpleNamespace(held=False)}
    assert control.report().now().keeps_state
    control.checked.states = {"gun": SimpleNamespace(held=False), "arm": SimpleNamespace(held=True)}
    assert not control.report().now().keeps_state
