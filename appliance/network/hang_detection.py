"""Wait for a program while it progresses, and end it if it hangs.

Under emulation or load, `nft` may need a minute. A program hangs if it waits for neither a processor nor a disk.
"""

import logging
import subprocess
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path

from appliance.base import clock

STILL_SECONDS = 20.0
LONGEST_SECONDS = 600.0  # limit even for a program that progresses, such as an endless loop
_LOOK_SECONDS = 0.5
_SAY_SECONDS = 10.0
# Indexes of fields in /proc/PID/stat after the process name: proc_pid_stat(5).
_STATE, _MAJOR_FAULTS, _TIMES = 0, 9, slice(11, 13)

Start = Callable[..., "subprocess.Popen[str]"]

log = logging.getLogger("rosrv")


class ProcessActivity:
    def __init__(self, pid: int) -> None:
        self._stat = Path("/proc", str(pid), "stat")
        self._seen: tuple[str, ...] = ()
        self._since = clock.now()

    def stalled_seconds(self) -> float:
        """Return the seconds without progress; call this every second."""
        now = clock.now()
        try:
            fields = self._stat.read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        except OSError:  # it has ended
            return now - self._since
        seen = (fields[_MAJOR_FAULTS], *fields[_TIMES])
        if seen != self._seen or fields[_STATE] in "RD":
            self._seen, self._since = seen, now
        return now - self._since


def run_program(program: Start, text: str, what: str) -> tuple[int, str, str]:
    """Return exit status, standard output and standard error. Raises `TimeoutError`, `OSError`."""
    pipe = subprocess.PIPE
    with program(stdin=pipe, stdout=pipe, stderr=pipe, text=True) as process:
        said, complained = communicate(process, text, what)
    return process.returncode, said, complained


def communicate(process: "subprocess.Popen[str]", text: str, what: str) -> tuple[str, str]:
    """Send the input, and return both outputs; log long waits for `what`. Raises `TimeoutError` if it hangs."""
    began, progress, said = clock.now(), ProcessActivity(process.pid), _SAY_SECONDS
    # Send the input here: a second call of `Popen.communicate` would not continue it.
    with ThreadPoolExecutor(1, "communicate") as pool:
        talk = pool.submit(process.communicate, text)
        while not wait((talk,), _LOOK_SECONDS).done:
            waited, still = clock.now() - began, progress.stalled_seconds()
            if still > STILL_SECONDS or waited > LONGEST_SECONDS:
                process.kill()
                how = f"made no progress for {still:.0f} seconds" if still > STILL_SECONDS else "did not end"
                raise TimeoutError(f"{what} {how}: ended after {waited:.0f} seconds")
            if waited > said:
                said *= 2
                log.warning("this machine is slow: waiting for %s, which has run for %.0f s", what, waited)
        return talk.result()
