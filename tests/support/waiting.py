"""Wait for changes without an event, such as a number in a status or a record that is written later."""

import asyncio
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from tests.support.processes import LIMIT

T = TypeVar("T")


class NoAnswerError(AssertionError):
    pass


def eventually(
    condition: Callable[[], T | None], what: str | Callable[[], str], seconds: float = 2 * LIMIT
) -> T:
    """Return the condition's value once it is true. A `NoAnswerError` means: not yet.

    After a generous number of `seconds`, fail with `what`, or with its result.
    """
    deadline, pause, moment = time.monotonic() + seconds, threading.Event(), 0.02
    while True:
        found, why = _tried(condition)
        if found:
            return found
        if time.monotonic() > deadline:
            told = what if isinstance(what, str) else what()
            raise AssertionError(f"not within {seconds:.0f} s: {told}{why}")
        pause.wait(moment)
        moment = min(1.5 * moment, 0.25)  # fewer polls do not slow down a slow machine further


async def until(condition: Callable[[], object]) -> None:
    """Let the other tasks of the loop run until the condition holds."""
    async with asyncio.timeout(LIMIT):
        while not condition():
            await asyncio.sleep(0.01)


def _tried(condition: Callable[[], T | None]) -> tuple[T | None, str]:
    try:
        return condition(), ""
    except NoAnswerError as error:
        return None, f"\nno answer: {error}"


def allowed(seconds: float) -> float:
    """Return the time limit, with the present load, for work that takes `seconds` on an idle machine.

    It is only for an upper bound that the product promises. If an event shows the promise, wait for the event.
    """
    average, _, _, running, _ = Path("/proc/loadavg").read_text(encoding="ascii").split()
    wanting = max(float(average), float(running.partition("/")[0]))
    return seconds * (1 + wanting / len(os.sched_getaffinity(0)))
