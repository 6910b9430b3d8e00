"""`make demo` in a clone on a fresh Debian: it installs what is missing, and shows the appliance at work."""

import os
import subprocess
from pathlib import Path

import pytest

from tests.support.debian_base import ROOT, make_base

pytestmark = pytest.mark.timeout(3600)  # ROS and the Python packages are fetched
_FRESH = ("ca-certificates", "git", "make")
_IN_TREE = """
set -eu
mount -t proc proc "$1/proc"
mount --rbind /dev "$1/dev"
mount --rbind /sys "$1/sys"
mount -t tmpfs tmpfs "$1/run"
printf 'exit 101\\n' > "$1/usr/sbin/policy-rc.d"
chmod 755 "$1/usr/sbin/policy-rc.d"
chroot "$1" sh -euc 'cd /opt/rosrv; make help; scripts/setup --run'
# The demonstration gets a network of its own, as on a machine of its own.
unshare --net --mount sh -euc "$2" sh "$1"
"""
_DEMO = """
mount -t sysfs sysfs "$1/sys"
ip link set lo up
chroot "$1" make -C /opt/rosrv demo
"""


@pytest.mark.parametrize("suite", ["bookworm", "trixie"])
def test_the_demonstration_runs_from_a_clone(suite: str, tmp_path: Path) -> None:
    root = make_base(tmp_path / "root", _FRESH, suite=suite)
    git = ["git", "-c", f"safe.directory={ROOT}", "-c", f"safe.directory={ROOT}/.git"]
    subprocess.run(
        [*git, "clone", "--quiet", "--no-hardlinks", str(ROOT), str(root / "opt/rosrv")], check=True
    )
    command = ["unshare", "--mount", "--propagation", "private", "sh", "-c", _IN_TREE, "sh", str(root), _DEMO]
    done = subprocess.run(
        command,
        env=os.environ | {"DEBIAN_FRONTEND": "noninteractive", "HOME": "/root", "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-6000:]
    assert "denied" in done.stdout
