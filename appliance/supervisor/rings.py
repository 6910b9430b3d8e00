"""The memory in which relays leave what they received last; it outlives them, as listening sockets outlive control.

A relay writes into its own. The recorder gets descriptors that only read, and nobody can make a memory smaller, so
that reading it never fails. Nothing is ever read here. All of it is taken at the start: what is missing is missed then
and not amid an incident, and a relay does not wait for the kernel to find pages.
"""

import fcntl
import os
import time
from collections.abc import Iterator
from pathlib import Path

from pydantic import ByteSize

from appliance.channel.messages import RingGiven
from appliance.configuration.settings import RecorderRules
from appliance.recorder.never import known_sums
from appliance.supervisor.errors import StartError

_SEALS = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL
_PAGE = 4096


class Rings:
    """One memory for each relay, together what `rules` say. Raises `StartError` (not so much is left), `OSError`."""

    def __init__(self, rules: RecorderRules, relays: int) -> None:
        if rules.memory > (left := _left()):
            raise StartError(
                f"recorder.memory: {ByteSize(rules.memory).human_readable()} are more than the machine has left "
                f"({left.human_readable()}): give less, or end what else takes memory"
            )
        size = int(rules.memory) // relays // _PAGE * _PAGE
        since, sums = time.time_ns(), known_sums(rules.never)
        self._rings: list[tuple[RingGiven, int, int]] = []  # to be written and to be read
        for index in range(relays):
            writable = os.memfd_create(f"rosrv-ring-{index}", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
            os.fchmod(writable, 0o600)  # else whoever has it to read opens it anew, to write
            os.posix_fallocate(writable, 0, size)
            fcntl.fcntl(writable, fcntl.F_ADD_SEALS, _SEALS)
            readable = os.open(f"/proc/self/fd/{writable}", os.O_RDONLY | os.O_CLOEXEC)
            given = RingGiven(index, since, rules.before, list(rules.topics), list(rules.never), sums)
            self._rings.append((given, writable, readable))

    def given_to(self, role: str, index: int) -> Iterator[tuple[RingGiven, int]]:
        """What a process gets at its start."""
        for given, writable, readable in self._rings:
            if role == "recorder":
                yield given, readable
            elif role == "relay" and given.index == index:
                yield given, writable

    def close(self) -> None:
        """Let go of it."""
        for _given, writable, readable in self._rings:
            os.close(writable)
            os.close(readable)
        self._rings.clear()


def _left() -> ByteSize:
    """What the machine can still give."""
    [row] = [
        row
        for row in Path("/proc/meminfo").read_text("ascii").splitlines()
        if row.startswith("MemAvailable:")
    ]
    return ByteSize(int(row.split()[1]) << 10)
