"""The Debian package, built once for all its tests, and clean machines to install it on."""

import subprocess
import sys
import tarfile
from collections.abc import Mapping
from pathlib import Path

import pytest

from tests.support.machine import Machine
from tests.support.machine_disk import ROOT, clean_disk, newest_kernel
from tests.support.requirements import need_program

_NODE_PACKAGES = (
    "python3-rospy",
    "python3-rostopic",
    "python3-rosnode",
    "python3-std-msgs",
    "systemd-resolved",
)
SLOW_SECONDS = 1200.0  # of what is over in seconds on a machine of its own


@pytest.fixture(scope="session")
def package() -> Path:
    """dist/rosrv_VERSION_amd64.deb, built now by the one command."""
    for program, debian in (("dh", "debhelper"), ("dpkg-buildpackage", "dpkg-dev"), ("lintian", "lintian")):
        need_program(program, debian)
    done = subprocess.run(
        [sys.executable, "-m", "distribution.deb", "amd64"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return ROOT / done.stdout.split()[0]


def clean_machine(
    directory: Path,
    package: Path,
    files: Mapping[str, Path],
    *,
    more: tuple[str, ...] = (),
    name: str = "clean",
) -> Machine:
    """A machine that has what the package depends on, not started; `files`, by their names there, lie in its folder.

    `more` are further Debian packages that it has; such a machine has a `name` of its own.
    """
    depends = subprocess.run(
        ["dpkg-deb", "--field", str(package), "Depends"], capture_output=True, text=True, check=True
    ).stdout
    named = {entry.split("|")[0].split("(")[0].strip() for entry in depends.split(",")} - {"systemd"}

    def freight(path: Path) -> None:
        with tarfile.open(path, "w") as archive:
            for there, file in files.items():
                archive.add(file, there)

    disk = directory / "disk.ext4"
    image = clean_disk(newest_kernel(), (*sorted(named), *_NODE_PACKAGES, *more), name=name)
    subprocess.run(["cp", "--sparse=always", str(image), str(disk)], check=True)
    return Machine(directory, disk=disk, freight=freight)
