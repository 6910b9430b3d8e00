"""Keep the memory (rings) in which relays store the last messages.

The recorder gets read-only descriptors, and no process can shrink a ring, so reading never fails. All memory is
allocated at the start: a shortage shows then, not during an incident, and a relay never waits for pages.
"""

import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

import msgspec
from pydantic import ByteSize

from appliance.base import clock
from appliance.channel.messages import MemoryGiven
from appliance.configuration.sections import Sections
from appliance.features.recorder.excluded_topics import known_sums
from appliance.features.recorder.recorder_link import RingTerms
from appliance.features.recorder.settings import RecorderRules
from appliance.supervisor.errors import StartError

_SEALS = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL
_PAGE = 4096
USED_BY = "appliance.features.recorder.recorder_ring:open_ring"


class RecorderRings:
    """The rings of all relays, of one total size. Raises `StartError` without enough memory."""

    def __init__(self, rules: RecorderRules, relays: int) -> None:
        if rules.memory > (left := _left()):
            raise StartError(
                f"recorder.memory: {ByteSize(rules.memory).human_readable()} is more than the machine's free memory "
                f"({left.human_readable()}): set a smaller value, or stop programs that use memory"
            )
        size = int(rules.memory) // relays // _PAGE * _PAGE
        since, sums = clock.wall_ns(), known_sums(rules.never)
        ahead = since - clock.now_ns()
        self._rings: list[tuple[RingTerms, int, int]] = []  # with the writable and the read-only descriptor
        for index in range(relays):
            writable = os.memfd_create(f"rosrv-ring-{index}", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
            os.fchmod(writable, 0o600)  # otherwise a reader could open the ring again for writing
            os.posix_fallocate(writable, 0, size)
            fcntl.fcntl(writable, fcntl.F_ADD_SEALS, _SEALS)
            readable = os.open(f"/proc/self/fd/{writable}", os.O_RDONLY | os.O_CLOEXEC)
            given = RingTerms(index, since, rules.before, list(rules.topics), list(rules.never), sums, ahead)
            self._rings.append((given, writable, readable))

    def messages_for(self, role: str, index: int) -> Iterator[tuple[MemoryGiven, int]]:
        for given, writable, readable in self._rings:
            if role == "recorder":
                yield MemoryGiven(msgspec.to_builtins(given)), readable
            elif role == "relay" and given.index == index:
                yield MemoryGiven(msgspec.to_builtins(given), USED_BY), writable

    def close(self) -> None:
        for _given, writable, readable in self._rings:
            os.close(writable)
            os.close(readable)
        self._rings.clear()


def memory_of(sections: Sections, relays: int) -> RecorderRings | None:
    rules = sections.of(RecorderRules)
    return RecorderRings(rules, relays) if rules.enabled else None


def _left() -> ByteSize:
    [row] = [
        row
        for row in Path("/proc/meminfo").read_text("ascii").splitlines()
        if row.startswith("MemAvailable:")
    ]
    return ByteSize(int(row.split()[1]) << 10)
