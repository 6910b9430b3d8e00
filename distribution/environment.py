"""Make the locked Python environment of the package, for one architecture and all interpreters.

    lib/python3.11/site-packages   files for this interpreter only
    lib/python3.12/site-packages   and so on
    common                         files for all: each `site-packages` has a `common.pth` with its path

The wheels are those of requirements.lock, verified by hash. None of their code runs here. python-iptables has no
wheel; its one C file needs only libc, and is compiled here.
"""

import filecmp
import os
import re
import shutil
from dataclasses import dataclass
from pathlib import Path

from distribution.checkout import ROOT, BuildError, run

UV = ROOT / ".venv/bin/uv"
PIP = ROOT / ".venv/bin/pip"
INTERPRETERS = ("3.11", "3.12", "3.13")  # from Debian 12 to Debian 13
_SOURCE_ONLY = "python-iptables"


@dataclass(frozen=True)
class Architecture:
    """A Debian architecture and its GNU triplet."""

    debian: str
    triplet: str

    @property
    def machine(self) -> str:
        """The name of the architecture in wheels and in the kernel."""
        return self.triplet.partition("-")[0]


ARCHITECTURES = {
    "amd64": Architecture("amd64", "x86_64-linux-gnu"),
    "arm64": Architecture("arm64", "aarch64-linux-gnu"),
}


def make_environment(target: Path, architecture: Architecture, work: Path) -> None:
    """Make the environment in the new folder `target`. Raise `BuildError`."""
    wheels, source = _split_lock((ROOT / "requirements.lock").read_text(), work)
    trees = [target / f"lib/python{version}/site-packages" for version in INTERPRETERS]
    for version, tree in zip(INTERPRETERS, trees, strict=True):
        _install_wheels(tree, version, architecture, wheels)
        _install_iptables(tree, version, architecture, source, work)
        _leave_out(tree)
        _strip(tree, architecture)
    _share(trees, target / "common")
    for tree in trees:
        # The path is relative to the folder of the .pth file.
        (tree / "common.pth").write_text("../../../common\n")


def _split_lock(lock: str, work: Path) -> tuple[Path, Path]:
    """Return the lock of the packages with wheels, and that of the package that comes as source."""
    entries = re.split(r"\n(?=\S)", lock)
    own = [entry for entry in entries if entry.startswith(f"{_SOURCE_ONLY}==")]
    if len(own) != 1:
        raise BuildError(f"requirements.lock has {len(own)} entries of {_SOURCE_ONLY}, not one")
    wheels, source = work / "wheels.lock", work / "source.lock"
    wheels.write_text("\n".join(entry for entry in entries if entry not in own) + "\n")
    source.write_text(own[0] + "\n")
    return wheels, source


def _install_wheels(tree: Path, version: str, architecture: Architecture, lock: Path) -> None:
    platform = f"{architecture.machine}-manylinux_2_28"
    _run(
        *(str(UV), "pip", "install", "--quiet", "--no-deps", "--only-binary", ":all:", "--link-mode", "copy"),
        *("--target", str(tree), "--python-version", version, "--python-platform", platform),
        *("--require-hashes", "--requirements", str(lock)),
    )


def _install_iptables(tree: Path, version: str, architecture: Architecture, lock: Path, work: Path) -> None:
    folder = work / "iptables"
    if not folder.exists():
        # pip asks the source package for its name, which needs Debian's setuptools. Nothing is installed.
        _run(
            *(
                str(PIP),
                "download",
                "--quiet",
                "--disable-pip-version-check",
                "--no-deps",
                "--no-build-isolation",
            ),
            *("--no-binary", ":all:", "--require-hashes", "--requirement", str(lock), "--dest", str(folder)),
            environment={"PYTHONPATH": "/usr/lib/python3/dist-packages"},
        )
        _run("tar", "--extract", "--file", str(next(folder.glob("*.tar.gz"))), "--directory", str(folder))
    source = next(path for path in sorted(folder.iterdir()) if path.is_dir())
    shutil.copytree(source / "iptc", tree / "iptc")
    name, _, release = source.name.rpartition("-")
    metadata = tree / f"{name.replace('-', '_')}-{release}.dist-info"
    metadata.mkdir()
    shutil.copyfile(source / "PKG-INFO", metadata / "METADATA")
    shutil.copyfile(source / "NOTICE", metadata / "NOTICE")
    tag = f"cpython-{version.replace('.', '')}-{architecture.triplet}"
    _run(
        *(
            f"{architecture.triplet}-gcc",
            "-O2",
            "-shared",
            "-fPIC",
            "-Wl,-z,relro,-z,now",
            "-fstack-protector-strong",
        ),
        *("-o", str(tree / f"libxtwrapper.{tag}.so"), str(source / "libxtwrapper/wrapper.c")),
    )


_TESTS = ("tests", "test_data")


def _leave_out(tree: Path) -> None:
    """Remove files that the installed program does not need."""
    shutil.rmtree(tree / "bin", ignore_errors=True)
    for tests in [path for path in tree.rglob("*") if path.name in _TESTS and path.is_dir()]:
        shutil.rmtree(tests, ignore_errors=True)
    for name in (".lock", ".gitignore"):
        (tree / name).unlink(missing_ok=True)
    # These are the installer's notes about this machine, and outdated lists of files.
    for record in [*tree.glob("*.dist-info/RECORD"), *tree.glob("*.dist-info/direct_url.json")]:
        record.unlink()


def _strip(tree: Path, architecture: Architecture) -> None:
    libraries = [str(path) for path in tree.rglob("*.so*") if path.is_file() and not path.is_symlink()]
    _run(f"{architecture.triplet}-strip", "--strip-unneeded", *libraries)


def _share(trees: list[Path], common: Path) -> None:
    """Move each top-level entry that is equal in all trees to `common`."""
    common.mkdir(parents=True)
    first, *others = trees
    for entry in sorted(first.iterdir()):
        if all(_same(entry, other / entry.name) for other in others):
            entry.rename(common / entry.name)
            for other in others:
                twin = other / entry.name
                shutil.rmtree(twin) if twin.is_dir() else twin.unlink()


def _same(one: Path, other: Path) -> bool:
    if one.is_dir() != other.is_dir() or not other.exists():
        return False
    if not one.is_dir():
        return filecmp.cmp(one, other, shallow=False)
    names = {path.name for path in one.iterdir()}
    return names == {path.name for path in other.iterdir()} and all(
        _same(one / name, other / name) for name in names
    )


def _run(*command: str, environment: dict[str, str] | None = None) -> None:
    run(command, missing="scripts/setup --package", env=os.environ | (environment or {}))
