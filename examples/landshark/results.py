"""What the demonstration keeps of each thing that it tried, for its summary and its exit status."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Result:
    """One thing that should happen, or should not, and what became of it."""

    what: str
    good: bool
    remark: str
