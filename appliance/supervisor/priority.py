"""Give processes their priority while tasks of the machine wait for a processor, and take it away while none does.

A process of higher priority interrupts the publisher within its `send`: on a quiet machine, a lone message takes up to
half as long again. While tasks wait for a processor, the priority is what lets a stop overtake them. Linux counts the
time in which some task waits (PSI, `/proc/pressure/cpu`); a kernel without PSI counts as busy at all times.
"""

import asyncio
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from appliance.base import clock
from appliance.supervisor.privileges import SUPERVISOR_CAPABILITIES, set_niceness

SAMPLE_SECONDS = 0.1  # a stop in the first moment of a load may wait as long without priority
_BUSY_SHARE = 0.2  # of a sample; nodes that exchange 1,000 messages a second cause 0.03 to 0.05
_QUIET_SECONDS = 2.0  # without a busy sample
_PRESSURE = Path("/proc/pressure/cpu")
_OWN_STATUS = Path("/proc/self/status")


@dataclass(frozen=True)
class PrioritizedProcess:
    """A running process with its two values of niceness."""

    pid: int
    nice_if_busy: int
    nice_if_quiet: int


class ProcessorPressure:
    """Whether tasks of this machine wait for a processor, by samples of the time in which some did."""

    def __init__(self) -> None:
        self._before: tuple[float, float] | None = None
        self._busy_until = 0.0

    def is_busy(self, waited: float | None, now: float) -> bool:
        """Judge the next sample.

        `waited` is the total of seconds in which some task waited; None if the kernel does not count it. Before the
        second sample, the machine counts as busy.
        """
        before, self._before = self._before, None if waited is None else (waited, now)
        if waited is None or before is None:
            self._busy_until = now + _QUIET_SECONDS
            return True
        if waited - before[0] >= _BUSY_SHARE * (now - before[1]):
            self._busy_until = now + _QUIET_SECONDS
        return now < self._busy_until


def waited_seconds(path: Path = _PRESSURE) -> float | None:
    """Return the seconds since the start of the machine in which some task waited; None without PSI."""
    try:
        for line in path.read_text(encoding="ascii").splitlines():
            kind, *fields = line.split()
            if kind == "some":
                return int(dict(field.split("=") for field in fields)["total"]) / 1e6
    except (OSError, ValueError, KeyError):
        pass
    return None


def may_raise_priority(status: Path = _OWN_STATUS) -> bool:
    """Return whether this process may raise the priority of others: it has `CAP_SYS_NICE`."""
    try:
        fields = dict(line.split(":", 1) for line in status.read_text(encoding="ascii").splitlines())
        return bool(int(fields["CapEff"], 16) >> SUPERVISOR_CAPABILITIES["SYS_NICE"] & 1)
    except (OSError, ValueError, KeyError):
        return False


async def keep_priorities(processes: Callable[[], Iterable[PrioritizedProcess]]) -> None:
    """Change the niceness of `processes()` whenever the machine becomes busy or quiet; runs until it is cancelled.

    A process starts with its priority, so it has it at all times if this returns at once: without `CAP_SYS_NICE`,
    what is taken could not be given back, and without PSI nothing tells when.
    """
    if not may_raise_priority() or waited_seconds() is None:
        return
    pressure = ProcessorPressure()
    eased: set[int] = set()
    while True:
        await asyncio.sleep(SAMPLE_SECONDS)
        busy = pressure.is_busy(waited_seconds(), clock.now())
        running = tuple(processes())
        eased &= {process.pid for process in running}
        for process in running:
            if busy == (process.pid in eased):
                with suppress(OSError):  # it has just ended
                    set_niceness(process.pid, process.nice_if_busy if busy else process.nice_if_quiet)
                (eased.discard if busy else eased.add)(process.pid)
