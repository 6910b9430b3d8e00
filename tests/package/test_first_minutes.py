"""From `apt install` to a robot that runs behind its policy: the page's own commands, their number and their time.

The Debian packages that the package needs are installed before: their download is not measured.
"""

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.booted_debian import ROBOT, VISITOR, BootedDebian, booted_debian
from tests.support.page_steps import Step, steps
from tests.support.waiting import allowed, eventually

pytestmark = pytest.mark.timeout(3600)  # the system is fetched and the package is built
_SUDO = '#!/bin/sh\nexec "$@"\n'
_NODES = "ROS_MASTER_URI=http://localhost:11311 rosnode list"
_TO_ADOPTED = ("sudo apt install ./rosrv_*.deb", "sudo rosrv adopt --check", "sudo rosrv adopt --audit-only")
_FOURTH = "sudo rosrv policy enforce"
_SECONDS = 120.0


@pytest.mark.parametrize("suite", ["bookworm", "trixie"])
def test_a_working_robot_is_adopted_within_two_minutes_and_three_commands(
    suite: str, package: Path, tmp_path: Path, record_testsuite_property: Callable[[str, object], None]
) -> None:
    with booted_debian(tmp_path, suite, package, installed=False) as debian:
        sudo = debian.root / "usr/local/bin/sudo"
        sudo.write_text(_SUDO)
        sudo.chmod(0o755)
        debian.boot()
        robot, *others = steps("try-for-an-hour.md")
        assert robot.how == "stays"
        debian.run("systemd-run", "--unit=drive", "--working-directory=/root", "bash", "-c", robot.script)
        eventually(lambda: "/drive" in debian.shell(_NODES), debian.story)
        lives = debian.run("systemctl", "show", "--property=MainPID", "drive")
        commands, seconds = list[str](), 0.0
        for step in others:
            began = time.monotonic()
            play(debian, step)
            if _TO_ADOPTED[-1] not in commands:
                seconds += time.monotonic() - began
            commands += [line for line in step.script.splitlines() if line.startswith("sudo ")]
        assert tuple(commands[:3]) == _TO_ADOPTED
        assert _FOURTH in commands
        record_testsuite_property(f"seconds to an adopted robot on {suite}", round(seconds, 1))
        assert seconds < allowed(_SECONDS)
        assert debian.run("systemctl", "show", "--property=MainPID", "drive") == lives


def play(debian: BootedDebian, step: Step) -> None:
    where = ["ip", "netns", "exec", "visitor"] if step.host == "visitor" else []
    output = debian.run(*where, "bash", "-c", f"cd /root; set -e\n{here(step.script)}echo done")
    assert output.endswith("done") == (step.how != "fails"), output
    missing = [line for line in step.shown if here(line) not in output]
    assert missing == [], f"{step.script}{output}"


def here(text: str) -> str:
    return text.replace("10.84.0.66", VISITOR).replace("10.84.0.2", ROBOT)
