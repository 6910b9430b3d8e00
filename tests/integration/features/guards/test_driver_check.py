import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from appliance.channel import admin
from appliance.features.guards.presets import PRESETS, Guard, text_of
from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.command import ROSRV
from tests.support.nodes import RosSession
from tests.support.processes import Process
from tests.support.waiting import eventually

CHECK = ("guard", "check-driver", "/cmd_vel", "--by", "/odom", "--yes")
LIMIT = 4


@pytest.fixture(scope="module")
def guarded(common_lab: Lab) -> Iterator[Appliance]:
    deadman = text_of(Guard("deadman", PRESETS["deadman"]))
    host = common_lab.host("guarded", "10.77.0.5/24")
    with Appliance(host, options=("--api", "off"), monitors={"deadman": deadman}) as running:
        yield running


@pytest.fixture
def ros(guarded: Appliance, common_robot: Host, tmp_path: Path) -> Iterator[RosSession]:
    with RosSession(guarded.master_uri, tmp_path, common_robot) as session:
        yield session
    eventually(lambda: guards(guarded) == ["deadman"], "only the deadman is loaded")


def guards(appliance: Appliance) -> list[str]:
    return [row.name for row in appliance.ask(admin.MonitorsWanted()).monitors]


def outcome_in_log(appliance: Appliance, outcome: str) -> dict[str, Any]:
    def found() -> list[dict[str, Any]]:
        details = [one["detail"] for one in appliance.audit("--event", "driver checked")]
        return [detail for detail in details if detail["outcome"] == outcome]

    return eventually(found, f"a check with the outcome {outcome}")[-1]


def driven(ros: RosSession, timeout: float) -> Process:
    base = ros.node("rospy", "driven_base", str(timeout))
    ros.node("rospy", "driver", name="driver")
    base.wait_for(event="moves")
    return base


def begun(appliance: Appliance) -> "subprocess.Popen[bytes]":
    return subprocess.Popen([ROSRV, *CHECK, "--for", f"{LIMIT}s", "--state", str(appliance.state)])


@pytest.mark.parametrize(("timeout", "outcome", "status"), [(0.48, "stopped", 0), (0, "moving", 1)])
def test_a_driver_is_measured(
    guarded: Appliance, ros: RosSession, timeout: float, outcome: str, status: int
) -> None:
    base = driven(ros, timeout)
    mark = base.mark()
    done = guarded.rosrv(*CHECK, check=False)
    assert done.returncode == status, done.stdout + done.stderr
    assert abs(outcome_in_log(guarded, outcome)["seconds"] - (timeout or 2)) < 0.2
    base.wait_for(event="moves", since=mark)  # again


Death = Callable[[Appliance, "subprocess.Popen[bytes]"], None]


def kill_command(_appliance: Appliance, command: "subprocess.Popen[bytes]") -> None:
    command.send_signal(signal.SIGKILL)


def kill_relay(appliance: Appliance, _command: "subprocess.Popen[bytes]") -> None:
    appliance.kill("relay")


def kill_control(appliance: Appliance, _command: "subprocess.Popen[bytes]") -> None:
    appliance.kill("control")


@pytest.mark.parametrize("death", [kill_command, kill_relay, kill_control])
def test_commands_pass_and_guards_act_after_a_death_during_the_measurement(
    guarded: Appliance, ros: RosSession, death: Death
) -> None:
    base = driven(ros, 0)
    mark = base.mark()
    command = begun(guarded)
    base.wait_for(event="silent", since=mark, timeout=60)
    death(guarded, command)
    again = base.wait_for(lambda event: event["event"] in {"moves", "stands"}, since=mark, timeout=60)
    assert again["silent"] < LIMIT + 0.5 or death is kill_relay, again
    base.wait_for(event="moves", since=mark, timeout=60)
    command.wait(60)
    eventually(lambda: guards(guarded) == ["deadman"], "the monitor is removed")
    mark = base.mark()
    ros.processes[-1].kill()
    base.wait_for(event="stands", since=mark)


def test_a_killed_command_withholds_nothing_later(guarded: Appliance, ros: RosSession) -> None:
    base = ros.node("rospy", "driven_base", "0")
    idle = ros.node("rospy", "driver", name="idle")
    base.wait_for(event="moves")
    idle.kill()
    command = begun(guarded)
    eventually(lambda: "driver_check" in guards(guarded), "the monitor is loaded")
    command.kill()
    command.wait()
    eventually(lambda: guards(guarded) == ["deadman"], "the monitor is removed")
    assert outcome_in_log(guarded, "interrupted")["seconds"] is None
