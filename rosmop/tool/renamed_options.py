"""Accept the former names of options, for the release that renames them."""

from collections.abc import Mapping
from typing import Any

import typer
from typer.core import TyperCommand

FORMER_OPTIONS: Mapping[str, str] = {
    "--out": "--output",
    "--expires": "--for",
    "--most": "--limit",
    "--write": "--output",
    "--html": "--output",
    "--picture": "--output",
    "--seconds": "--within",
    "--wait": "--within",
    "--days": "--for",
    "--again": "--force",
    "--moving": "--force",
    "--hold": "--keep",
}
"""A name is replaced only for a command that has the new one and not the former one."""


def renamed(command: Any, args: list[str]) -> list[str]:
    known = {option for parameter in command.params for option in parameter.opts}
    given: list[str] = []
    for position, word in enumerate(args):
        if word == "--":
            return given + args[position:]
        old, sign, value = word.partition("=")
        new = FORMER_OPTIONS.get(old)
        if new in known and old not in known:
            typer.echo(f"{old} is now {new}", err=True)
            given.append(f"{new}{sign}{value}")
        else:
            given.append(word)
    return given


class RenamedCommand(TyperCommand):
    """A command that accepts former names of its options."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        return super().parse_args(ctx, renamed(self, args))
