"""Find the processes that hold SQLite's write locks on the log, in the kernel's list of locks.

A correct reader never takes these locks. The files are not opened, because closing a file releases all of this
process's locks on it.
"""

from pathlib import Path

_LISTED = Path("/proc/locks")
_OF_WRITING = range(120, 123)  # bytes of the -shm file: write, checkpoint, recover (walIndex of SQLite)
_OF_THE_DATABASE = range(0x40000000, 0x40000002)  # bytes of the database: pending, reserved


def holders(log: Path) -> list[int]:
    """Return the ids of the processes with such a lock; -1 is a lock without a process (open file description)."""
    bytes_of = {}
    for path, needed in ((log.with_name(f"{log.name}-shm"), _OF_WRITING), (log, _OF_THE_DATABASE)):
        try:
            bytes_of[path.stat().st_ino] = needed
        except OSError:
            continue
    try:
        lines = _LISTED.read_text(encoding="ascii").splitlines()
    except OSError:
        return []
    found = set()
    for line in lines:
        # `1: POSIX  ADVISORY  READ 4711 fe:00:2190450 120 120`; a waiting process has `->` after the number
        words = line.split()
        if len(words) != 8 or words[1] not in {"POSIX", "OFDLCK"}:
            continue
        needed = bytes_of.get(int(words[5].rpartition(":")[2]), range(0))
        first, last = int(words[6]), 1 << 63 if words[7] == "EOF" else int(words[7])
        if needed and first <= needed[-1] and needed[0] <= last:
            found.add(int(words[4]))
    return sorted(found)
