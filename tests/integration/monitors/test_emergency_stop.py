import contextlib
import itertools
import json
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.nodes import RosSession, need_ros
from tests.support.small_disk import filled, small_disk
from tests.support.waiting import eventually

STOP = """
stop() {
    bool pressed = false;
    event button(bool on) /stop std_msgs/Bool '{data:on}' { pressed = on; }
    event drive() /chatter std_msgs/String '{}' { if (pressed) { return; } }
}
"""


@pytest.fixture(scope="module")
def stopped(common_lab: Lab) -> Iterator[Appliance]:
    need_ros()
    host = common_lab.host("stopped", "10.77.0.3/24")
    with Appliance(host, options=("--api", "off"), relays=2) as running:
        spec = running.directory / "stop.rv"
        spec.write_text(STOP)
        running.rosrv("monitor", "load", str(spec))
        yield running


def monitor(appliance: Appliance) -> dict[str, Any]:
    rows = map(json.loads, appliance.rosrv("monitor", "list", "--json").stdout.splitlines())
    found: dict[str, Any] = next(row for row in rows if row["name"] == "stop")
    return found


def press(appliance: Appliance, ros: RosSession) -> None:
    before = monitor(appliance)["drops"]
    ros.run("rostopic", "pub", "-1", "/stop", "std_msgs/Bool", "data: true")
    eventually(lambda: monitor(appliance)["drops"] >= before + 3, appliance.story)


def kill_relays(appliance: Appliance) -> None:
    for pid in appliance.pids("relay"):
        os.kill(pid, signal.SIGKILL)


def kill_everything(appliance: Appliance) -> None:
    assert appliance.process is not None
    processes = sorted(appliance.status()["processes"], key=lambda row: row["role"] != "supervisor")
    for row in processes:
        if row["pid"]:  # 0: it waits for its start
            with contextlib.suppress(ProcessLookupError):
                os.kill(row["pid"], signal.SIGKILL)
    appliance.process.stop(with_signal=signal.SIGKILL, timeout=10)
    appliance.start()


def restart(appliance: Appliance) -> None:
    assert appliance.stop() == 0
    appliance.start()


DEATHS: dict[str, Callable[[Appliance], object]] = {
    "the relays": kill_relays,
    "control": lambda appliance: appliance.kill("control"),
    "rosmaster": lambda appliance: appliance.kill("rosmaster"),
    "everything": kill_everything,
    "everything, in order": restart,
}


@pytest.mark.parametrize("death", DEATHS)
def test_a_latched_stop_stays(stopped: Appliance, common_robot: Host, tmp_path: Path, death: str) -> None:
    numbers = itertools.count()

    def session() -> RosSession:
        folder = tmp_path / str(next(numbers))
        folder.mkdir()
        return RosSession(stopped.master_uri, folder, common_robot)

    with session() as ros:
        listener = ros.listener("roscpp", "/chatter")
        ros.talker("roscpp", "/chatter")
        listener.wait_for_count(3, event="received")
        press(stopped, ros)
    DEATHS[death](stopped)
    with session() as ros:
        listener = ros.listener("roscpp", "/chatter")
        before = eventually(lambda: monitor(stopped), stopped.story)["drops"]
        ros.talker("roscpp", "/chatter")
        eventually(lambda: monitor(stopped)["drops"] >= before + 10, stopped.story)
        assert listener.seen(event="received") == []
        assert monitor(stopped)["held"] is False
        ros.run("rostopic", "pub", "-1", "/stop", "std_msgs/Bool", "data: false")
        listener.wait_for_count(3, event="received")


def test_a_changed_stop_holds_until_it_is_resumed(
    stopped: Appliance, common_robot: Host, tmp_path: Path
) -> None:
    with RosSession(stopped.master_uri, tmp_path, common_robot) as ros:
        listener = ros.listener("roscpp", "/chatter")
        ros.talker("roscpp", "/chatter")
        listener.wait_for_count(3, event="received")
        press(stopped, ros)
        spec = stopped.directory / "stop.rv"
        spec.write_text(STOP.replace("pressed", "is_pressed"))
        refused = stopped.rosrv("monitor", "load", str(spec), check=False)
        assert (refused.returncode, monitor(stopped)["held"]) == (1, False)
        assert "drops every message of /chatter" in refused.stderr
        said = stopped.rosrv("monitor", "load", "--hold", str(spec))
        assert "rosrv monitor resume stop" in said.stdout + said.stderr
        assert "has changed" in monitor(stopped)["why_held"]
        assert stopped.recorded(event="topics held")[-1]["detail"]["monitor"] == "stop"
        assert "rosrv monitor resume stop" in stopped.rosrv("status", check=False).stdout
        mark = listener.mark()
        drops = monitor(stopped)["drops"]
        eventually(lambda: monitor(stopped)["drops"] >= drops + 5, stopped.story)
        restarts = len(stopped.audit(event="monitors restarted"))
        kill_relays(stopped)
        eventually(lambda: len(stopped.recorded(event="monitors restarted")) == restarts + 1, stopped.story)
        assert monitor(stopped)["held"]
        stopped.rosrv("monitor", "resume", "stop")
        listener.wait_for(event="received", since=mark)


def test_a_latched_stop_outlives_a_relay_on_a_full_disk(
    common_lab: Lab, common_robot: Host, tmp_path: Path
) -> None:
    """It is kept in a file whose blocks are reserved at the start."""
    appliance = Appliance(common_lab.host("full", "10.77.0.8/24"), options=("--api", "off"))
    try:
        with small_disk(appliance.state, "200m", "mode=755"):
            appliance.start()
            spec = appliance.directory / "stop.rv"
            spec.write_text(STOP)
            appliance.rosrv("monitor", "load", str(spec))
            with RosSession(appliance.master_uri, tmp_path, common_robot) as ros:
                listener = ros.listener("roscpp", "/chatter")
                ros.talker("roscpp", "/chatter")
                listener.wait_for_count(3, event="received")
                press(appliance, ros)
                mark = listener.mark()
                with filled(appliance.state):
                    killed = appliance.kill("relay")
                    eventually(lambda: killed not in appliance.pids("relay"), appliance.story)
                before = eventually(lambda: monitor(appliance), appliance.story)["drops"]
                eventually(lambda: monitor(appliance)["drops"] >= before + 10, appliance.story)
                assert not any(event.get("event") == "received" for event in listener.events[mark:])
                ros.run("rostopic", "pub", "-1", "/stop", "std_msgs/Bool", "data: false")
                listener.wait_for(event="received", since=mark)
            appliance.stop()
    finally:
        appliance.close()
