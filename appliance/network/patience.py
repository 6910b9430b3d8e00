"""Waiting for a program as long as it gets on: a slow machine is waited for, with words, and what hangs is not.

How long a program takes says little: under emulation, or beside others that take all processors, `nft` may need a
minute for what is done in ten milliseconds elsewhere. What hangs is known by that it gets no further: it uses no
processor time, and does not wait for a processor or a disk either.
"""

import logging
import subprocess
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path

STILL_SECONDS = 20.0
LONGEST_SECONDS = 600.0  # also of what runs in a circle
_LOOK_SECONDS = 0.5
_SAY_SECONDS = 10.0
# In /proc/PID/stat, behind the name: see proc_pid_stat(5).
_STATE, _MAJOR_FAULTS, _TIMES = 0, 9, slice(11, 13)

Start = Callable[..., "subprocess.Popen[str]"]

log = logging.getLogger("rosrv")


class Progress:
    """What a process, by its id, has got done so far."""

    def __init__(self, pid: int) -> None:
        self._stat = Path("/proc", str(pid), "stat")
        self._seen: tuple[str, ...] = ()
        self._since = time.monotonic()

    def still_seconds(self) -> float:
        """Seconds since it was last seen to get on, or to wait for a processor or a disk; look every second or so."""
        now = time.monotonic()
        try:
            fields = self._stat.read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        except OSError:  # it has ended
            return now - self._since
        seen = (fields[_MAJOR_FAULTS], *fields[_TIMES])
        if seen != self._seen or fields[_STATE] in "RD":
            self._seen, self._since = seen, now
        return now - self._since


def run(program: Start, text: str, what: str) -> tuple[int, str, str]:
    """Start a program, give it its input and wait for its end: exit status, output, errors.

    `program` is given the pipes, as `subprocess.Popen` has them. Raises: TimeoutError, as `communicate`, and what
    starting it raises.
    """
    pipe = subprocess.PIPE
    with program(stdin=pipe, stdout=pipe, stderr=pipe, text=True) as process:
        said, complained = communicate(process, text, what)
    return process.returncode, said, complained


def communicate(process: "subprocess.Popen[str]", text: str, what: str) -> tuple[str, str]:
    """Give a program its input and wait for its end; what it said. Every now and then says that `what` is waited for.

    Raises: TimeoutError, with words, when it hangs; it is killed then.
    """
    began, progress, said = time.monotonic(), Progress(process.pid), _SAY_SECONDS
    # A second `communicate` would not go on with the input.
    with ThreadPoolExecutor(1, "communicate") as pool:
        talk = pool.submit(process.communicate, text)
        while not wait((talk,), _LOOK_SECONDS).done:
            waited, still = time.monotonic() - began, progress.still_seconds()
            if still > STILL_SECONDS or waited > LONGEST_SECONDS:
                process.kill()
                how = f"got no further for {still:.0f} seconds" if still > STILL_SECONDS else "did not end"
                raise TimeoutError(f"{what} {how}: ended after {waited:.0f} seconds")
            if waited > said:
                said *= 2
                log.warning("this machine is slow: %s has run for %.0f s and is waited for", what, waited)
        return talk.result()
