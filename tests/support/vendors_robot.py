"""Robots as vendors make them, in a `BootedDebian`: their units, and what shows that they run."""

import contextlib
import json
import threading
from collections.abc import Iterator
from pathlib import Path

from tests.support.booted_debian import BootedDebian
from tests.support.waiting import eventually

MASTER = "http://localhost:11311"
_ENVIRONMENT = (
    f"Environment=HOME=/root ROS_MASTER_URI={MASTER} ROS_PACKAGE_PATH=/opt/vendor PYTHONUNBUFFERED=1"
)
_DRIVE = "/usr/bin/rostopic pub --rate 20 /speed std_msgs/Float64 0.5 __name:=drive"
_HEAR = "/bin/sh -c 'rostopic echo /speed __name:=hear > /run/heard'"
_INSTALL = "[Install]\nWantedBy=multi-user.target\n"
_LAUNCH = """\
<launch>
  <param name="vendor" value="yes"/>
  <node pkg="vendor" type="drive" name="drive"/>
  <node pkg="vendor" type="hear" name="hear"/>
</launch>
"""
_PACKAGE = """\
<package format="2">
  <name>vendor</name><version>1.0.0</version><description>Nodes</description>
  <maintainer email="vendor@example.org">Vendor</maintainer><license>Apache-2.0</license>
</package>
"""
_PROGRAMS = {
    "drive": '#!/bin/sh\nexec /usr/bin/rostopic pub --rate 20 /speed std_msgs/Float64 0.5 "$@"\n',
    "hear": '#!/bin/sh\nexec /usr/bin/rostopic echo /speed "$@" > /run/heard\n',
}


def fetch_like() -> dict[str, str]:
    """Return the units of a robot with `roscore.service`, and `robot.service` that requires it."""
    return {
        "roscore": f"[Service]\nExecStart=/usr/bin/roscore\n{_ENVIRONMENT}\n{_INSTALL}",
        "robot": "[Unit]\nRequires=roscore.service\nPartOf=roscore.service\nAfter=roscore.service\n[Service]\n"
        "ExecStartPre=/bin/sh -c 'until rostopic list; do sleep 1; done'\n"
        f"ExecStart=/bin/sh -c '{_DRIVE} & exec \"$@\"' sh {_HEAR}\n{_ENVIRONMENT}\n{_INSTALL}",
    }


def roslaunch_alone() -> dict[str, str]:
    """Return the unit of a robot whose one `roslaunch` starts a master if there is none."""
    launch = "ExecStart=/usr/bin/roslaunch /opt/vendor/robot.launch"
    return {"robot": f"[Service]\n{launch}\n{_ENVIRONMENT} ROS_HOSTNAME=robot\n{_INSTALL}"}


def write_robot(debian: BootedDebian, units: dict[str, str]) -> None:
    for name, text in units.items():
        (debian.root / f"etc/systemd/system/{name}.service").write_text(text)
    package = debian.root / "opt/vendor"
    package.mkdir(exist_ok=True)
    files = {"package.xml": _PACKAGE, "robot.launch": _LAUNCH}
    for name, text in (files | _PROGRAMS).items():
        (package / name).write_text(text)
        (package / name).chmod(0o755)


def nodes(debian: BootedDebian) -> set[str]:
    return set(debian.shell(f"ROS_MASTER_URI={MASTER} rosnode list").split())


def hears(debian: BootedDebian) -> None:
    before = debian.shell("wc -c < /run/heard")
    eventually(lambda: debian.shell("wc -c < /run/heard") != before, debian.story)


def runs(debian: BootedDebian) -> None:
    eventually(lambda: {"/drive", "/hear"} <= nodes(debian), debian.story)
    hears(debian)


def is_adopted(debian: BootedDebian) -> bool:
    said = debian.shell("rosrv adopt --status --json")
    return said.startswith("{") and json.loads(said)["phase"] == "taken"


def adopted(debian: BootedDebian) -> None:
    eventually(lambda: is_adopted(debian), debian.story)
    eventually(lambda: debian.master_of_visitor() == "RVMaster", debian.story)
    runs(debian)


def adopt(debian: BootedDebian, units: dict[str, str]) -> None:
    """Install a robot, start it before the appliance, and adopt it; deny nothing."""
    write_robot(debian, units)
    debian.run("systemctl", "daemon-reload")
    debian.run("systemctl", "stop", "rosrv")
    debian.run("systemctl", "enable", "--now", *units)
    runs(debian)
    debian.run("systemctl", "start", "--no-block", "rosrv")
    eventually(lambda: debian.said().startswith("waits: "), debian.story)
    said = debian.shell("rosrv adopt --audit-only")
    assert "adopted" in said, f"{said}\n{debian.story()}"
    adopted(debian)


@contextlib.contextmanager
def closed(debian: BootedDebian) -> Iterator[None]:
    """No other machine may reach the robot's own master in this block."""
    found, end = set[str](), threading.Event()

    def visit() -> None:
        while not end.is_set():
            found.add(debian.master_of_visitor())
            end.wait(0.1)

    visits = threading.Thread(target=visit)
    visits.start()
    try:
        yield
    finally:
        end.set()
        visits.join()
    assert found <= {"", "RVMaster"}, f"{found}\n{debian.story()}"


def record_of(debian: BootedDebian) -> Path:
    return debian.root / "var/lib/rosrv/adopt.json"
