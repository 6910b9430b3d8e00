"""Boot a Debian with the package in it by systemd-nspawn: units, start orders, upgrades, in seconds instead of minutes.

The kernel is this machine's; the network is the container's own, with a visitor beside it in a namespace.
"""

import contextlib
import os
import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

from appliance.configuration.inventory import RUNS
from tests.support.debian_base import make_base
from tests.support.requirements import need_program, need_root
from tests.support.waiting import eventually

ROBOT, VISITOR = "192.168.1.5", "192.168.1.66"
_PACKAGES = (
    *RUNS,
    *("ca-certificates", "procps", "python3", "systemd-sysv"),
    *("python3-roslaunch", "python3-rosnode", "python3-rospy", "python3-rostopic", "python3-std-msgs"),
)
_BOOT_SECONDS, _END_SECONDS = 300.0, 180.0
_COMMAND_SECONDS = 600.0
_INSTALL = """
set -eu
mount -t proc proc "$1/proc"
mount --rbind /dev "$1/dev"
chroot "$1" dpkg --install /root/rosrv.deb
"""
_VISITOR = f"""
set -eu
ip netns add visitor
ip link add site type veth peer name site netns visitor
ip address add {ROBOT}/24 dev site
ip link set site up
ip -n visitor address add {VISITOR}/24 dev site
ip -n visitor link set site up
ip -n visitor link set lo up
"""
_REACHES = f"""
import socket
client = socket.socket()
client.settimeout(1)
try:
    client.connect(("{ROBOT}", 11311))
    print("open")
except ConnectionRefusedError:
    print("refused")
except TimeoutError:
    print("held")
"""
_MASTER = f"""
import http.client, xmlrpc.client
link = http.client.HTTPConnection("{ROBOT}", 11311, timeout=1)
try:
    link.request("POST", "/RPC2", xmlrpc.client.dumps(("/visitor",), "getPid"), {{"Content-Type": "text/xml"}})
    server = link.getresponse().headers.get("Server", "")
    print("rosmaster" if "BaseHTTP" in server else "RVMaster")
except (OSError, http.client.HTTPException):
    print("")
"""


class BootedDebian:
    """A Debian that boots and ends as often as a test wants; its files are those of `root`."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._nspawn: subprocess.Popen[bytes] | None = None

    def boot(self) -> None:
        command = ["systemd-nspawn", "--directory", str(self.root), "--boot", "--private-network"]
        command += ["--register=no", "--keep-unit", "--link-journal=no", "--capability=all", "--console=pipe"]
        command += ["--system-call-filter=add_key keyctl bpf"]
        with (self.root.parent / "console.log").open("ab") as console:
            self._nspawn = subprocess.Popen(
                command,
                env={"PATH": "/usr/sbin:/usr/bin", "SYSTEMD_NSPAWN_UNIFIED_HIERARCHY": "1"},
                stdin=subprocess.DEVNULL,
                stdout=console,
                stderr=console,
            )
        eventually(lambda: self.run("systemctl", "is-system-running") in _BOOTED, self.story, _BOOT_SECONDS)
        self.run("sh", "-c", _VISITOR)

    def end(self) -> None:
        if self._nspawn is None:
            return
        self._nspawn.send_signal(signal.SIGTERM)  # systemd-nspawn powers the container off
        try:
            self._nspawn.wait(timeout=_END_SECONDS)
        except subprocess.TimeoutExpired:
            self.cut_power()  # else its processes run on, beside those of the next boot
        self._nspawn = None

    def cut_power(self) -> None:
        """End all processes at once."""
        leader = self._leader()
        assert self._nspawn is not None
        if leader is not None:
            os.kill(leader, signal.SIGKILL)
        self._nspawn.wait(timeout=60)
        self._nspawn = None

    def begin(self, line: str) -> None:
        """Start a command of a shell, and do not wait for its end."""
        self.run("systemd-run", "--quiet", "--collect", "sh", "-c", line)

    def run(self, *command: str) -> str:
        """Return the output of a command, both streams, whatever its status; "" before the first process runs."""
        leader = self._leader()
        if leader is None:
            return ""
        done = subprocess.run(
            ["nsenter", "--target", str(leader), "--all", *command],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=_COMMAND_SECONDS,
            check=False,
        )
        return done.stdout.strip()

    def shell(self, line: str) -> str:
        return self.run("sh", "-c", line)

    def state(self, unit: str = "rosrv") -> str:
        return self.run("systemctl", "is-active", unit)

    def said(self) -> str:
        return self.run("systemctl", "show", "--property=StatusText", "--value", "rosrv")

    def seen_by_visitor(self) -> str:
        """Return how another machine finds port 11311: `open`, `refused` or `held`."""
        return self.run("ip", "netns", "exec", "visitor", "python3", "-c", _REACHES)

    def master_of_visitor(self) -> str:
        """Return which program answers another machine as ROS master: `RVMaster`, `rosmaster`, or "" for none."""
        return self.run("ip", "netns", "exec", "visitor", "python3", "-c", _MASTER)

    def story(self) -> str:
        console = self.root.parent / "console.log"
        tail = "\n".join(console.read_text(errors="replace").splitlines()[-20:]) if console.exists() else ""
        return f"{tail}\n{self.run('journalctl', '--no-pager', '--lines=40', '--unit=rosrv')}"

    def _leader(self) -> int | None:
        if self._nspawn is None:
            return None
        children = Path(f"/proc/{self._nspawn.pid}/task/{self._nspawn.pid}/children")
        with contextlib.suppress(OSError):
            for child in children.read_text().split():
                return int(child)
        return None


_BOOTED = ("running", "degraded", "starting")


@contextlib.contextmanager
def booted_debian(
    folder: Path, suite: str, package: Path, *, installed: bool = True
) -> Iterator[BootedDebian]:
    """Yield a Debian with the package installed, or only in /root, which has not booted."""
    need_root()
    need_program("systemd-nspawn", "systemd-container")
    root = make_base(folder / "root", _PACKAGES, suite=suite)
    shutil.copyfile(package, root / "root" / ("rosrv.deb" if installed else package.name))
    (root / "etc/hostname").write_text("robot\n")
    (root / "etc/hosts").write_text("127.0.0.1 localhost\n127.0.1.1 robot\n")
    subprocess.run(["systemd-machine-id-setup", f"--root={root}"], check=True, capture_output=True)
    if installed:
        install = ["unshare", "--mount", "--propagation", "private", "sh", "-c", _INSTALL, "sh", str(root)]
        subprocess.run(
            install, env={"PATH": "/usr/sbin:/usr/bin", "DEBIAN_FRONTEND": "noninteractive"}, check=True
        )
    debian = BootedDebian(root)
    try:
        yield debian
    finally:
        debian.end()
