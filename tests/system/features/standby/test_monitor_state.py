import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from appliance.channel import admin
from examples.landshark.lab import Lab
from tests.integration.monitors.test_emergency_stop import STOP
from tests.support.features.guards.guarded_robot import PATIENCE, GuardedRobot, rows
from tests.support.features.standby.standby_site import ADDRESSES, ROBOT, StandbySite
from tests.support.nodes import need_ros
from tests.support.requirements import need_root
from tests.support.waiting import eventually


@pytest.fixture
def site(tmp_path: Path) -> Iterator[StandbySite]:
    need_root()
    need_ros()
    with Lab("rosrv-monitors") as lab, StandbySite(lab, tmp_path) as made:
        made.begin()
        spec = made.appliances["a"].directory / "stop.rv"
        spec.write_text(STOP)
        made.appliances["a"].rosrv("monitor", "load", str(spec))
        yield made


def monitor(site: StandbySite, name: str) -> dict[str, Any]:
    return site.appliances[name].row("monitor", "list")


def dropped(site: StandbySite, name: str, least: int) -> bool:
    return int(monitor(site, name)["drops"]) >= least


@pytest.mark.parametrize("takeover", ["switchover", "power cut", "cut from the robot"])
def test_a_latched_stop_stays(site: StandbySite, takeover: str) -> None:
    with site.ros() as ros:
        listener = ros.listener("rospy", "/chatter")
        ros.talker("roscpp", "/chatter")
        listener.wait_for_count(3, event="received")
        ros.run("rostopic", "pub", "-1", "/stop", "std_msgs/Bool", "data: true")
        eventually(lambda: dropped(site, "a", 10), site.story)  # earlier messages have arrived by then
        seen = len(listener.seen(event="received"))
        if takeover == "switchover":
            site.promote("a")
        elif takeover == "power cut":
            site.cut("a")
        cut = ((ADDRESSES["a"], ROBOT),) if takeover == "cut from the robot" else ()
        with site.without_link(*cut):
            eventually(lambda: site.holder() == "b", site.story)
        eventually(lambda: dropped(site, "b", 10), site.story)
        assert len(listener.seen(event="received")) == seen
        assert not monitor(site, "b")["held"]
        ros.run("rostopic", "pub", "-1", "/stop", "std_msgs/Bool", "data: false")
        listener.wait_for_count(seen + 3, event="received")


@pytest.mark.parametrize("takeover", ["switchover", "power cut"])
def test_a_guarded_base_moves_again(site: StandbySite, takeover: str) -> None:
    guards = [(row, row.guard()) for row in rows() if row.preset in {"separation", "zone"}]
    with GuardedRobot(site.appliances["a"], site.ros(), guards) as robot:
        assert robot.moves(0) < math.inf
        if takeover == "switchover":
            site.promote("a")
        else:
            site.cut("a")
        eventually(lambda: site.holder() == "b", site.story)
        robot.appliance = site.appliances["b"]
        eventually(lambda: all(one.enabled for one in robot.ask(admin.MonitorsWanted()).monitors), site.story)
        assert robot.moves(time.monotonic()) <= PATIENCE
        assert not robot.faults()
