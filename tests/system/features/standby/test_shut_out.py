import os
import threading
import time
from collections.abc import Iterator

import pytest

from tests.support.features.standby.standby_robot import StandbyRobot
from tests.support.features.standby.standby_site import StandbySite
from tests.support.processes import Process
from tests.support.waiting import allowed

BACK_SECONDS = 3.0


@pytest.fixture(autouse=True)
def nothing_is_lost(site: StandbySite, robot: StandbyRobot) -> Iterator[None]:
    site.until_both_in_sync()
    robot.works()
    before = site.pair()
    yield
    robot.lost_nothing()
    assert site.pair() == before


@pytest.mark.parametrize("seconds", [0.4, 1.5, 4.0])
def test_nodes_are_back_soon(site: StandbySite, robot: StandbyRobot, seconds: float) -> None:
    site.stop_witness()
    with Process(site.robot, site.command("shut"), env=dict(os.environ), label="shut") as shut:
        assert shut.wait() == 0, shut.story()
    threading.Event().wait(seconds)
    site.start_witness()
    began = time.monotonic()
    robot.works()
    took = time.monotonic() - began
    assert took < allowed(BACK_SECONDS), f"{took:.1f} s after {seconds} s"
