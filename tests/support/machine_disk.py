"""Make the disk of the virtual machine: Debian, its cloud kernel's modules, the project's environment, and the agent.

An image is named by a hash of its inputs and never changes: a machine works on a snapshot. The checkout is on a
second disk, which is made for each start.
"""

import hashlib
import os
import shutil
import subprocess
import tarfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from tests.support.debian_base import base_archive
from tests.support.requirements import need_program, needs

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "build" / "machine"
AGENT = Path(__file__).with_name("machine_agent.py")
KERNEL = "linux-image-cloud-amd64"
GIGABYTES = 4  # the file is sparse
# Packages that a booted machine needs besides those in packages.txt. It has no network, so it needs curl as well, which
# a kit would install.
_MACHINES_OWN = ("systemd-sysv", "udev", "kmod", "procps", "openssl", "tcpdump", "curl", "iputils-ping")
_COMPILERS = ("gcc", "g++", "pkg-config")  # and every -dev package: nodes in the machine use rospy
# parts of the environment that are large and only for other tests
_NOT_IN_THE_MACHINE = ("playwright", "mypy", "numpy", "numpy.libs", "networkx", "jsonschema_rs")
_UNIT = """\
[Unit]
Description=Runs what the test asks for
After=dev-virtio\\x2dports-rosrv.agent.device
Wants=dev-virtio\\x2dports-rosrv.agent.device

[Service]
ExecStart=/usr/bin/python3 /usr/local/lib/rosrv-agent.py
StandardOutput=journal+console
KillMode=control-group
LimitNOFILE=65536

[Install]
WantedBy=multi-user.target
"""
# Not started at boot: the tests start the services that they need.
_QUIET = (
    "strongswan.service", "nftables.service", "e2scrub_reap.service", "apt-daily.timer", "apt-daily-upgrade.timer",
    "dpkg-db-backup.timer", "e2scrub_all.timer", "fstrim.timer",
)  # fmt: skip


@dataclass(frozen=True)
class Kernel:
    release: str
    image: Path
    initrd: Path

    @property
    def modules(self) -> Path:
        return Path("/lib/modules") / self.release


def newest_kernel() -> Kernel:
    kernels = [
        Kernel(release, image, initrd)
        for image in sorted(
            Path("/boot").glob("vmlinuz-*-cloud-amd64"), key=lambda path: path.stat().st_mtime
        )
        if (release := image.name.removeprefix("vmlinuz-"))
        and (initrd := image.with_name(f"initrd.img-{release}")).exists()
        and Path("/lib/modules", release).is_dir()
    ]
    needs(kernels, f"a kernel for the virtual machine (Debian: sudo apt install {KERNEL})")
    return kernels[-1]


def machine_disk(kernel: Kernel) -> Path:
    return _disk("disk", kernel, _packages(), environment=True)


def clean_disk(kernel: Kernel, packages: tuple[str, ...], *, name: str = "clean") -> Path:
    return _disk(name, kernel, (*packages, *_MACHINES_OWN), environment=False)


def _disk(name: str, kernel: Kernel, packages: tuple[str, ...], *, environment: bool) -> Path:
    need_program("mke2fs", "e2fsprogs")
    base = base_archive(packages)
    FOLDER.mkdir(parents=True, exist_ok=True)
    disk = FOLDER / f"{name}-{_key(base, kernel)}.ext4"
    if disk.exists():
        return disk
    tree = FOLDER / f"tree.{os.getpid()}"
    making = disk.with_suffix(f".{os.getpid()}")
    try:
        tree.mkdir()
        _run("tar", "--extract", "--numeric-owner", "--file", str(base), "--directory", str(tree))
        _furnish(tree, kernel)
        if environment:
            _add_environment(tree)
        making.unlink(missing_ok=True)
        _run("mke2fs", "-q", "-t", "ext4", "-d", str(tree), str(making), f"{GIGABYTES}G")
        for older in FOLDER.glob(f"{name}-*.ext4"):
            older.unlink()
        making.rename(disk)
    finally:
        shutil.rmtree(tree, ignore_errors=True)
        making.unlink(missing_ok=True)
    return disk


