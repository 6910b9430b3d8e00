"""The command that a person runs: its name in messages, and how it accesses the files that the person names."""

import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import typer

from rosmop.tool.terminal import printable


@dataclass(frozen=True)
class Program:
    """`name` begins each message, `package` is what pip installs. `read`, `open` and `write` raise `OSError`."""

    name: str
    package: str
    read: Callable[[Path], bytes]
    open: Callable[[Path], io.BufferedReader]
    write: Callable[[Path, bytes], object]

    def read_text(self, path: Path) -> str:
        """Return the text of a file, its lines ended by LF; other bytes than UTF-8 as surrogates. Raises `OSError`."""
        with io.TextIOWrapper(io.BytesIO(self.read(path)), "utf-8", "surrogateescape") as text:
            return text.read()

    def warn(self, text: str) -> None:
        """Write a message to standard error."""
        typer.echo(f"{self.name}: {printable(text)}", err=True)

    def usage_error(self, text: str) -> typer.Exit:
        """Write what is wrong with the command line; raise the result (exit status 2)."""
        self.warn(text)
        return typer.Exit(2)
