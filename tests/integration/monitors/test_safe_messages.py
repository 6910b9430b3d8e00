from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from examples.landshark.lab import Host, Lab
from tests.support.appliance import Appliance
from tests.support.nodes import RosSession, need_ros
from tests.support.processes import Process
from tests.support.waiting import eventually

GUARD = """
guard() given { int least = 1 in 0..9; } {
    int near = 9;
    safe std_msgs/String { data:"stop" } on /chatter every 100ms;
    event scan(std::vector<int> ranges) /scan std_msgs/Int32MultiArray '{data:ranges}' { near = ranges[0]; }
    event drive() /chatter std_msgs/String '{}' { if (near < least) { STOP; } }
}
"""


@pytest.fixture(scope="module")
def guarded(common_lab: Lab) -> Iterator[Appliance]:
    need_ros()
    host = common_lab.host("guarded", "10.77.0.4/24")
    with Appliance(host, options=("--api", "off")) as running:
        (running.directory / "guard.rv").write_text(GUARD)
        running.rosrv("monitor", "load", str(running.directory / "guard.rv"))
        yield running


def scan(_: Appliance, ros: RosSession, ranges: str) -> None:
    ros.run("rostopic", "pub", "-1", "/scan", "std_msgs/Int32MultiArray", f"data: [{ranges}]")


def change(appliance: Appliance, _: RosSession) -> None:
    spec = appliance.directory / "guard.rv"
    spec.write_text(spec.read_text().replace("near", "nearest"))
    appliance.rosrv("monitor", "load", "--hold", str(spec))


def tighten(appliance: Appliance, ros: RosSession) -> None:
    appliance.rosrv("monitor", "set", "guard", "least=9")
    scan(appliance, ros, "5")


def restart(appliance: Appliance, _: RosSession) -> None:
    assert appliance.stop() == 0
    appliance.start()


def kill_control(appliance: Appliance, _: RosSession) -> None:
    appliance.kill("control")
    eventually(lambda: appliance.rosrv("monitor", "list", check=False).returncode == 0, appliance.story)


def held(appliance: Appliance) -> list[str]:
    return [str(row["name"]) for row in appliance.rows("monitor", "list") if row["held"]]


def only_stops(base: Process, since: int) -> None:
    base.wait_for_count(20, event="received", data="stop", since=since, timeout=90)
    assert [one["data"] for one in base.seen(event="received")[-20:]] == ["stop"] * 20


ROWS: dict[str, tuple[Callable[[Appliance, RosSession], object], bool]] = {
    "an obstacle": (lambda appliance, ros: scan(appliance, ros, "0"), False),
    "a new bound": (tighten, False),
    "a faulty sensor": (lambda appliance, ros: scan(appliance, ros, ""), True),
    "a changed text": (change, True),
    "a killed control": (kill_control, False),
    "a policy reload": (lambda appliance, _ros: appliance.rosrv("policy", "reload"), False),
}


@pytest.mark.parametrize("row", ROWS)
def test_the_base_gets_stops_and_nothing_else(
    guarded: Appliance, common_robot: Host, tmp_path: Path, row: str
) -> None:
    disturb, holds = ROWS[row]
    with RosSession(guarded.master_uri, tmp_path, common_robot) as ros:
        base = ros.listener("roscpp", "/chatter")
        ros.talker("roscpp", "/chatter")
        scan(guarded, ros, "5")
        base.wait_for_count(3, event="received")
        scan(guarded, ros, "0")
        disturb(guarded, ros)
        only_stops(base, base.mark())
        assert held(guarded) == (["guard"] if holds else [])
        guarded.kill("relay")
        only_stops(base, base.mark())
        if holds:
            guarded.rosrv("monitor", "resume", "guard")
        guarded.rosrv("monitor", "set", "guard", "least=1")
        scan(guarded, ros, "5")
        base.wait_for(lambda event: "hello" in event.get("data", ""), since=base.mark(), timeout=60)


@pytest.mark.parametrize("death", ["relay", "appliance"])
def test_a_restart_sends_stops_until_a_command_comes(
    guarded: Appliance, common_robot: Host, tmp_path: Path, death: str
) -> None:
    with RosSession(guarded.master_uri, tmp_path, common_robot) as ros:
        base = ros.listener("roscpp", "/chatter")
        talker = ros.talker("roscpp", "/chatter")
        base.wait_for_count(3, event="received")
        talker.kill()
        mark = base.mark()
        if death == "relay":
            guarded.kill("relay")
        else:
            restart(guarded, ros)
        base.wait_for_count(10, event="received", data="stop", since=mark, timeout=90)
        assert held(guarded) == []
        ros.talker("roscpp", "/chatter", name="again")
        base.wait_for(lambda event: "hello" in event.get("data", ""), since=mark, timeout=60)


def test_a_goal_that_was_dropped_does_not_come_when_its_guard_is_off(
    guarded: Appliance, common_robot: Host, tmp_path: Path
) -> None:
    """Its client latches it, as `rostopic pub` does."""
    picky = guarded.directory / "picky.rv"
    picky.write_text("begin picky() { event goal() /arm/goal std_msgs/String '{}' { DROP; } }")
    guarded.rosrv("monitor", "load", str(picky))
    with RosSession(guarded.master_uri, tmp_path, common_robot) as ros:
        server = ros.listener("roscpp", "/arm/goal")
        ros.talker("rospy", "/arm/goal", "--latch")
        guarded.recorded(
            "--event", "connection opened", resource="/arm/goal"
        )  # a later one gets what is latched
        guarded.recorded("--event", "message dropped", resource="/arm/goal")
        guarded.rosrv("monitor", "disable", "picky")
        ros.talker("rospy", "/arm/goal", "--latch", name="again")
        server.wait_for(event="received", publisher="/again")
        assert {one["publisher"] for one in server.seen(event="received")} == {"/again"}
    guarded.rosrv("monitor", "remove", "picky")
