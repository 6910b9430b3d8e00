"""Where a kit or a script goes: a new file of its owner only, or standard output.

An order to the appliance cannot be taken back: a new kit revokes the certificate before, a token is shown once. So the
file is made, and has room, before anything is asked; when nothing comes of the order it is gone again.
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
_ROOM = 64 << 10  # bytes; a kit has ten thousand or so


class Output:
    """A new file, or standard output. `written`: whether it has what it is for; `name`: what a host calls it."""

    def __init__(self, path: Path, name: str, file: BinaryIO) -> None:
        self.path = path
        self.name = name
        self.written = False
        self._file = file

    @property
    def is_standard(self) -> bool:
        """Whether it is standard output."""
        return self.path == STANDARD_OUTPUT

    def write(self, data: bytes, lost: str) -> None:
        """Write it all, once. Where that fails, `lost` says what to do; ends the program with 1."""
        try:
            self._file.write(data)
            if not self.is_standard:
                self._file.truncate()
            self._file.flush()
        except OSError as error:
            raise refused([f"rosrv: {self.path}: {error.strerror}; {lost}"]) from None
        self.written = True

    def say(self, line: str) -> None:
        """Tell the person: on standard output, or beside it where that is taken."""
        if self.is_standard:
            typer.echo(printable(line), err=True)
        else:
            say(line)


@contextlib.contextmanager
def new_output(out: Path | None, default: str, *, as_json: bool) -> Iterator[Output]:
    """Where to write, `default` where nobody said it. Nothing that is there is replaced.

    Ends the program with 2 where it cannot be written. A file that was not written in the block is taken away.
    """
    name = default.replace("/", "_")
    if out == STANDARD_OUTPUT:
        if as_json:
            raise usage_error("--out - and --json both want standard output: give one")
        if sys.stdout.isatty():
            raise usage_error("standard output is this terminal: --out - > FILE")
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
        raise usage_error(f"{shown} is there already: remove it, or name another with --out") from None
    except OSError as error:
        raise usage_error(f"{shown}: {error.strerror}; name another: --out FILE, or --out - > FILE") from None
    try:
        os.posix_fallocate(descriptor, 0, _ROOM)
    except OSError as error:
        os.close(descriptor)
        path.unlink()
        raise usage_error(f"{shown}: {error.strerror}; name another: --out FILE, or --out - > FILE") from None
    return os.fdopen(descriptor, "wb")
