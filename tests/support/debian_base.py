"""Make a small Debian with debootstrap, as the base of the tests' containers and virtual machines.

Its result is kept in `CACHE` for each suite and package list. The tree can fetch more packages with this machine's
sources, proxy, certificate authorities and pip settings.
"""

import fcntl
import hashlib
import os
import shutil
import subprocess
import urllib.request
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.support.requirements import need_program, need_root

ROOT = Path(__file__).parents[2]
CACHE = Path("/var/cache/rosrv-tests")
SUITE = "bookworm"
MINUTES = 15
_CERTIFICATES = Path("etc/ssl/certs/ca-certificates.crt")
# Settings that apt needs to fetch here; all other settings are the tree's own.
_APT_KEYS = (
    "Acquire::http",
    "Acquire::https",
    "Acquire::Check-Valid-Until",
    "Acquire::Check-Date",
    "Acquire::Retries",
)
_PIP_KEYS = ("index-url", "extra-index-url", "trusted-host", "timeout", "default-timeout")
_IN_TREE = """
set -eu
root=$1; shift
mount -t proc proc "$root/proc"
mount --rbind /dev "$root/dev"
printf 'exit 101\\n' > "$root/usr/sbin/policy-rc.d"
chmod 755 "$root/usr/sbin/policy-rc.d"
chroot "$root" apt-get update -q
[ $# -eq 0 ] || chroot "$root" apt-get install -y -q --no-install-recommends "$@"
chroot "$root" apt-get clean
rm -rf "$root"/var/lib/apt/lists/* "$root/usr/sbin/policy-rc.d"
# What one machine has must not be every machine's.
rm -f "$root/etc/machine-id" "$root/etc/hostname"
"""


class DebianBaseError(RuntimeError):
    pass


@dataclass(frozen=True)
class MachineSettings:
    mirror: str
    files: Mapping[str, str]  # path in the tree -> text


def make_base(directory: Path, packages: Sequence[str] = (), *, suite: str = SUITE) -> Path:
    """Unpack a Debian into `directory`, which the caller may change. Raise `DebianBaseError`.

    Needs root and debootstrap.
    """
    archive = base_archive(packages, suite=suite)
    directory.mkdir(parents=True, exist_ok=True)
    _unpack(archive, directory)
    return directory


def base_archive(packages: Sequence[str] = (), *, suite: str = SUITE) -> Path:
    need_root()
    need_program("debootstrap", "debootstrap")
    settings = machine_settings(suite)
    folder = CACHE / "debian"
    folder.mkdir(parents=True, exist_ok=True)
    archive = folder / f"{suite}-{_key(packages, settings)}.tar"
    with archive.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # each is made once; a second process waits and finds it
        if not archive.exists():
            _make(archive, packages, suite, settings)
    return archive


def machine_settings(suite: str = SUITE) -> MachineSettings:
    sources = debian_sources(
        _output("apt-get", "indextargets", "--format", _TARGET, "Created-By: Packages"), suite
    )
    if not sources:
        sources = [f"deb http://deb.debian.org/debian {suite} main"]
    files = {
        "etc/apt/sources.list": "\n".join(sources) + "\n",
        "etc/apt/apt.conf.d/50machine": apt_settings(
            _output("apt-config", "dump"), urllib.request.getproxies()
        ),
        "etc/pip.conf": pip_settings(_output(str(ROOT / ".venv/bin/pip"), "config", "list")),
    }
    certificates = Path("/") / _CERTIFICATES
    if certificates.exists():
        files[str(_CERTIFICATES)] = certificates.read_text(encoding="utf-8")
    for own in Path("/usr/local/share/ca-certificates").glob(
        "*.crt"
    ):  # kept when ca-certificates is installed
        files[str(own.relative_to("/"))] = own.read_text(encoding="utf-8")
    return MachineSettings(mirror=sources[0].split()[1], files=files)


_TARGET = "$(REPO_URI) $(RELEASE) $(COMPONENT) $(ORIGIN)"


def debian_sources(targets: str, suite: str) -> list[str]:
    found: dict[tuple[str, str], set[str]] = {}
    for fields in map(str.split, targets.splitlines()):
        if len(fields) >= 4 and fields[1].split("-")[0] == suite and fields[3] == "Debian":
            found.setdefault((fields[0], fields[1]), set()).add(fields[2])
    rows = sorted(found.items(), key=lambda row: (row[0][1] != suite, row[0]))
    return [f"deb {uri} {release} {' '.join(sorted(parts))}" for (uri, release), parts in rows]


def apt_settings(dump: str, proxies: Mapping[str, str]) -> str:
    lines = [line for line in dump.splitlines() if line.startswith(_APT_KEYS)]
    for scheme in ("http", "https"):
        if scheme in proxies and not any(line.startswith(f"Acquire::{scheme}::Proxy ") for line in lines):
            lines.append(f'Acquire::{scheme}::Proxy "{proxies[scheme]}";')
    return "\n".join([*lines, ""])


def pip_settings(listed: str) -> str:
    kept = {"cert": f"/{_CERTIFICATES}"}
    for name, _, value in (line.partition("=") for line in listed.splitlines()):
        key = name.rpartition(".")[2]
        urls = " ".join(one for one in value.strip("'\"").split() if not one.startswith(("file:", "/")))
        if key in _PIP_KEYS and urls:
            kept[key] = urls
    return "\n".join(["[global]", *(f"{key} = {value}" for key, value in kept.items()), ""])


def _unpack(archive: Path, directory: Path) -> None:
    options = ("--extract", "--numeric-owner", "--xattrs")
    _run("tar", *options, "--file", str(archive), "--directory", str(directory))


def _make(archive: Path, packages: Sequence[str], suite: str, settings: MachineSettings) -> None:
    tree = archive.with_suffix(f".{os.getpid()}.tree")
    try:
        if packages:
            tree.mkdir()
            _unpack(base_archive(suite=suite), tree)
        else:
            _run("debootstrap", "--variant=minbase", suite, str(tree), settings.mirror)
        for name, text in settings.files.items():
            path = tree / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
        # Its own mounts end with it in every case.
        _run(
            "unshare", "--mount", "--propagation", "private", "sh", "-c", _IN_TREE, "sh", str(tree), *packages
        )
        making = archive.with_suffix(".making")
        _run(
            "tar",
            "--create",
            "--numeric-owner",
            "--xattrs",
            "--file",
            str(making),
            "--directory",
            str(tree),
            ".",
        )
        making.replace(archive)
    finally:
        shutil.rmtree(tree, ignore_errors=True)


def _key(packages: Iterable[str], settings: MachineSettings) -> str:
    parts = [_IN_TREE, settings.mirror, *sorted(packages)]
    parts += [text for one in sorted(settings.files.items()) for text in one]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]


def _output(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout


def _run(*command: str) -> None:
    environment = os.environ | {"LC_ALL": "C", "DEBIAN_FRONTEND": "noninteractive"}
    done = subprocess.run(
        command,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="backslashreplace",
        timeout=MINUTES * 60,
        check=False,
    )
    if done.returncode:
        words = "\n  ".join(done.stdout.strip().splitlines()[-15:])
        raise DebianBaseError(f"{' '.join(command[:4])} … ended with status {done.returncode}:\n  {words}")
