"""The context of a CLI command: the name used in its messages, and its access to the files that the user names."""

import errno
import io
import os
import stat
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import typer

from rosmop.tool.terminal import printable

MAX_FILE = 64 << 20
"""The size limit in bytes of a file that is read whole."""

_NULL = os.makedev(1, 3)  # /dev/null: an empty file
_KINDS = {
    stat.S_IFIFO: "a named pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFDIR: "a folder",
    stat.S_IFSOCK: "a socket",
}


@dataclass(frozen=True)
class CommandContext:
    """The context of a command.

    `name` begins each message. `write` replaces a file, or raises `OSError`.
    """

    name: str
    write: Callable[[Path, bytes], object]

    def read(self, path: Path) -> bytes:
        """Return the bytes of a regular file, `MAX_FILE` at most. Raises `OSError`."""
        with open_regular(path) as file:
            data = file.read(MAX_FILE + 1)
        if len(data) > MAX_FILE:
            raise OSError(errno.EFBIG, f"longer than {MAX_FILE} bytes", str(path))
        return data

    def read_text(self, path: Path) -> str:
        """Return the text of a file with LF line endings; invalid UTF-8 bytes become surrogates. Raises `OSError`."""
        with io.TextIOWrapper(io.BytesIO(self.read(path)), "utf-8", "surrogateescape") as text:
            return text.read()

    def warn(self, text: str) -> None:
        """Write a message to standard error."""
        typer.echo(f"{self.name}: {printable(text)}", err=True)

    def usage_error(self, text: str) -> typer.Exit:
        """Report an error in the command line. The caller raises the result (exit status 2)."""
        self.warn(text)
        return typer.Exit(2)


def open_regular(path: Path) -> io.BufferedReader:
    """Open a regular file, or the pipe that a shell made for `<(command)` or `command |`. Raises `OSError`.

    Other files are rejected: a named pipe may block its reader for ever, and a device may be endless.
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