def checkout_archive(path: Path) -> None:
    for folder in ("appliance", "tests"):
        _compile(ROOT / folder, as_if_in=ROOT / folder)
    listed = subprocess.run(
        # Root may run the tests of another user's checkout.
        [
            "git",
            "-c",
            f"safe.directory={ROOT}",
            "ls-files",
            "-z",
            "--cached",
            "--others",
            "--exclude-standard",
        ],
        cwd=ROOT,
        capture_output=True,
        check=True,
    )
    names = {os.fsdecode(name) for name in listed.stdout.split(b"\0") if name}
    compiled = [*(ROOT / "appliance").rglob("*.so")]
    compiled += [code for one in ("appliance", "tests") for code in (ROOT / one).rglob("*.pyc")]
    names |= {str(code.relative_to(ROOT)) for code in compiled}
    with tarfile.open(path, "w") as tar:
        for name in sorted(names):
            if (ROOT / name).is_file():
                tar.add(ROOT / name, arcname=name, recursive=False)


def _packages() -> tuple[str, ...]:
    lists = ("packages.txt", "packages-develop.txt")
    lines = [line for name in lists for line in (ROOT / name).read_text().splitlines()]
    named = [line.partition("#")[0].strip() for line in lines]
    kept = [name for name in named if name and name not in _COMPILERS and not name.endswith("-dev")]
    return (*kept, *_MACHINES_OWN)


def _furnish(tree: Path, kernel: Kernel) -> None:
    shutil.copytree(kernel.modules, tree / "lib" / "modules" / kernel.release, symlinks=True)
    agent = tree / "usr/local/lib/rosrv-agent.py"
    agent.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(AGENT, agent)
    units = tree / "etc/systemd/system"
    (units / "rosrv-agent.service").write_text(_UNIT)
    wanted = units / "multi-user.target.wants"
    wanted.mkdir(exist_ok=True)
    (wanted / "rosrv-agent.service").symlink_to("/etc/systemd/system/rosrv-agent.service")
    for name in _QUIET:
        for place in units.glob(f"*.wants/{name}"):
            place.unlink()
    (tree / "etc/machine-id").write_text("")  # a new one at each start
    # systemd empties /tmp at its start, and the checkout may be there
    kept = tree / "etc/tmpfiles.d"
    kept.mkdir(exist_ok=True)
    (kept / "tmp.conf").symlink_to("/dev/null")
    (tree / "etc/hostname").write_text("rosrv-machine\n")
    resolver = tree / "etc/resolv.conf"
    resolver.unlink(missing_ok=True)  # some packages make it a link
    resolver.write_text("")


def _add_environment(tree: Path) -> None:
    environment = tree / str(ROOT / ".venv").lstrip("/")
    shutil.copytree(ROOT / ".venv", environment, symlinks=True, ignore=_too_large)
    _compile(environment, as_if_in=ROOT / ".venv")


def _too_large(_folder: str, names: list[str]) -> Iterable[str]:
    return [name for name in names if name in _NOT_IN_THE_MACHINE]


def _compile(folder: Path, *, as_if_in: Path) -> None:
    """Compile Python files here: the machine would need ten times as long, in every process."""
    command = [str(ROOT / ".venv/bin/python"), "-m", "compileall", "-q", "-j", "2"]
    done = subprocess.run(
        [*command, "-s", str(folder), "-p", str(as_if_in), str(folder)], capture_output=True, check=False
    )
    # Some packages contain templates and examples that do not compile; nothing imports them.
    assert done.returncode in (0, 1), done.stderr


def _key(base: Path, kernel: Kernel) -> str:
    parts = [base.name, kernel.release, str(ROOT), AGENT.read_text(), Path(__file__).read_text()]
    parts.append((ROOT / "requirements-dev.lock").read_text())
    parts.append((ROOT / "pyproject.toml").read_text())
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]


def _run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, errors="backslashreplace", check=False)
    assert done.returncode == 0, f"{' '.join(command)}: {done.stderr[-2000:]}"
