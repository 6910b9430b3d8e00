"""Write lines: coloured on a terminal, plain otherwise, or as JSON.

Control characters of untrusted strings are escaped, and nothing is read as markup.
"""

import inspect
import json
import os
import sys
from collections.abc import Iterable

import msgspec
import typer

_MODES = {"bold", "dim"}


def printable(text: str) -> str:
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def refusal(findings: Iterable[object]) -> typer.Exit:
    """Print the findings. The caller raises the result (exit status 1)."""
    for finding in findings:
        typer.echo(printable(str(finding)), err=True)
    return typer.Exit(1)


def say(line: str, style: str = "") -> None:
    """Write a line; `style` is a colour, `bold`, `dim`, or a colour with one of them."""
    shown = printable(line)
    if style and sys.stdout.isatty() and "NO_COLOR" not in os.environ and os.environ.get("TERM") != "dumb":
        words = set(style.split())
        colours = words - _MODES
        shown = typer.style(shown, fg=next(iter(colours), None), **dict.fromkeys(words & _MODES, True))
    sys.stdout.write(shown + "\n")


def say_json(fields: object) -> None:
    sys.stdout.write(json.dumps(msgspec.to_builtins(fields)) + "\n")


def reflow(text: str) -> str:
    """Return help with each paragraph on one line, which a terminal of any width then breaks; `\\b` keeps its lines."""
    paragraphs = inspect.cleandoc(text).split("\n\n")
    return "\n\n".join(one if one.startswith("\b\n") else " ".join(one.split()) for one in paragraphs)
