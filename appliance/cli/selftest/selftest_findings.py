"""What a self-test finds, one line each."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

Outcome = Literal["ok", "warn", "fail", "skip"]


@dataclass(frozen=True, slots=True)
class Found:
    """One thing that was tried: `advice` says what to do where it is not well."""

    check: str
    outcome: Outcome
    text: str
    advice: str = ""


def ok(check: str, text: str) -> Found:
    """It is as it should be."""
    return Found(check, "ok", text)


def warn(check: str, text: str, advice: str) -> Found:
    """The appliance works, but somebody should look."""
    return Found(check, "warn", text, advice)


def fail(check: str, text: str, advice: str) -> Found:
    """The appliance will not work, or does not."""
    return Found(check, "fail", text, advice)


def skip(check: str, text: str, advice: str = "") -> Found:
    """It could not be tried here."""
    return Found(check, "skip", text, advice)


def told(check: str, tries: Callable[[], Iterable[Found]]) -> Iterator[Found]:
    """What a check finds; one that breaks is a failure of its own, and the others go on."""
    try:
        yield from tries()
    except Exception as error:  # noqa: BLE001  whatever happens on a strange machine is a finding
        yield fail(
            check, f"cannot be tried: {type(error).__name__}: {error}", "report this: a defect of rosrv"
        )
