"""A robot that boots by systemd is adopted, restarted, booted again, and given back with the package's removal."""

import json
from pathlib import Path

import pytest

from tests.support.booted_debian import BootedDebian, booted_debian
from tests.support.waiting import eventually

pytestmark = pytest.mark.timeout(3600)  # the system is fetched and the package is built
ENVIRONMENT = "Environment=HOME=/root ROS_MASTER_URI=http://localhost:11311 PYTHONUNBUFFERED=1"
ROSCORE = f"[Service]\nExecStart=/usr/bin/roscore\n{ENVIRONMENT}\n[Install]\nWantedBy=multi-user.target\n"
DRIVE = "/usr/bin/rostopic pub --rate 20 /speed std_msgs/Float64 0.5 __name:=drive"
HEAR = "/bin/sh -c 'rostopic echo /speed __name:=hear > /run/heard'"
ROBOT = (
    "[Unit]\nRequires=roscore.service\nPartOf=roscore.service\nAfter=roscore.service\n[Service]\n"
    f"ExecStartPre=/bin/sh -c 'until rostopic list; do sleep 1; done'\nExecStart=/bin/sh -c '{DRIVE} & exec \"$@\"' sh"
    f" {HEAR}\n{ENVIRONMENT}\n[Install]\nWantedBy=multi-user.target\n"
)


def nodes(debian: BootedDebian) -> set[str]:
    return set(debian.shell("ROS_MASTER_URI=http://localhost:11311 rosnode list").split())


def hears(debian: BootedDebian) -> None:
    before = debian.shell("wc -c < /run/heard")
    eventually(lambda: debian.shell("wc -c < /run/heard") != before, debian.story)


def runs(debian: BootedDebian) -> None:
    eventually(lambda: {"/drive", "/hear"} <= nodes(debian), debian.story)
    hears(debian)


def adopted(debian: BootedDebian) -> None:
    def phase() -> bool:
        said = debian.shell("rosrv adopt --status --json")
        return said.startswith("{") and json.loads(said)["phase"] == "taken"

    eventually(phase, debian.story)
    runs(debian)


@pytest.mark.parametrize("suite", ["bookworm", "trixie"])
def test_a_vendors_robot_is_adopted_and_given_back(suite: str, package: Path, tmp_path: Path) -> None:
    with booted_debian(tmp_path, suite, package) as debian:
        units = debian.root / "etc/systemd/system"
        (units / "roscore.service").write_text(ROSCORE)
        (units / "robot.service").write_text(ROBOT)
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
        debian.end()
        debian.boot()
        adopted(debian)
        debian.run("systemctl", "restart", "rosrv")
        adopted(debian)
        debian.run("dpkg", "--remove", "rosrv")
        runs(debian)
        assert not list(units.glob("*/50-rosrv-adopt.conf"))
        assert "rosrv" not in debian.run("nft", "list", "tables")


def the_own_master_restarts(debian: BootedDebian) -> None:
    debian.run("systemctl", "restart", "roscore")
    adopted(debian)
    assert debian.run("systemctl", "show", "--property=NRestarts", "--value", "roscore", "robot").split() == [
        "0",
        "0",
    ]
    assert debian.state("roscore") == debian.state("robot") == "active"
