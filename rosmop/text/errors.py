"""What is wrong with a specification, as findings with positions."""

from collections.abc import Iterable

from rosmop.form.positions import Finding, Position


class SpecificationError(Exception):
    """A file that is refused: every error that was found, in the order of the text."""

    def __init__(self, findings: Iterable[Finding]) -> None:
        self.findings = tuple(sorted(findings, key=lambda finding: finding.position))
        super().__init__("\n".join(map(str, self.findings)))

    @classmethod
    def at(cls, position: Position, text: str) -> "SpecificationError":
        """The refusal for one reason."""
        return cls([Finding(position, "error", text)])


def counted(number: int, noun: str, plural: str | None = None) -> str:
    """`1 field`, `2 fields`."""
    return f"{number} {noun if number == 1 else plural or noun + 's'}"
