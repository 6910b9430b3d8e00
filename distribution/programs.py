"""Run the programs that builds need: git, docker, compilers, and Debian's tools."""

import subprocess
from collections.abc import Sequence
from typing import Any


class BuildError(Exception):
    """A release cannot be built. The text has the reason and the remedy."""


def run(command: Sequence[str], *, missing: str, failed: str = "its output is above", **options: Any) -> str:
    """Return the output of a program, if `options` of `subprocess.run` capture it, or raise `BuildError`.

    `missing` is the remedy if the program is not installed, `failed` the place of its messages or the remedy.
    """
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, text=True, check=False, **options)
    except FileNotFoundError as error:
        raise BuildError(f"there is no {command[0]}: {missing}") from error
    if done.returncode:
        more = (done.stderr or "").strip().rpartition("\n")[2]
        name = " ".join(word for word in command[:2] if not word.startswith("-"))
        raise BuildError(f"{name} ended with status {done.returncode}: {more + '; ' if more else ''}{failed}")
    return done.stdout or ""
