"""Waiting for what nobody tells, a number that is reported from time to time, a record that is written a little later;
and how long a promise may take on a machine that is busy.

eventually(lambda: appliance.audit("--event", "node lost"), "the loss is recorded")

Where there is an event (a line that a program prints, a message on a channel), a test waits for that instead.
"""

import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from tests.support.processes import LIMIT

T = TypeVar("T")


def eventually(
    condition: Callable[[], T | None], what: str | Callable[[], str], seconds: float = 2 * LIMIT
) -> T:
    """The first answer of `condition` that counts as true; fails with `what` after `seconds`, which are generous.

    `what` says what should have come; as a function it is asked when it did not come.
    """
    deadline, pause, moment = time.monotonic() + seconds, threading.Event(), 0.02
    while not (found := condition()):
        if time.monotonic() > deadline:
            raise AssertionError(f"not within {seconds:.0f} s: {what if isinstance(what, str) else what()}")
        pause.wait(moment)
        moment = min(1.5 * moment, 0.25)  # what is slow is not made slower by who asks
    return found


def allowed(seconds: float) -> float:
    """What may take so long on a machine that does nothing else, on this one: longer by what else wants to run now.

    For an upper bound that is a promise of the product; where an event shows the promise, a test waits for the event.
    """
    average, _, _, running, _ = Path("/proc/loadavg").read_text(encoding="ascii").split()
    wanting = max(float(average), float(running.partition("/")[0]))
    return seconds * (1 + wanting / len(os.sched_getaffinity(0)))
