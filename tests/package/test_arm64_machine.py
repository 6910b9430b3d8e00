"""The package on an emulated arm64 machine with Debian's own arm64 kernel: serve, selftest, nodes, a denial, a guard.

The tree is made with QEMU's user emulation, which takes most of the time. The machine has no network. It runs one
script at its boot, whose output is on its console, and switches itself off.
"""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from appliance.configuration.inventory import RUNS
from tests.support.debian_base import ROOT, machine_settings
from tests.support.requirements import need_program, need_root, needs

pytestmark = pytest.mark.timeout(5400)
SUITE = "bookworm"
_PACKAGES = (
    *RUNS,
    *("ca-certificates", "procps", "python3", "systemd-sysv", "udev", "kmod"),
    *("python3-rosnode", "python3-rospy", "python3-rostopic", "python3-std-msgs"),
    *("initramfs-tools", "linux-image-cloud-arm64"),
    # debootstrap follows no virtual packages
    *("libboost-regex1.74.0", "libicu72"),
)
_USER_EMULATION = Path("/usr/bin/qemu-aarch64-static")
_BINFMT = Path("/proc/sys/fs/binfmt_misc")
_MAGIC = (
    r":rosrv-aarch64:M::\x7fELF\x02\x01\x01\x00\x00\x00\x00\x00\x00\x00\x00\x00\x02\x00\xb7\x00:"
    r"\xff\xff\xff\xff\xff\xff\xff\x00\xff\xff\xff\xff\xff\xff\xff\xff\xfe\xff\xff\xff:"
)
_TREE_SECONDS, _MACHINE_SECONDS = 3600, 1500
_SCRIPT = """\
#!/bin/sh
exec > /dev/ttyAMA0 2>&1
export HOME=/root ROS_MASTER_URI=http://localhost:11311
say() { echo "RESULT $1: $2"; }
for second in $(seq 600); do [ "$(systemctl is-active rosrv)" = active ] && break; sleep 1; done
say service "$(systemctl is-active rosrv)"
rosrv selftest; say selftest "$?"
rostopic pub --rate=10 /chatter std_msgs/String "data: hello" &
say message "$(timeout 120 rostopic echo -n 1 /chatter | tr -d '\\n')"
ip netns add visitor
ip link add site type veth peer name site netns visitor
ip address add 192.168.1.5/24 dev site
ip link set site up
ip -n visitor address add 192.168.1.66/24 dev site
ip -n visitor link set site up
ip netns exec visitor env ROS_MASTER_URI=http://192.168.1.5:11311 ROS_IP=192.168.1.66 timeout 120 rosnode list
say visitor "$?"
say denial "$(rosrv audit search --deny | grep -c 192.168.1.66)"
say guard "$(rosrv monitor check /usr/share/rosrv/monitors/guards/speed.rv > /dev/null && echo valid)"
systemctl poweroff
"""
_UNIT = """\
[Unit]
After=rosrv.service
[Service]
ExecStart=/usr/local/bin/results
[Install]
WantedBy=multi-user.target
"""


@contextmanager
def user_emulation() -> Iterator[None]:
    """Let the kernel run arm64 programs, unless it does already."""
    needs(_USER_EMULATION.exists(), f"{_USER_EMULATION} (Debian: sudo apt install qemu-user-static)")
    mounted = (_BINFMT / "register").exists()
    if not mounted:
        subprocess.run(["mount", "-t", "binfmt_misc", "binfmt_misc", str(_BINFMT)], check=True)
    own = _BINFMT / "rosrv-aarch64"
    try:
        if not (_BINFMT / "qemu-aarch64").exists():
            (_BINFMT / "register").write_text(f"{_MAGIC}{_USER_EMULATION}:OCF")
        yield
    finally:
        if own.exists():
            own.write_text("-1")
        if not mounted:
            subprocess.run(["umount", str(_BINFMT)], check=True)


