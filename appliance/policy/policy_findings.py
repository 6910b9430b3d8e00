"""Collect errors and warnings about an operator's file, with their position: `file:line:column: error: text`.

Errors reject the file; warnings never do.
"""

import enum
from dataclasses import dataclass

from appliance.base.counted import counted

MAXIMUM_FINDINGS = 200


class FindingSeverity(enum.StrEnum):
    """The severity of a finding; an error rejects the file."""

    ERROR = "error"
    WARNING = "warning"


@dataclass(frozen=True, slots=True)
class Place:
    """A place in the file; `line` and `column` count from 1."""

    line: int = 1
    column: int = 1


@dataclass(frozen=True, slots=True, order=True)
class PolicyFinding:
    """A finding; `line` and `column` count from 1, `text` describes the mistake and the remedy."""

    file: str
    line: int
    column: int
    severity: FindingSeverity
    text: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}: {self.severity}: {self.text}"


class PolicyError(Exception):
    """A file has errors; `findings` has all of them, and the warnings found so far."""

    def __init__(self, findings: list[PolicyFinding]) -> None:
        self.findings = findings
        super().__init__("\n".join(str(finding) for finding in findings))


class Findings:
    """Collects findings; beyond `MAXIMUM_FINDINGS`, errors are only counted."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.warnings: list[PolicyFinding] = []
        self._errors: list[PolicyFinding] = []
        self._uncounted = 0

    def error(self, at: Place, text: str) -> None:
        if len(self._errors) < MAXIMUM_FINDINGS:
            self._errors.append(PolicyFinding(self.file, at.line, at.column, FindingSeverity.ERROR, text))
        else:
            self._uncounted += 1

    def warn(self, at: Place, text: str) -> None:
        if len(self.warnings) < MAXIMUM_FINDINGS:
            self.warnings.append(PolicyFinding(self.file, at.line, at.column, FindingSeverity.WARNING, text))

    @property
    def full(self) -> bool:
        return len(self._errors) >= MAXIMUM_FINDINGS

    def raise_errors(self) -> None:
        if not self._errors:
            return
        findings = sorted([*self._errors, *self.warnings])
        if self._uncounted:
            last = findings[-1]
            text = f"{counted(self._uncounted, 'more error is', 'more errors are')} not shown"
            findings.append(PolicyFinding(self.file, last.line, last.column, FindingSeverity.ERROR, text))
        raise PolicyError(findings)


def quote(text: str, limit: int = 60) -> str:
    shown = text if len(text) <= limit else text[: limit - 1] + "…"
    return '"' + "".join(c if c.isprintable() and c != '"' else _escape(c) for c in shown) + '"'


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode() if character != '"' else '\\"'
