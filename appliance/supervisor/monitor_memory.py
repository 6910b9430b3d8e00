"""Provide the files in which relays keep the state of their monitors (`relay/monitors/state_memory.py`).

The kernel keeps the files when all processes die. Files of earlier runs are removed only when each relay of a later
run has written its own, so an appliance that is killed during its start loses no state. After a reboot, a state is
used only if an orderly end wrote it to disk.
"""

import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path

import msgspec
import structlog

from appliance.base import clock
from appliance.base.atomic_files import write_whole
from appliance.channel.messages import StateGiven

FOLDER = "monitors"
SIZE = 32 << 20
"""The size of each file in bytes."""

_ENDED = "ended"
_MAX_LIVES = 4  # folders kept while no run is complete
_BOOT = Path("/proc/sys/kernel/random/boot_id")
_HEAD = 9  # bytes: the magic number, then a flag that content follows

log = structlog.get_logger()


class _Ended(msgspec.Struct):
    """The orderly end of a run; `at` is nanoseconds since the epoch."""

    boot: str
    at: int


class MonitorMemory:
    """Files of this run, one for each relay, and of earlier runs."""

    def __init__(self, state: Path, relays: int) -> None:
        self._folder = state / FOLDER
        self._boot = _this_boot()
        self._offset = clock.wall_ns() - clock.now_ns()
        self._own: list[int] = []
        self._earlier: list[int] = []
        self._ended = _Ended("", 0)
        try:
            self._folder.mkdir(mode=0o700, exist_ok=True)
            self._ended = self._take_ended()
            lives = self._lives()
            flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC
            self._earlier = [os.open(path, flags) for life in lives for path in sorted(life.iterdir())]
            own = self._folder / f"{int(lives[-1].name) + 1 if lives else 1:06}"
            own.mkdir(mode=0o700)
            for index in range(relays):
                self._own.append(_make(own / f"relay-{index}"))
            _sync(self._folder)
        except OSError as error:
            log.warning(
                "monitors do not keep their state when the appliance stops: they hold their topics after the restart",
                reason=f"{self._folder}: {error}",
            )
            for index in range(len(self._own), relays):
                self._own.append(os.memfd_create(f"rosrv-monitors-{index}", os.MFD_CLOEXEC))
                os.ftruncate(self._own[-1], SIZE)

    def messages_for(self, role: str, index: int) -> Iterator[tuple[StateGiven, int]]:
        if role != "relay":
            return
        ended = self._ended
        for descriptor in self._earlier:
            yield StateGiven(False, self._boot, self._offset, ended.boot, ended.at), descriptor
        yield StateGiven(True, self._boot, self._offset, ended.boot, ended.at), self._own[index]

    def close(self) -> None:
        try:
            for descriptor in self._own:
                os.fsync(descriptor)
            write_whole(
                self._folder / _ENDED, msgspec.json.encode(_Ended(self._boot, clock.wall_ns())), 0o600
            )
        except OSError as error:
            log.warning("the state of monitors is not saved", reason=str(error))
        for descriptor in (*self._own, *self._earlier):
            os.close(descriptor)
        self._own, self._earlier = [], []

    def _take_ended(self) -> _Ended:
        path = self._folder / _ENDED
        try:
            ended = msgspec.json.decode(path.read_bytes(), type=_Ended)
        except FileNotFoundError:
            return _Ended("", 0)
        except ValueError:
            ended = _Ended("", 0)
        path.unlink()
        _sync(self._folder)
        return ended

    def _lives(self) -> list[Path]:
        kept: list[Path] = []
        runs = [path for path in self._folder.iterdir() if path.is_dir() and path.name.isdecimal()]
        for life in sorted(runs, reverse=True):
            written = [_is_written(path) for path in life.iterdir()]
            if not any(written) or len(kept) == _MAX_LIVES or (kept and _is_complete(kept[-1])):
                shutil.rmtree(life)
            else:
                kept.append(life)
        return kept[::-1]


def _is_complete(life: Path) -> bool:
    return all(map(_is_written, life.iterdir()))


def _this_boot() -> str:
    try:
        return _BOOT.read_text("ascii").strip()
    except OSError:
        return secrets.token_hex(16)


def _is_written(path: Path) -> bool:
    with path.open("rb") as file:
        return any(file.read(_HEAD)[_HEAD - 1 :])


def _make(path: Path) -> int:
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    descriptor = os.open(path, flags, 0o600)
    try:
        os.posix_fallocate(descriptor, 0, SIZE)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def _sync(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
