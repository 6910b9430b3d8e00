"""Write a kit or a script to standard output, or to a new file that only its owner can read.

Enrolment cannot be undone, and a token is shown only once. So the file is created, and disk space reserved,
before the request is sent.
"""

import contextlib
import functools
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import typer

from appliance.cli import output
from rosmop.tool.terminal import printable, refused, say

STANDARD_OUTPUT = Path("-")
usage_error = functools.partial(output.usage_error, verb="rosrv host")
_RESERVED = 64 << 10  # bytes; a kit needs about ten thousand


class Output:
    """The output of a kit or script; `name` is the file's name on the host."""

    def __init__(self, path: Path, name: str, file: BinaryIO) -> None:
        self.path = path
        self.name = name
        self.written = False
        self._file = file

    @property
    def is_standard(self) -> bool:
        return self.path == STANDARD_OUTPUT

    def write(self, data: bytes, lost: str) -> None:
        """If the data cannot be written, print `lost`, which has the remedy."""
        try:
            self._file.write(data)
            if not self.is_standard:
                self._file.truncate()
            self._file.flush()
        except OSError as error:
            raise refused([f"rosrv: {self.path}: {error.strerror}; {lost}"]) from None
        self.written = True

    def say(self, line: str) -> None:
        if self.is_standard:
            typer.echo(printable(line), err=True)
        else:
            say(line)


@contextlib.contextmanager
def new_output(out: Path | None, default: str, *, as_json: bool) -> Iterator[Output]:
    """Existing files are never replaced, and a file that the block did not write is removed."""
    name = default.replace("/", "_")
    if out == STANDARD_OUTPUT:
        if as_json:
            raise usage_error("--output - and --json both use standard output: give one")
        if sys.stdout.isatty():
            raise usage_error("standard output is a terminal; redirect it: --output - > FILE")
        yield Output(out, name, sys.stdout.buffer)
        return
    path = out or Path(name)
    with _opened(path) as file:
        output = Output(path, path.name, file)
        try:
            yield output
        finally:
            if not output.written:
                path.unlink()


def _opened(path: Path) -> BinaryIO:
    shown = printable(str(path))
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    except FileExistsError:
        raise usage_error(f"{shown} already exists: remove it, or name another file with --output") from None
    except OSError as error:
        raise usage_error(
            f"{shown}: {error.strerror}; name another: --output FILE, or --output - > FILE"
        ) from None
    try:
        os.posix_fallocate(descriptor, 0, _RESERVED)
    except OSError as error:
        os.close(descriptor)
        path.unlink()
        raise usage_error(
            f"{shown}: {error.strerror}; name another: --output FILE, or --output - > FILE"
        ) from None
    return os.fdopen(descriptor, "wb")
