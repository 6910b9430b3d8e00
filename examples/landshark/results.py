"""Define the results of the demonstration's steps, for its summary and its exit status."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Result:
    """A step and its outcome. `good` means that it succeeded or failed as expected."""

    what: str
    good: bool
    remark: str
