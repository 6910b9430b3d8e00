"""The context of a CLI command, with its access to the files that the user names."""

import errno
import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from mmap import mmap
from pathlib import Path

import typer

from rosmop.recordings.recording import RecordingError
from rosmop.recordings.regular_files import open_regular
from rosmop.tool.terminal import printable

MAX_FILE = 64 << 20


@dataclass(frozen=True)
class CommandContext:
    """The context of a command; `name` begins each message. `write` replaces a file, or raises `OSError`."""

    name: str
    write: Callable[[Path, bytes | mmap], object]

    def read(self, path: Path) -> bytes:
        """Read a file. Raises `OSError`, even for a file that is too long or not regular."""
        with open_regular(path) as file:
            data = file.read(MAX_FILE + 1)
        if len(data) > MAX_FILE:
            raise OSError(errno.EFBIG, f"longer than {MAX_FILE} bytes", str(path))
        return data

    def read_text(self, path: Path) -> str:
        """Read a text file. Line ends become LF, and bytes that are not UTF-8 become surrogates. Raises `OSError`."""
        with io.TextIOWrapper(io.BytesIO(self.read(path)), "utf-8", "surrogateescape") as text:
            return text.read()

    def warn(self, text: str) -> None:
        typer.echo(f"{self.name}: {printable(text)}", err=True)

    def usage_error(self, text: str) -> typer.Exit:
        """Print the message. The caller raises the result (exit status 2)."""
        self.warn(text)
        return typer.Exit(2)

    @contextmanager
    def reports(self) -> Iterator[None]:
        try:
            yield
        except RecordingError as error:
            raise self.usage_error(str(error)) from error
