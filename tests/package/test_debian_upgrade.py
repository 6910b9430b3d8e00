"""Debian 12 becomes Debian 13 by `apt full-upgrade` under an adopted robot that runs: state, units and interpreter."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.support.booted_debian import BootedDebian, booted_debian
from tests.support.debian_base import machine_settings
from tests.support.vendors_robot import adopt, adopted, fetch_like
from tests.support.waiting import eventually

pytestmark = pytest.mark.timeout(5400)  # two systems are fetched and the package is built
_DOWNLOAD = """
set -eu
mount -t proc proc "$1/proc"
mount --rbind /dev "$1/dev"
chroot "$1" apt-get update -q
chroot "$1" apt-get full-upgrade -y -q --download-only
"""
_UPGRADE = (
    "apt-get full-upgrade -y -q --no-download"
    " -o Dpkg::Options::=--force-confdef -o Dpkg::Options::=--force-confold"
)
_SPECIFICATION = "said() { event said() /speed std_msgs/Float64 '{}' { } }\n"
_UPGRADE_SECONDS = 1800.0


def test_the_package_and_the_robot_outlive_the_upgrade(package: Path, tmp_path: Path) -> None:
    with booted_debian(tmp_path, "bookworm", package) as debian:
        for name, text in machine_settings("trixie").files.items():
            (debian.root / name).write_text(text)
        resolver = debian.root / "etc/resolv.conf"
        shutil.copyfile("/etc/resolv.conf", resolver)
        download = [
            "unshare",
            "--mount",
            "--propagation",
            "private",
            "sh",
            "-c",
            _DOWNLOAD,
            "sh",
            str(debian.root),
        ]
        subprocess.run(
            download, env=os.environ | {"DEBIAN_FRONTEND": "noninteractive"}, check=True, capture_output=True
        )
        (debian.root / "root/said.rv").write_text(_SPECIFICATION)
        debian.boot()
        eventually(lambda: debian.state() == "active", debian.story)
        adopt(debian, fetch_like())
        debian.shell("rosrv token add alice")
        debian.shell("rosrv monitor load /root/said.rv && rosrv monitor enable said")
        before = state_of(debian)
        assert "alice" in before["tokens"]
        assert "said" in before["monitors"]
        lives = debian.run("systemctl", "show", "--property=MainPID", "roscore", "robot")
        debian.begin(
            f"DEBIAN_FRONTEND=noninteractive {_UPGRADE} > /root/upgrade.log 2>&1; echo $? > /root/upgraded"
        )
        done = debian.root / "root/upgraded"
        eventually(done.exists, lambda: upgrade_log(debian), _UPGRADE_SECONDS)
        assert done.read_text() == "0\n", upgrade_log(debian)
        assert debian.shell("python3 --version").startswith("Python 3.13")
        adopted(debian)
        assert debian.run("systemctl", "show", "--property=MainPID", "roscore", "robot") == lives
        assert debian.shell("ls /usr/lib/rosrv/common/appliance/cli/__pycache__/main.cpython-313.pyc")
        debian.end()
        debian.boot()
        adopted(debian)
        assert [debian.state(unit) for unit in ("rosrv", "roscore", "robot")] == ["active"] * 3
        assert state_of(debian) == before
        assert "The log is complete" in debian.shell("rosrv audit verify"), debian.shell("rosrv audit verify")
        assert "Python 3.13" in debian.shell("rosrv version"), debian.shell("rosrv version")
        debian.run("dpkg", "--install", "/root/rosrv.deb")  # the same version again, as a repair
        adopted(debian)
        debian.run("dpkg", "--remove", "rosrv")
        assert "rosrv" not in debian.run("nft", "list", "tables")
        assert not list((debian.root / "usr/lib/rosrv").glob("**/*.pyc"))


def state_of(debian: BootedDebian) -> dict[str, str]:
    return {
        "tokens": debian.shell("rosrv token list --json | sed 's/\"last_used[^,}]*//'"),
        "monitors": debian.shell(
            "rosrv monitor list --json | sed 's/\"\\(events\\|delay[a-z_]*\\|seconds\\)\"[^,}]*//g'"
        ),
        "policy": debian.shell("rosrv policy show"),
        "revision": debian.shell("rosrv policy revisions --json"),
    }


def upgrade_log(debian: BootedDebian) -> str:
    return debian.shell("tail -n 40 /root/upgrade.log")
