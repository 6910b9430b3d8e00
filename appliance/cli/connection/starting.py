"""Tell an appliance that is starting from one that does not run, by its process."""

import itertools
import os
from collections.abc import Iterator
from pathlib import Path

from appliance.base import clock

_LONGEST_START = 120.0  # seconds; an older process without a socket does not start
_PROC = Path("/proc")


def starting(state: Path) -> str:
    """Return what an appliance of this machine does that has not opened its socket; empty if none starts."""
    for pid, phase in (*_programs(state), *_lock_holder(state)):  # in the order of a start, which goes on
        try:
            age = _age(pid)
        except (OSError, ValueError):  # it has ended
            continue
        if age < _LONGEST_START:
            return f"the appliance is starting (process {pid}, for {age:.0f} s): it {phase}; try again in a few seconds"
    return ""


def starting_for(state: Path) -> float | None:
    """Return how many seconds ago the appliance of a state directory started, if that is not long ago."""
    for pid, _phase in _lock_holder(state):
        try:
            age = _age(pid)
        except (OSError, ValueError):
            continue
        return age if age < _LONGEST_START else None
    return None


def _lock_holder(state: Path) -> Iterator[tuple[int, str]]:
    try:
        pid = int((state / "lock").read_text())
        if b"rosrv" in (_PROC / str(pid) / "cmdline").read_bytes():
            yield pid, "locks its state and builds its firewall"
    except (OSError, ValueError):
        return


def _programs(state: Path) -> Iterator[tuple[int, str]]:
    """Yield each `rosrv up` of a state directory that has not yet chosen the name of its process."""
    for pid in sorted(int(entry.name) for entry in _PROC.iterdir() if entry.name.isdigit()):
        folder = _PROC / str(pid)
        try:
            words = os.fsdecode((folder / "cmdline").read_bytes()).split("\0")
            ups = [Path(word).name == "rosrv" and two == "up" for word, two in itertools.pairwise(words)]
            if any(ups) and (folder / "cwd").resolve() / _state_of(words, folder) == state.resolve():
                yield pid, "loads its program and its configuration"
        except OSError:  # it has ended, or belongs to another user
            continue


def _state_of(words: list[str], folder: Path) -> str:
    given = [value for word, value in itertools.pairwise(words) if word == "--state"]
    given += [word.partition("=")[2] for word in words if word.startswith("--state=")]
    environment = os.fsdecode((folder / "environ").read_bytes()).split("\0")
    given += [line.partition("=")[2] for line in environment if line.startswith("ROSRV_STATE=")]
    return next(filter(None, given), "/var/lib/rosrv")


def _age(pid: int) -> float:
    started = (_PROC / str(pid) / "stat").read_text().rpartition(") ")[2].split()[19]
    return clock.since_boot() - int(started) / os.sysconf("SC_CLK_TCK")
