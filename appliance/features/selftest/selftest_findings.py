"""Define the findings of a self-test."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

Outcome = Literal["ok", "warn", "fail", "skip"]


@dataclass(frozen=True, slots=True)
class SelftestFinding:
    """The result of one check; `advice` is the remedy."""

    check: str
    outcome: Outcome
    text: str
    advice: str = ""


def ok(check: str, text: str) -> SelftestFinding:
    return SelftestFinding(check, "ok", text)


def warn(check: str, text: str, advice: str) -> SelftestFinding:
    """The appliance works, but the result needs attention."""
    return SelftestFinding(check, "warn", text, advice)


def fail(check: str, text: str, advice: str) -> SelftestFinding:
    """The appliance cannot work until the cause is corrected."""
    return SelftestFinding(check, "fail", text, advice)


def skip(check: str, text: str, advice: str = "") -> SelftestFinding:
    return SelftestFinding(check, "skip", text, advice)


def run_check(check: str, tries: Callable[[], Iterable[SelftestFinding]]) -> Iterator[SelftestFinding]:
    try:
        yield from tries()
    except Exception as error:  # noqa: BLE001  any error on an unknown machine is a finding
        yield fail(
            check, f"the check failed: {type(error).__name__}: {error}", "please report this defect in rosrv"
        )
