"""Keep the one record of an adoption: the state that an operator wants, and the phase that was reached.

1. Only root writes the file. While an appliance runs, only its supervisor does.
2. The phase is written before the step that it names, so a start after a crash finds at least as much as was done.
3. A phase of an earlier boot says nothing: all rules, nodes and masters of that boot are gone.
"""

import os
from enum import StrEnum
from pathlib import Path

import msgspec

from appliance.base.atomic_files import write_whole
from appliance.base.full_disk import is_full
from appliance.network.namespaces import NetworkError

FILE = "adopt.json"
_BOOT = Path("/proc/sys/kernel/random/boot_id")
_LONGEST = 64 << 10  # bytes
_BLOCK = 512  # bytes: the unit of `st_blocks`


class Phase(StrEnum):
    """How far the adoption is."""

    FREE = "free"  # the robot's nodes use their own master
    TAKING = "taking"  # nodes reach RVMaster; the graph is being read
    TAKEN = "taken"
    GIVING = "giving"  # nodes reach their own master again, or soon
    GIVEN = "given"  # their own master has everything; RVMaster still has to forget the nodes


class AdoptRecord(msgspec.Struct, frozen=True):
    """The record. `unit` and `user` identify the robot's own master; `group` is its control group, if it has one
    for itself. `stand_in` is the process of a master that a release has started.
    """

    wanted: bool = False
    phase: Phase = Phase.FREE
    boot: str = ""
    since_utc: str = ""
    unit: str = ""
    user: str = ""
    program: str = ""
    group: str = ""
    stand_in: int = 0
    nodes: tuple[str, ...] = ()
    """The keys of processes that were connected to a master at a cut (`process_key`)."""

    def now(self, boot: str) -> "AdoptRecord":
        return (
            self
            if boot == self.boot
            else msgspec.structs.replace(self, phase=Phase.FREE, boot=boot, stand_in=0, nodes=())
        )


def boot_id() -> str:
    return _BOOT.read_text(encoding="ascii").strip()


def load_record(state: Path) -> AdoptRecord:
    """Return the record with its phase in this boot. Raises `NetworkError` if the file cannot be used."""
    file = state / FILE
    try:
        with file.open("rb") as opened:
            found = msgspec.json.decode(opened.read(_LONGEST), type=AdoptRecord)
    except FileNotFoundError:
        found = AdoptRecord()
    except (OSError, ValueError) as error:
        raise NetworkError(
            f"{file} cannot be read ({error}): `rosrv release --dead` gives the graph back, and replaces it"
        ) from None
    return found.now(boot_id())


def save_record(state: Path, record: AdoptRecord) -> None:
    """Write the record. Raises `NetworkError`."""
    file, data = state / FILE, msgspec.json.encode(record)
    try:
        state.mkdir(mode=0o711, parents=True, exist_ok=True)
        try:
            write_whole(file, data, 0o644)
        except OSError as error:
            takes = record.phase is Phase.TAKING  # on a full disk nothing is granted, so nothing may be taken
            if takes or not (is_full(error, state) and file.exists() and _overwrite(file, data)):
                raise
    except OSError as error:
        raise NetworkError(f"{file} cannot be written: {error.strerror}") from error


def _overwrite(file: Path, data: bytes) -> bool:
    """Write into the blocks that the file has: a full disk must not keep a graph from being given back."""
    with file.open("r+b", buffering=0) as opened:
        found = os.fstat(opened.fileno())
        if len(data) > found.st_blocks * _BLOCK:
            return False
        opened.write(data.ljust(found.st_size))
        os.fsync(opened.fileno())
    return True
