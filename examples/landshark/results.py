"""Define the results of the demonstration's steps, for its summary and its exit status."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Result:
    """A step that should succeed or fail, and its outcome."""

    what: str
    good: bool
    remark: str
