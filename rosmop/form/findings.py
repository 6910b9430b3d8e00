"""The errors and warnings of specifications, with the names of fields of ``rosrv monitor check --json``."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning"]


@dataclass(frozen=True, order=True)
class Position:
    """A position in a file. Lines and columns count from 1, and a column is a character (a tab is one)."""

    file: str
    line: int
    column: int

    def within(self, text: str, offset: int) -> "Position":
        lines = text.count("\n", 0, offset)
        if not lines:
            return Position(self.file, self.line, self.column + offset)
        return Position(self.file, self.line + lines, offset - text.rfind("\n", 0, offset))

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}"


def line_of(text: str, number: int) -> str:
    lines = text.splitlines()[number - 1 : number]
    return lines[0].partition("//")[0].strip() if lines else ""


@dataclass(frozen=True)
class Diagnostic:
    """A finding for the author of a specification; the message names the remedy."""

    position: Position
    severity: Severity
    text: str

    def __str__(self) -> str:
        return f"{self.position}: {self.severity}: {self.text}"


class SpecificationError(Exception):
    """A rejected file, with all errors in the order of the text."""

    def __init__(self, findings: Iterable[Diagnostic]) -> None:
        self.findings = tuple(sorted(findings, key=lambda finding: finding.position))
        super().__init__("\n".join(map(str, self.findings)))

    @classmethod
    def at(cls, position: Position, text: str) -> "SpecificationError":
        return cls([Diagnostic(position, "error", text)])
