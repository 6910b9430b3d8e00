"""Read the small files of the data folder. A damaged one is an `OSError` with its path, like an unreadable one."""

import errno
from pathlib import Path
from typing import TypeVar

import msgspec

T = TypeVar("T")


class DamagedFileError(OSError):
    """A file of the data folder has no valid content."""


def read_stored(file: Path, type_: type[T]) -> T:
    try:
        return msgspec.json.decode(file.read_bytes(), type=type_)
    except ValueError as error:
        raise DamagedFileError(
            errno.EIO, f"damaged ({error}); restore it from a backup", str(file)
        ) from error
