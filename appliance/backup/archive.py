"""An archive that is to be put back: whole, and with nothing in it that `back_up` does not write.

Invariants:

1. The whole file is read before anything is believed, so the checksum at its end is compared: what was damaged on a
   worn-out stick is refused, not put back.
2. It unpacks to no more than there is room for, and holds memory for no more than `MOST_FILES` headers: plain ones of
   regular files. No header says something about the next one (sparse, pax, long names), so what is checked here is
   what is extracted.
3. Every name is one that a backup has, once.
"""

import gzip
import tarfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import BinaryIO, Self

from appliance.backup.contents import AUDIT_LOG, KEPT_PARTS, MOST_FILES, BackupError, belongs, trouble_with
from appliance.base.input_files import open_given

_PIECE = 1 << 20


class _StrangeEntryError(Exception):
    """A header that no backup has."""


class _PlainEntry(tarfile.TarInfo):
    """An entry read by its one header; any other is refused before what it announces is read."""

    @classmethod
    def frombuf(cls, buf: bytes | bytearray, encoding: str, errors: str) -> Self:
        entry = super().frombuf(buf, encoding, errors)
        if entry.type not in (tarfile.REGTYPE, tarfile.AREGTYPE):
            raise _StrangeEntryError(entry.name)
        return entry


@contextmanager
def checked_archive(file: Path, room: int) -> Iterator[tuple[tarfile.TarFile, list[tarfile.TarInfo]]]:
    """The archive and its entries, which may be extracted; they unpack to `room` bytes at most.

    Raises `BackupError`, also for what cannot be read within.
    """
    try:
        with open_given(file) as raw:
            _read_to_the_end(file, raw, room)
            raw.seek(0)
            with (
                gzip.open(raw, "rb") as unpacked,
                tarfile.open(fileobj=unpacked, mode="r:", tarinfo=_PlainEntry) as archive,
            ):
                yield archive, _entries(file, archive)
    except _StrangeEntryError as error:
        raise _strange(file, str(error)) from None
    except (OSError, tarfile.TarError, EOFError, ValueError, zlib.error) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise BackupError(f"{file} cannot be put back: {reason}") from error


def _read_to_the_end(file: Path, raw: BinaryIO, room: int) -> None:
    size = 0
    with gzip.open(raw, "rb") as unpacked:
        while piece := unpacked.read(_PIECE):
            size += len(piece)
            if size > room:
                raise BackupError(
                    f"{file} unpacks to more than the {max(0, room) >> 20} MiB that there is room for:"
                    " nothing is put back"
                )


def _entries(file: Path, archive: tarfile.TarFile) -> list[tarfile.TarInfo]:
    parts = KEPT_PARTS
    entries: dict[str, tarfile.TarInfo] = {}
    while (entry := archive.next()) is not None:
        if entry.name in entries or not belongs(entry.name, parts) or trouble_with(entry.name, entry.size):
            raise _strange(file, entry.name)
        if len(entries) == MOST_FILES:
            raise BackupError(
                f"{file} has more than {MOST_FILES} files, which no backup has: nothing is put back"
            )
        entries[entry.name] = entry
    folders = {str(folder) for name in entries for folder in PurePosixPath(name).parents}
    for name in folders & entries.keys():
        raise _strange(file, name)
    if AUDIT_LOG not in entries:
        raise BackupError(f"{file} has no audit log: it is no backup of an appliance")
    return list(entries.values())


def _strange(file: Path, name: str) -> BackupError:
    return BackupError(f"{file} has {name[:200]!r} in it, which no backup has: nothing is put back")
