"""Open regular files, and read them with a limit."""

import errno
import os
import stat
from io import BufferedReader
from pathlib import Path, PosixPath
from typing import BinaryIO

LARGEST_CHUNK = 256 << 20
_LONGEST_LINE = 64
_NULL = os.makedev(1, 3)  # /dev/null: an empty file
_KINDS = {
    stat.S_IFIFO: "a named pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFDIR: "a folder",
    stat.S_IFSOCK: "a socket",
}


def open_regular(path: Path) -> BufferedReader:
    """Open a regular file, or the pipe that a shell made for `<(command)` or `command |`. Raises `OSError`.

    Other files are rejected: a named pipe may block its reader forever, and a device may be endless.
    """
    descriptor = os.open(os.fspath(path), os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    try:
        status = os.fstat(descriptor)
        kind = stat.S_IFMT(status.st_mode)
        if kind == stat.S_IFIFO and str(Path(f"/proc/self/fd/{descriptor}").readlink()).startswith("pipe:"):
            os.set_blocking(descriptor, True)
        elif kind != stat.S_IFREG and status.st_rdev != _NULL:
            text = f"not a regular file: it is {_KINDS.get(kind, 'something else')}"
            raise OSError(errno.EINVAL, text, str(path))
    except BaseException:
        os.close(descriptor)
        raise
    return os.fdopen(descriptor, "rb")


class _BoundedFile(BufferedReader):
    def read(self, size: int | None = -1, /) -> bytes:
        if size is None or not 0 <= size <= LARGEST_CHUNK:
            raise ValueError(f"it has a record of more than {LARGEST_CHUNK} bytes.")
        return super().read(size)

    def readline(self, _size: int | None = -1, /) -> bytes:
        return super().readline(_LONGEST_LINE)


class BoundedPath(PosixPath):
    """The path of a regular file that is read in bounded pieces."""

    def open(self, *_mode: object) -> BinaryIO:  # type: ignore[override] # readers of recordings ask for bytes
        return _BoundedFile(open_regular(Path(self)).detach())
