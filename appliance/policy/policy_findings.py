"""What is wrong with a text an operator wrote, and where: `file:line:column: error: text`.

Errors refuse the file, warnings (the lint) never do. All of them are found in one go, so that a file is
mended in one go.
"""

import enum
from dataclasses import dataclass

MAXIMUM_FINDINGS = 200


class Severity(enum.StrEnum):
    """Whether a finding refuses the file."""

    ERROR = "error"
    WARNING = "warning"


@dataclass(frozen=True, slots=True, order=True)
class Finding:
    """One thing wrong: `line` and `column` count from 1; `text` says what was meant or what to write."""

    file: str
    line: int
    column: int
    severity: Severity
    text: str

    def __str__(self) -> str:
        """`landshark.ini:12:5: error: …`, as compilers write it."""
        return f"{self.file}:{self.line}:{self.column}: {self.severity}: {self.text}"


class PolicyError(Exception):
    """The text is refused whole; `findings` holds every error (and the warnings found on the way)."""

    def __init__(self, findings: list[Finding]) -> None:
        self.findings = findings
        super().__init__("\n".join(str(finding) for finding in findings))


class Findings:
    """Collects findings of one file; beyond `MAXIMUM_FINDINGS` errors it only counts."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.warnings: list[Finding] = []
        self._errors: list[Finding] = []
        self._uncounted = 0

    def error(self, line: int, column: int, text: str) -> None:
        """Note an error."""
        if len(self._errors) < MAXIMUM_FINDINGS:
            self._errors.append(Finding(self.file, line, column, Severity.ERROR, text))
        else:
            self._uncounted += 1

    def warn(self, line: int, column: int, text: str) -> None:
        """Note a warning."""
        if len(self.warnings) < MAXIMUM_FINDINGS:
            self.warnings.append(Finding(self.file, line, column, Severity.WARNING, text))

    @property
    def full(self) -> bool:
        """Whether so many errors are noted that another one is only counted."""
        return len(self._errors) >= MAXIMUM_FINDINGS

    def raise_errors(self) -> None:
        """Raise `PolicyError` with all findings, in the order of the file, if there is an error."""
        if not self._errors:
            return
        findings = sorted([*self._errors, *self.warnings])
        if self._uncounted:
            last = findings[-1]
            text = f"{self._uncounted} more errors are not shown"
            findings.append(Finding(self.file, last.line, last.column, Severity.ERROR, text))
        raise PolicyError(findings)


def quoted(text: str, limit: int = 60) -> str:
    """A stranger's text for a person: in quotes, shortened, control characters escaped."""
    shown = text if len(text) <= limit else text[: limit - 1] + "…"
    return '"' + "".join(c if c.isprintable() and c != '"' else _escaped(c) for c in shown) + '"'


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode() if character != '"' else '\\"'