def made_tree(root: Path, package: Path) -> None:
    need_program("debootstrap", "debootstrap")
    settings = machine_settings(SUITE)
    names = ",".join(_PACKAGES)
    first = ["debootstrap", "--foreign", "--arch=arm64", "--variant=minbase", f"--include={names}"]
    run(*first, SUITE, str(root), settings.mirror)
    (root / "etc/dpkg/dpkg.cfg.d").mkdir(parents=True, exist_ok=True)
    (root / "etc/dpkg/dpkg.cfg.d/emulated").write_text("force-unsafe-io\n")
    run("chroot", str(root), "/debootstrap/debootstrap", "--second-stage")
    shutil.copyfile(package, root / "root/rosrv.deb")
    inside = 'mount -t proc proc "$1/proc"; chroot "$1" dpkg --install /root/rosrv.deb'
    run("unshare", "--mount", "--propagation", "private", "sh", "-euc", inside, "sh", str(root))
    script = root / "usr/local/bin/results"
    script.write_text(_SCRIPT)
    script.chmod(0o755)
    (root / "etc/systemd/system/results.service").write_text(_UNIT)
    wanted = root / "etc/systemd/system/multi-user.target.wants"
    (wanted / "results.service").symlink_to("/etc/systemd/system/results.service")
    # Its prompt would share the console with the results, and its start ends what others write there.
    (root / "etc/systemd/system/serial-getty@ttyAMA0.service").symlink_to("/dev/null")
    (root / "etc/machine-id").write_text("")


def run(*command: str) -> None:
    environment = os.environ | {"LC_ALL": "C", "DEBIAN_FRONTEND": "noninteractive"}
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=_TREE_SECONDS, check=False
    )
    assert done.returncode == 0, f"{' '.join(command[:4])}: {done.stdout[-2000:]}{done.stderr[-2000:]}"


def test_the_package_serves_on_an_emulated_arm64_machine(tmp_path: Path) -> None:
    need_root()
    program = need_program("qemu-system-aarch64", "qemu-system-arm")
    need_program("mke2fs", "e2fsprogs")
    need_program("aarch64-linux-gnu-gcc", "gcc-aarch64-linux-gnu")
    run(sys.executable, "-m", "distribution.deb", "arm64")
    package = max((ROOT / "dist").glob("rosrv_*_arm64.deb"), key=lambda path: path.stat().st_mtime)
    root, disk, console = tmp_path / "root", tmp_path / "disk.ext4", tmp_path / "console.log"
    with user_emulation():
        made_tree(root, package)
    kernel, initrd = (
        next((root / "boot").glob(f"{name}-*-cloud-arm64")) for name in ("vmlinuz", "initrd.img")
    )
    run("mke2fs", "-q", "-t", "ext4", "-d", str(root), str(disk), "3G")
    machine = [program, "-machine", "virt", "-cpu", "cortex-a72", "-accel", "tcg,thread=multi", "-smp", "2"]
    machine += ["-m", "2048", "-nic", "none", "-display", "none", "-no-reboot", "-nodefaults"]
    machine += ["-serial", f"file:{console}", "-kernel", str(kernel), "-initrd", str(initrd)]
    machine += ["-append", "root=/dev/vda rw console=ttyAMA0 panic=-1 quiet"]
    machine += ["-drive", f"file={disk},format=raw,if=none,id=root"]
    machine += ["-device", "virtio-blk-pci,drive=root,romfile="]
    subprocess.run(machine, timeout=_MACHINE_SECONDS, check=True)
    text = console.read_text(errors="replace")
    results = dict(re.findall(r"RESULT (\w+): (.*?)\r?$", text, re.MULTILINE))
    assert results.get("service") == "active", text[-4000:]
    assert results["selftest"] == "0", text[-4000:]
    assert "hello" in results["message"], text[-4000:]
    assert results["visitor"] != "0", "the default policy denies other machines"
    assert int(results["denial"]) > 0, text[-4000:]
    assert results["guard"] == "valid", text[-4000:]
