"""The package on a booted Debian 12 and 13: in each order of starts and ends, the robot is never open unnoticed."""

from pathlib import Path

import pytest

from tests.support.booted_debian import BootedDebian, booted_debian
from tests.support.waiting import eventually

pytestmark = pytest.mark.timeout(3600)  # the system is fetched and the package is built
WAITS = "waits: /usr/bin/rosmaster (roscore.service) holds TCP 11311"
ROSCORE = """\
[Unit]
Description=The robot's own master, as vendors start it
Before=rosrv.service

[Service]
ExecStart=/usr/bin/roscore
Environment=HOME=/root ROS_MASTER_URI=http://localhost:11311

[Install]
WantedBy=multi-user.target
"""
SLOWLY = "[Service]\nExecStartPre=/bin/sleep 8\n"


@pytest.mark.parametrize("suite", ["bookworm", "trixie"])
def test_a_robot_is_not_open_unnoticed_in_any_order(suite: str, package: Path, tmp_path: Path) -> None:
    with booted_debian(tmp_path, suite, package) as debian:
        (debian.root / "etc/systemd/system/roscore.service").write_text(ROSCORE)
        debian.boot()
        serves(debian)
        debian.run("systemctl", "enable", "roscore")
        debian.end()
        the_robot_first(debian)
        the_appliance_first(debian)
        restarts_and_faults(debian)
        installation_beside_a_master(debian)


def serves(debian: BootedDebian) -> None:
    eventually(lambda: debian.state() == "active", debian.story)
    assert debian.seen_by_visitor() == "open"


def the_robot_first(debian: BootedDebian) -> None:
    debian.boot()
    eventually(lambda: debian.said().startswith(WAITS), debian.story)
    assert debian.state() == "activating"
    assert WAITS in debian.shell("rosrv status; echo exit $?")
    assert debian.shell("rosrv status >/dev/null 2>&1; echo $?") == "1"
    assert WAITS in debian.run("journalctl", "--no-pager", "--boot", "--unit=rosrv")
    assert debian.seen_by_visitor() == "held"
    debian.run("systemctl", "disable", "--now", "roscore")
    serves(debian)
    debian.end()


def the_appliance_first(debian: BootedDebian) -> None:
    dropin = debian.root / "etc/systemd/system/rosrv.service.d/slowly.conf"
    dropin.parent.mkdir()
    dropin.write_text(SLOWLY)
    debian.boot()
    assert debian.seen_by_visitor() == "held"  # on a busy machine, before systemd has come to the service
    eventually(lambda: (debian.seen_by_visitor(), debian.state()) == ("held", "activating"), debian.story)
    serves(debian)
    debian.run("systemctl", "disable", "rosrv")
    debian.end()
    debian.boot()
    assert (debian.state(), debian.seen_by_visitor()) == ("inactive", "refused"), "it holds while it is off"
    dropin.unlink()
    debian.run("systemctl", "enable", "rosrv")
    debian.run("systemctl", "daemon-reload")
    debian.run("systemctl", "start", "rosrv")
    serves(debian)


def restarts_and_faults(debian: BootedDebian) -> None:
    debian.run("systemctl", "restart", "--no-block", "rosrv")
    seen = {debian.seen_by_visitor() for _ in range(10)}
    assert seen <= {"held", "refused", "open"}
    serves(debian)
    for _ in range(6):  # more than any limit of starts
        debian.run("systemctl", "kill", "--kill-whom=main", "--signal=KILL", "rosrv")
        there = debian.seen_by_visitor()  # on a busy machine, perhaps after the restart
        assert there in ("refused", "held") or debian.master_of_visitor() == "RVMaster", (
            "a crash opened the port"
        )
        serves(debian)
    debian.shell("echo 'nonsense: 1' >> /etc/rosrv/appliance.yaml")
    debian.run("systemctl", "restart", "rosrv")
    assert debian.seen_by_visitor() == "held"
    debian.shell("sed -i '/^nonsense/d' /etc/rosrv/appliance.yaml")
    serves(debian)  # without a hand: no number of failed starts ends it
    debian.run("systemctl", "stop", "rosrv")
    eventually(lambda: debian.seen_by_visitor() == "refused", debian.story)


def installation_beside_a_master(debian: BootedDebian) -> None:
    debian.run("systemctl", "start", "roscore")
    eventually(
        lambda: "/rosout" in debian.shell("ROS_MASTER_URI=http://localhost:11311 rosnode list"), debian.story
    )
    assert WAITS in debian.run("dpkg", "--install", "/root/rosrv.deb")
    assert debian.state() == "activating"
    debian.run("dpkg", "--remove", "rosrv")
    assert debian.seen_by_visitor() == "open", (
        "the robot's own master is as reachable as before the installation"
    )
    assert "rosrv" not in debian.run("nft", "list", "tables")
    debian.run("dpkg", "--purge", "rosrv")
    assert "No such file" in debian.run("ls", "--directory", "/var/lib/rosrv", "/var/lib/rosrv-hold")
