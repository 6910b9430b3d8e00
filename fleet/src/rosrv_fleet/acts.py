"""Record each change of robots, invitations, tokens and evidence with its author (docs/reference/fleet.md, Acts).

No change takes effect before its record is on the disk. An act without a second line was cut off by a crash, and may
or may not have taken effect.
"""

import contextlib
import errno
import fcntl
import json
import os
import pwd
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from appliance.base import clock

FILE = "acts.ndjson"


@contextmanager
def recorded(data: Path, act: str, about: str, detail: str = "", who: str = "") -> Iterator[None]:
    """Record an act around the block that carries it out.

    `who` defaults to this command's user, or the user who called sudo. If the act cannot be recorded, raise `OSError`
    before the block runs.
    """
    fields = {"who": who or _user(), "act": act, "about": about, "detail": detail}
    _append(data, fields | {"result": "asked"})
    result = "done"
    try:
        yield
    except BaseException as error:
        result = f"failed: {str(error) or type(error).__name__}"
        raise
    finally:
        with contextlib.suppress(OSError):  # the act is recorded already
            _append(data, fields | {"result": result})


def _append(data: Path, fields: dict[str, str]) -> None:
    time = clock.utc_now().isoformat(timespec="milliseconds")
    line = json.dumps({"time": time} | fields).encode() + b"\n"
    with contextlib.ExitStack() as opened:
        folder = os.open(data, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        opened.callback(os.close, folder)
        file = os.open(FILE, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o600, dir_fd=folder)
        opened.callback(os.close, file)
        fcntl.flock(file, fcntl.LOCK_EX)
        end = os.fstat(file).st_size
        if end and os.pread(file, 1, end - 1) != b"\n":  # a full disk or a crash cut the last line off
            line = b"\n" + line
        try:
            written = os.write(file, line)
            os.fsync(file)
            os.fsync(folder)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(data / FILE)) from error
        if written < len(line):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(data / FILE))


def _user() -> str:
    try:
        own = pwd.getpwuid(os.getuid()).pw_name
    except KeyError:
        own = str(os.getuid())
    behind = os.environ.get("SUDO_USER", "")
    return f"{behind} as {own}" if behind and os.getuid() == 0 else own
