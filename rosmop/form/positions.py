"""Where something stands in a file of specifications, and what is to be said about it.

Lines and columns count from 1; a column is a character (a tab is one). The names of the fields are those of
``rosrv monitor check --json``.
"""

from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning"]


@dataclass(frozen=True, order=True)
class Position:
    """A character of a file: ``line`` and ``column`` count from 1."""

    file: str
    line: int
    column: int

    def within(self, text: str, offset: int) -> "Position":
        """Where character ``offset`` of ``text`` stands, if ``text`` begins here."""
        lines = text.count("\n", 0, offset)
        if not lines:
            return Position(self.file, self.line, self.column + offset)
        return Position(self.file, self.line + lines, offset - text.rfind("\n", 0, offset))

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}"


def line_of(text: str, number: int) -> str:
    """A line of a specification, counted from 1, without its comment."""
    lines = text.splitlines()[number - 1 : number]
    return lines[0].partition("//")[0].strip() if lines else ""


@dataclass(frozen=True)
class Finding:
    """One thing to tell the author of a specification: where, how grave, what, and what to write instead."""

    position: Position
    severity: Severity
    text: str

    def __str__(self) -> str:
        return f"{self.position}: {self.severity}: {self.text}"
