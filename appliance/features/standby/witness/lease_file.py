"""The lease on the disk."""

import contextlib
import fcntl
import hashlib
import json
import os
from typing import Iterator, NamedTuple, Tuple

from appliance.features.standby.witness.errors import UncertainError, WitnessError
from appliance.features.standby.witness.protocol import is_count

BOOT_ID = "/proc/sys/kernel/random/boot_id"
_COPY = 4096  # bytes of each of the two copies of the lease: a block of the disk

LeaseRecord = NamedTuple(
    "LeaseRecord", [("epoch", int), ("holder", str), ("in_sync", Tuple[str, ...]), ("boot", str)]
)
"""The lease on the disk. `holder` is empty before the first grant; `boot` identifies the boot of its last change."""


class LeaseFile:
    """The lease on the disk: two copies in a file that keeps its size, so that no change needs free space.

    A crash leaves at most one copy incomplete, and the other one is right: the change was not answered before
    both were written. The file of an earlier version has one copy.

    """

    def __init__(self, path: str, names: Tuple[str, ...]) -> None:
        self.path = path
        self._names = names
        self._lock = -1

    def __enter__(self) -> "LeaseFile":
        os.makedirs(os.path.dirname(os.path.abspath(self.path)), mode=0o700, exist_ok=True)
        self._lock = os.open(self.path + ".lock", os.O_RDWR | os.O_CREAT, 0o600)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self.__exit__()
            raise WitnessError(
                "another witness uses %s; stop it first: systemctl stop rosrv-witness" % self.path
            ) from error
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._lock)
        self._lock = -1

    def read(self) -> LeaseRecord:
        try:
            with open(self.path, "rb") as file:
                content = file.read(2 * _COPY + 1)
            if len(content) != 2 * _COPY:
                return self._record(content)
            try:
                return self._record(content[:_COPY])
            except (ValueError, KeyError, TypeError):
                return self._record(content[_COPY:])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise WitnessError(
                "the lease %s cannot be used: %s; both appliances are shut out. Run: witness.py begin --in-sync NAMES"
                " --epoch N, with the appliances that have all data and an epoch greater than both appliances show"
                % (self.path, error)
            ) from error

    def _record(self, copy: bytes) -> LeaseRecord:
        code, _, text = copy.rstrip(b" ").partition(b"\n")
        if code.decode("ascii") != hashlib.sha256(text).hexdigest():
            raise ValueError("its checksum is wrong")
        body = json.loads(text.decode("ascii"))
        record = LeaseRecord(body["epoch"], body["holder"], tuple(body["in_sync"]), body["boot"])
        if not (is_count(record.epoch) and record.in_sync and set(record.in_sync) <= set(self._names)):
            raise ValueError("it does not fit the settings")
        if record.holder and record.holder not in record.in_sync:
            raise ValueError("its holder is not in sync")
        return record

    def check_disk(self) -> None:
        write_synced(self.path + ".check", b" " * _COPY)

    def has_room(self) -> bool:
        try:
            return os.stat(self.path).st_size == 2 * _COPY
        except OSError:
            return False

    def write(self, record: LeaseRecord) -> None:
        """Save the lease. After a `WitnessError` that is not an `UncertainError`, the old lease stays."""
        body = {
            "epoch": record.epoch,
            "holder": record.holder,
            "in_sync": list(record.in_sync),
            "boot": record.boot,
        }
        text = json.dumps(body, sort_keys=True).encode("ascii")
        copy = (hashlib.sha256(text).hexdigest().encode("ascii") + b"\n" + text).ljust(_COPY)
        failure = WitnessError
        try:
            if self.has_room():
                for offset in (0, _COPY):
                    with open_synced(self.path, os.O_WRONLY) as descriptor:
                        written = os.pwrite(descriptor, copy, offset)
                        failure = UncertainError
                        if written != _COPY:
                            raise OSError("a part was written")
                return
            new = self.path + ".new"
            with contextlib.suppress(FileNotFoundError):
                os.unlink(new)
            write_synced(new, 2 * copy)
            os.rename(new, self.path)
            failure = UncertainError
            with open_synced(os.path.dirname(os.path.abspath(new)), os.O_RDONLY):
                pass
        except OSError as error:
            raise failure("the lease %s cannot be saved: %s" % (self.path, error)) from error


@contextlib.contextmanager
def open_synced(path: str, flags: int) -> Iterator[int]:
    """Open a file or folder, and wait at the end until its changes are on the disk."""
    descriptor = os.open(path, flags, 0o600)
    try:
        yield descriptor
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_synced(path: str, content: bytes) -> None:
    with open_synced(path, os.O_WRONLY | os.O_CREAT) as descriptor:
        if os.write(descriptor, content) != len(content):
            raise OSError("the disk is full")
