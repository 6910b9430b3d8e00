"""Robots of vendors boot beside the package in random orders, adopted or not: no other machine finds a robot's own
master, and no unit fails.

`ROSRV_BOOTS` is the number of boots of each robot.
"""

import os
import random
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.booted_debian import BootedDebian, booted_debian
from tests.support.vendors_robot import (
    adopt,
    closed,
    is_adopted,
    nodes,
    roslaunch_alone,
    runs,
    write_robot,
)
from tests.support.waiting import eventually

pytestmark = pytest.mark.timeout(7200)  # the system is fetched and the package is built
BOOTS = int(os.environ.get("ROSRV_BOOTS", "2"))
_LATEST = 10.0  # seconds


@pytest.mark.parametrize("suite", ["bookworm", "trixie"])
def test_a_roslaunch_with_its_own_master(suite: str, package: Path, tmp_path: Path) -> None:
    with booted_debian(tmp_path, suite, package) as debian:
        debian.boot()
        serves(debian)
        write_robot(debian, roslaunch_alone())
        debian.run("systemctl", "daemon-reload")
        debian.run("systemctl", "enable", "robot")
        for generator in orders():
            boot(debian, ["robot"], generator)
            settle(debian, lambda: debian.state() == "active" or debian.said().startswith("waits: "))
            runs(debian)
            units_are_content(debian, "robot")
            if debian.state() != "active":
                assert debian.shell("rosrv status >/dev/null 2>&1; echo $?") == "1", "the operator is told"
            disturb(debian, generator)


@pytest.mark.parametrize("suite", ["bookworm", "trixie"])
def test_an_adopted_roslaunch_with_its_own_master(suite: str, package: Path, tmp_path: Path) -> None:
    with booted_debian(tmp_path, suite, package) as debian:
        debian.boot()
        serves(debian)
        adopt(debian, roslaunch_alone())
        for generator in orders():
            boot(debian, ["robot"], generator)
            settle(debian, lambda: is_adopted(debian) and {"/drive", "/hear"} <= nodes(debian))
            runs(debian)
            units_are_content(debian, "robot")
            disturb(debian, generator)


def orders() -> list[random.Random]:
    """Return a generator for each boot, whose seed is its number."""
    return [random.Random(number) for number in range(BOOTS)]  # noqa: S311  orders, no secrets


def serves(debian: BootedDebian) -> None:
    eventually(lambda: debian.state() == "active", debian.story)


def boot(debian: BootedDebian, units: list[str], generator: random.Random) -> None:
    if generator.random() < 0.25:
        debian.cut_power()
    else:
        debian.end()
    for unit in ("rosrv", *units):
        drop_in = debian.root / f"etc/systemd/system/{unit}.service.d/order.conf"
        drop_in.parent.mkdir(exist_ok=True)
        drop_in.write_text(f"[Service]\nExecStartPre=/bin/sleep {generator.uniform(0, _LATEST):.1f}\n")
    debian.boot()


def settle(debian: BootedDebian, is_settled: Callable[[], bool]) -> None:
    """Wait for the end of a boot, in which no other machine may reach the robot's own master."""
    with closed(debian):
        eventually(is_settled, debian.story)


def units_are_content(debian: BootedDebian, *units: str) -> None:
    assert {debian.state(unit) for unit in units} == {"active"}, debian.story()
    shown = debian.run("systemctl", "show", "--property=NRestarts", "--value", *units).split()
    assert shown == ["0"] * len(units), f"{shown}\n{debian.story()}"


def disturb(debian: BootedDebian, generator: random.Random) -> None:
    """Do to the appliance what happens between boots."""
    event = generator.choice(["nothing", "kill", "upgrade"])
    if event == "kill":
        debian.run("systemctl", "kill", "--kill-whom=main", "--signal=KILL", "rosrv")
    elif event == "upgrade":
        debian.run("dpkg", "--install", "/root/rosrv.deb")
    if event != "nothing":
        settle(debian, lambda: debian.state() == "active" or debian.said().startswith("waits: "))
        runs(debian)
