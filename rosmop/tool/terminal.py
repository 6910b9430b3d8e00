"""Write lines: coloured on a terminal, plain otherwise, or as JSON.

Control characters of untrusted strings are escaped, and nothing is read as markup.
"""

import inspect
import json
import sys
from collections.abc import Iterable
from typing import Any

import msgspec
import typer


def printable(text: str) -> str:
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def refused(findings: Iterable[object]) -> typer.Exit:
    """Print the findings. The caller raises the result (exit status 1)."""
    for finding in findings:
        typer.echo(printable(str(finding)), err=True)
    return typer.Exit(1)


def say(line: str, style: str = "") -> None:
    shown = printable(line)
    if sys.stdout.isatty():
        from rich.console import Console  # noqa: PLC0415  `rosrv up` shall not load it
        from rich.text import Text  # noqa: PLC0415  as above

        Console(highlight=False, soft_wrap=True).print(Text(shown, style=style))
    else:
        sys.stdout.write(shown + "\n")


def say_json(fields: Any) -> None:
    sys.stdout.write(json.dumps(msgspec.to_builtins(fields)) + "\n")


def flowed(text: str) -> str:
    """Return help with each paragraph on one line, which a terminal of any width then breaks; `\\b` keeps its lines."""
    paragraphs = inspect.cleandoc(text).split("\n\n")
    return "\n\n".join(one if one.startswith("\b\n") else " ".join(one.split()) for one in paragraphs)
