"""How all verbs show things: coloured on a terminal, plain otherwise, JSON when asked for.

A stranger's strings (names, file names, whatever stands in a log) never reach a terminal with control
characters in them, and are never read as markup.
"""

import datetime
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer

from appliance.api.moments import in_full
from appliance.base.atomic_files import NotLastingError, write_where_told
from rosmop.tool import terminal
from rosmop.tool.terminal import printable

Json = Annotated[bool, typer.Option("--json", help="Machine-readable output, one object per line")]


def moment(seconds: float) -> str:
    """A time (seconds since the epoch) as lists show it: to the minute, in UTC."""
    return datetime.datetime.fromtimestamp(seconds, datetime.UTC).strftime("%Y-%m-%d %H:%MZ")


def usage_error(text: str, verb: str = "rosrv") -> typer.Exit:
    """Write what was wrong with the command line; raise the result (exit status 2)."""
    typer.echo(f"{verb}: {printable(text)}", err=True)
    return typer.Exit(2)


def write_told(path: Path, data: bytes) -> None:
    """Write what somebody wants at a place of his choice. Raises `OSError`; what is not surely kept is told."""
    try:
        write_where_told(path, data)
    except NotLastingError as error:
        typer.echo(f"rosrv: {printable(str(path))}: {error.strerror}", err=True)


def say_json(fields: msgspec.Struct | Mapping[str, Any] | tuple[Any, ...]) -> None:
    """Write one object on one line to standard output."""
    terminal.say_json(in_full(fields))
