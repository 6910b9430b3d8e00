"""Waiting for what nobody tells: a number that is reported from time to time, a record that is written a little later.

eventually(lambda: appliance.audit("--event", "node lost"), "the loss is recorded")

Where there is an event (a line that a program prints, a message on a channel), a test waits for that instead.
"""

import threading
import time
from collections.abc import Callable
from typing import TypeVar

from tests.support.processes import LIMIT

T = TypeVar("T")


def eventually(
    condition: Callable[[], T | None], what: str | Callable[[], str], seconds: float = 2 * LIMIT
) -> T:
    """The first answer of `condition` that counts as true; fails with `what` after `seconds`, which are generous.

    `what` says what should have come; as a function it is asked when it did not come.
    """
    deadline, pause = time.monotonic() + seconds, threading.Event()
    while not (found := condition()):
        if time.monotonic() > deadline:
            raise AssertionError(f"not within {seconds:.0f} s: {what if isinstance(what, str) else what()}")
        pause.wait(0.02)
    return found
