"""Check an archive before it is restored: it is complete, and has only entries that `back_up` writes.

1. The checksum of the whole file is checked before any entry is used.
2. An archive must fit into the free space, and have at most `MOST_FILES` regular files. Headers that modify the
   next entry (sparse, pax, long names) are rejected, so exactly the checked entries are extracted. Every name is
   valid for a backup and occurs once.
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
    """An entry has a header type that backups never contain."""


class _PlainEntry(tarfile.TarInfo):
    @classmethod
    def frombuf(cls, buf: bytes | bytearray, encoding: str, errors: str) -> Self:
        entry = super().frombuf(buf, encoding, errors)
        if entry.type not in (tarfile.REGTYPE, tarfile.AREGTYPE):
            raise _StrangeEntryError(entry.name)
        return entry


@contextmanager
def checked_archive(file: Path, room: int) -> Iterator[tuple[tarfile.TarFile, list[tarfile.TarInfo]]]:
    """Open an archive and check it, with at most `room` unpacked bytes.

    Raise `BackupError`, including for read errors inside the `with` block.
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
        if isinstance(error, gzip.BadGzipFile):
            reason = "it is not a file of rosrv backup"
        raise BackupError(f"{file} cannot be restored: {reason}") from error


def _read_to_the_end(file: Path, raw: BinaryIO, room: int) -> None:
    size = 0
    with gzip.open(raw, "rb") as unpacked:
        while piece := unpacked.read(_PIECE):
            size += len(piece)
            if size > room:
                raise BackupError(
                    f"{file} unpacks to more than the {max(0, room) >> 20} MiB of free space:"
                    " nothing is restored"
                )


def _entries(file: Path, archive: tarfile.TarFile) -> list[tarfile.TarInfo]:
    parts = KEPT_PARTS
    entries: dict[str, tarfile.TarInfo] = {}
    while (entry := archive.next()) is not None:
        if entry.name in entries or not belongs(entry.name, parts) or trouble_with(entry.name, entry.size):
            raise _strange(file, entry.name)
        if len(entries) == MOST_FILES:
            raise BackupError(
                f"{file} has more than {MOST_FILES} files, more than any backup: nothing is restored"
            )
        entries[entry.name] = entry
    folders = {str(folder) for name in entries for folder in PurePosixPath(name).parents}
    for name in folders & entries.keys():
        raise _strange(file, name)
    if AUDIT_LOG not in entries:
        raise BackupError(f"{file} has no audit log: it is not a backup of an appliance")
    return list(entries.values())


def _strange(file: Path, name: str) -> BackupError:
    return BackupError(f"{file} contains {name[:200]!r}, which is not part of a backup: nothing is restored")
