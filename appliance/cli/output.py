"""How all verbs show things: coloured on a terminal, plain otherwise, JSON when asked for.

A stranger's strings (names, file names, whatever stands in a log) never reach a terminal with control
characters in them, and are never read as markup.
"""

import datetime
import json
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer
from rich.console import Console
from rich.text import Text

from appliance.api.moments import in_full
from appliance.base.atomic_files import NotLastingError, write_where_told

Json = Annotated[bool, typer.Option("--json", help="Machine-readable output, one object per line")]


def printable(text: str) -> str:
    """The text with everything that a terminal could act on escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def counted(number: int, noun: str) -> str:
    """`1 error`, `2 errors`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


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


def refused(findings: Iterable[object]) -> typer.Exit:
    """Write what is wrong with a text, a finding a line; raise the result (exit status 1)."""
    for finding in findings:
        typer.echo(printable(str(finding)), err=True)
    return typer.Exit(1)


def say(line: str, style: str = "") -> None:
    """Write one line to standard output."""
    shown = printable(line)
    if sys.stdout.isatty():
        Console(highlight=False, soft_wrap=True).print(Text(shown, style=style))
    else:
        sys.stdout.write(shown + "\n")


def say_json(fields: msgspec.Struct | Mapping[str, Any] | tuple[Any, ...]) -> None:
    """Write one object on one line to standard output."""
    sys.stdout.write(json.dumps(msgspec.to_builtins(in_full(fields))) + "\n")
