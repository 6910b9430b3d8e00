"""A robot that boots by systemd is adopted, booted in each order, and given back with the package's removal.

`ROSRV_BOOTS` is the number of boots in each order.
"""

import json
import os
import threading
from pathlib import Path

import pytest

from tests.support.booted_debian import BootedDebian, booted_debian
from tests.support.vendors_robot import adopted, closed, fetch_like, is_adopted, record_of, runs, write_robot
from tests.support.waiting import eventually

pytestmark = pytest.mark.timeout(7200)  # the system is fetched and the package is built
BOOTS = int(os.environ.get("ROSRV_BOOTS", "1"))
ORDERS = {
    "the robot first": {"rosrv": "[Service]\nExecStartPre=/bin/sleep 8\n"},
    "the appliance first": {"roscore": "[Unit]\nAfter=rosrv.service\n"},
}


@pytest.mark.parametrize("suite", ["bookworm", "trixie"])
def test_a_vendors_robot_is_adopted_and_given_back(suite: str, package: Path, tmp_path: Path) -> None:
    with booted_debian(tmp_path, suite, package) as debian:
        write_robot(debian, fetch_like())
        debian.boot()
        debian.run("systemctl", "stop", "rosrv")
        debian.run("systemctl", "enable", "--now", "roscore", "robot")
        runs(debian)
        debian.run("systemctl", "start", "--no-block", "rosrv")
        eventually(lambda: debian.said().startswith("waits: "), debian.story)
        lives = debian.run("systemctl", "show", "--property=MainPID", "roscore", "robot")
        checked = debian.shell("rosrv adopt --check")
        assert "robot.service needs roscore.service; a drop-in keeps roscore.service working" in checked
        assert "stop" not in checked
        assert "adopted" in debian.shell("rosrv adopt --audit-only")
        assert "[Options]" in (debian.root / "etc/rosrv/policies/default.ini").read_text()
        adopted(debian)
        assert debian.run("systemctl", "show", "--property=MainPID", "roscore", "robot") == lives
        the_own_master_restarts(debian)
        for order, drop_ins in ORDERS.items():
            for _ in range(BOOTS):
                boots_adopted(debian, order, drop_ins)
        the_power_fails_in_the_middle(debian)
        with closed(debian):
            debian.run("systemctl", "restart", "rosrv")
            adopted(debian)
        removal = debian.run("dpkg", "--remove", "rosrv")
        runs(debian)
        assert not list((debian.root / "etc/systemd/system").glob("*/50-rosrv-adopt.conf")), (
            f"{removal}\n{debian.story()}"
        )
        assert "rosrv" not in debian.run("nft", "list", "tables")


def the_own_master_restarts(debian: BootedDebian) -> None:
    debian.run("systemctl", "restart", "roscore")
    adopted(debian)
    assert debian.run("systemctl", "show", "--property=NRestarts", "--value", "roscore", "robot").split() == [
        "0",
        "0",
    ]
    assert debian.state("roscore") == debian.state("robot") == "active"


def boots_adopted(debian: BootedDebian, order: str, drop_ins: dict[str, str]) -> None:
    debian.end()
    files = [debian.root / f"etc/systemd/system/{unit}.service.d/order.conf" for unit in drop_ins]
    for file, text in zip(files, drop_ins.values(), strict=True):
        file.parent.mkdir(exist_ok=True)
        file.write_text(text)
    debian.boot()
    adopted(debian)
    states = [debian.state(unit) for unit in ("rosrv", "roscore", "robot")]
    assert states == ["active"] * 3, f"{order}: {states}\n{debian.story()}"
    assert debian.run("systemctl", "show", "--property=NRestarts", "--value", "roscore", "robot").split() == [
        "0",
        "0",
    ], order
    assert "denied" not in debian.shell("rosrv adopt --status"), order
    for file in files:
        file.unlink()


def the_power_fails_in_the_middle(debian: BootedDebian) -> None:
    """After the next boot, the graph is where the record wants it, and each node is heard."""
    for command in ("rosrv release --force", "rosrv adopt"):
        for seconds in (0.8, 1.6):
            debian.begin(command)
            threading.Event().wait(seconds)
            debian.cut_power()
            debian.boot()
            settled(debian)
    debian.shell("rosrv adopt")
    adopted(debian)


def settled(debian: BootedDebian) -> None:
    def is_as_wanted() -> bool:
        wanted = json.loads(record_of(debian).read_text())["wanted"]
        if wanted:
            return is_adopted(debian)
        return "nothing is adopted" in debian.shell("rosrv adopt --status") or debian.said().startswith(
            "waits: "
        )

    eventually(is_as_wanted, debian.story)
    runs(debian)
