"""Errors of a specification, as findings with positions."""

from collections.abc import Iterable

from rosmop.form.positions import Diagnostic, Position


class SpecificationError(Exception):
    """A rejected file: all its errors, in the order of the text."""

    def __init__(self, findings: Iterable[Diagnostic]) -> None:
        self.findings = tuple(sorted(findings, key=lambda finding: finding.position))
        super().__init__("\n".join(map(str, self.findings)))

    @classmethod
    def at(cls, position: Position, text: str) -> "SpecificationError":
        """Return an error with one finding."""
        return cls([Diagnostic(position, "error", text)])


def counted(number: int, noun: str, plural: str | None = None) -> str:
    """Return a number with its noun: `1 field`, `2 fields`."""
    return f"{number} {noun if number == 1 else plural or noun + 's'}"
