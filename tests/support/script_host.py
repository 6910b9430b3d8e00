"""A host of the lab that runs a kit's own scripts, as root on a Debian machine without systemd would.

It has its own network (the lab's namespace) and, in a mount namespace, its own `/etc` and `/run`. With `root` it also
has the programs of that system.
"""

import contextlib
import os
import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

from examples.landshark.lab import Host
from tests.support.processes import Process
from tests.support.waiting import eventually

_MOUNTS = """\
set -e
mount --make-rprivate /
mkdir -p "$1" && mount -t tmpfs tmpfs "$1" && mkdir "$1/upper" "$1/work"
mount -t overlay overlay -o lowerdir="$2/etc",upperdir="$1/upper",workdir="$1/work" "$2/etc"
mount -t tmpfs tmpfs "$2/run"
if [ -n "$2" ]; then
    mount -t proc proc "$2/proc"
    mount --rbind /dev "$2/dev"
fi
exec chroot "$2/" sh -c 'echo mounted; exec sleep infinity'
"""

_PATIENT_LOOKS = 20  # some seconds


class ScriptHost:
    def __init__(self, host: Host, directory: Path, root: Path | None = None) -> None:
        self.outer = host
        self.directory = directory
        self.address = ""
        self._upper = directory / "layer"
        self._looks = 0
        directory.mkdir(parents=True, exist_ok=True)
        self._holder = Process(
            host,
            ["unshare", "-m", "sh", "-c", _MOUNTS, "sh", str(self._upper), str(root or "")],
            env={"PATH": os.environ["PATH"]},
            label=f"mounts of {host.name}",
        )

    def __enter__(self) -> Self:
        self._holder.wait_for_text("mounted")
        return self

    def __exit__(self, *exc: object) -> None:
        self.run("sh", "-c", "for f in /run/rosrv/*.pid; do [ -e $f ] && kill -- -$(cat $f); done; true")
        self._holder.stop()
        eventually(self._left, lambda: f"programs of {self.outer.name} have ended: {self._programs()}")

    def _programs(self) -> dict[int, str]:
        found = {}
        for pid in self.outer.namespace.processes():
            with contextlib.suppress(OSError):
                name = Path(f"/proc/{pid}/comm").read_text().strip()
                if name in ("charon-systemd", "keep.sh", "renew.sh"):
                    found[pid] = name
        return found

    def _left(self) -> bool:
        programs = self._programs()
        self._looks += 1
        if self._looks == _PATIENT_LOOKS:
            for pid in programs:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        return not programs

    def command(self, args: Sequence[str]) -> list[str]:
        return ["nsenter", "-t", str(self._holder.pid), "-m", "-n", "-r", "--", *args]

    def popen(self, args: Sequence[Any], **options: Any) -> "subprocess.Popen[Any]":
        return self.outer.popen(self.command([str(arg) for arg in args]), **options)

    def run(
        self, *args: str, check: bool = True, timeout: float = 90, **environment: str
    ) -> subprocess.CompletedProcess[str]:
        command = self.command(["env", *(f"{name}={text}" for name, text in environment.items()), *args])
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)
        if check and done.returncode:
            raise AssertionError(
                f"{' '.join(args)}: {done.returncode}\n{done.stdout}\n{done.stderr}\n{self.log()}"
            )
        return done

    def log(self) -> str:
        return self.run("sh", "-c", "tail -n 40 /run/rosrv/charon.log 2>/dev/null; true").stdout

    def files(self) -> list[str]:
        upper = self._upper / "upper"
        return self.run("find", str(upper), "-type", "f").stdout.replace(str(upper), "/etc").split()
