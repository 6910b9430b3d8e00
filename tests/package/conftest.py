import os
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
LATER = "+40h"
SLOW_SECONDS = 1200.0  # for work that takes seconds on a machine of its own
PACKAGER = {"DEBFULLNAME": "A packager", "DEBEMAIL": "packager@example.org"}


@pytest.fixture(scope="session")
def package() -> Path:
    for program, debian in (("dh", "debhelper"), ("dpkg-buildpackage", "dpkg-dev"), ("lintian", "lintian")):
        need_program(program, debian)
    done = subprocess.run(
        [sys.executable, "-m", "distribution.deb", "amd64"],
        cwd=ROOT,
        env=os.environ | PACKAGER,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return ROOT / done.stdout.split()[0]


def elsewhere(folder: Path) -> Path:
    git = ["git", "-c", f"safe.directory={ROOT}", "-c", f"safe.directory={ROOT}/.git"]
    subprocess.run(
        [*git, "clone", "--quiet", "--no-hardlinks", str(ROOT), str(folder)], umask=0o077, check=True
    )
    changes = subprocess.run(
        [*git, "diff", "--binary", "HEAD"], cwd=ROOT, capture_output=True, check=True
    ).stdout
    if changes:
        subprocess.run([*git, "apply"], cwd=folder, input=changes, umask=0o077, check=True)
    return folder


def build_later(module: str, *options: str, folder: Path, **environment: str) -> Path:
    command = [need_program("faketime", "faketime"), "-f", LATER, sys.executable, "-m", module, *options]
    done = subprocess.run(
        command,
        cwd=folder,
        env=os.environ | PACKAGER | environment,
        capture_output=True,
        text=True,
        umask=0o077,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return folder / done.stdout.split()[0]


def clean_machine(
    directory: Path,
    package: Path,
    files: Mapping[str, Path],
    *,
    more: tuple[str, ...] = (),
    name: str = "clean",
) -> Machine:
    """Return a machine that is not started, whose folder contains `files` under these names.

    A machine with `more` Debian packages has its own `name`.
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
