"""An early warning: the appliance with the interpreter and ROS of Debian testing. It may fail; the output says why."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.support.debian_base import ROOT, make_base

pytestmark = [
    pytest.mark.timeout(3600),  # the system and the wheels are fetched
    pytest.mark.xfail(strict=False, reason="Debian testing changes before the project does"),
]
_PACKAGES = ("ca-certificates", "libseccomp2", "python3", "python3-venv", "rosout")
_ROS = ("python3-rosmaster", "python3-rostopic", "python3-std-msgs")
_COPIED = ("appliance", "roswire", "rosmop", "monitors", "policies")
_LEFT_OUT = ("python-iptables", "backports-zstd")  # without a wheel; part of Python 3.14
_IN_TREE = """
set -eu
mount -t proc proc "$1/proc"
mount --rbind /dev "$1/dev"
chroot "$1" sh -euc "$2"
"""
_TALK = """
cd /opt/rosrv
python3 -m venv environment
environment/bin/pip install --quiet --only-binary :all: --no-deps --requirement wheels.txt
environment/bin/python -c 'from appliance.cli.main import main; main()' up --isolation none --api off \
    --policy policies/default.ini --state /var/lib/rosrv --listen 127.0.0.1:11311 > up.log 2>&1 &
trap "kill $!" EXIT
for second in $(seq 120); do grep -q "Nodes may connect" up.log && break; sleep 1; done
export ROS_MASTER_URI=http://127.0.0.1:11311
timeout 90 rostopic pub --rate=10 /chatter std_msgs/String "data: hello" > pub.log 2>&1 &
timeout 60 rostopic echo -n 1 /chatter || cat up.log pub.log
"""


def test_nodes_talk_through_the_appliance_on_debian_testing(tmp_path: Path) -> None:
    root = make_base(tmp_path / "root", (*_PACKAGES, *_ROS), suite="testing")
    target = root / "opt/rosrv"
    for part in _COPIED:
        shutil.copytree(ROOT / part, target / part, ignore=shutil.ignore_patterns("__pycache__", "tests"))
    pins = re.findall(r"^([a-z0-9-]+)==(\S+)", (ROOT / "requirements.lock").read_text(), re.MULTILINE)
    wheels = [f"{name}=={version}" for name, version in pins if name not in _LEFT_OUT]
    (target / "wheels.txt").write_text("\n".join(wheels) + "\n")
    command = [
        "unshare",
        "--mount",
        "--pid",
        "--fork",
        "--propagation",
        "private",
        "sh",
        "-euc",
        _IN_TREE,
        "sh",
    ]
    done = subprocess.run(
        [*command, str(root), _TALK],
        env={"PATH": "/usr/sbin:/usr/bin:/sbin:/bin"},
        capture_output=True,
        text=True,
        timeout=1800,
        check=False,
    )
    assert 'data: "hello"' in done.stdout, f"{done.stdout}\n{done.stderr}"
