"""Ending processes that are not necessarily children, within a bounded time."""

import contextlib
import os
import select
import signal
import time
from collections.abc import Sequence

END_SECONDS = 3.0  # what a process has to end after SIGTERM, before SIGKILL


def end_processes(pids: Sequence[int]) -> None:
    """End processes by id: SIGTERM, and SIGKILL for those that are still there after END_SECONDS.

    Each is held by a descriptor from the start, so a number that is given to another process is never
    signalled.
    """
    descriptors: dict[int, int] = {}
    for pid in pids:
        with contextlib.suppress(OSError):
            descriptors[os.pidfd_open(pid)] = pid
    try:
        for number, limit in ((signal.SIGTERM, END_SECONDS), (signal.SIGKILL, END_SECONDS)):
            _signal_and_wait(descriptors, number, limit)
    finally:
        for descriptor in descriptors:
            os.close(descriptor)


def _signal_and_wait(descriptors: dict[int, int], number: signal.Signals, limit: float) -> None:
    """Send a signal to the processes still there and wait until all have ended, at most `limit` seconds."""
    poll = select.poll()
    waiting = set(descriptors)
    for descriptor in descriptors:
        try:
            signal.pidfd_send_signal(descriptor, number)
        except ProcessLookupError:
            waiting.discard(descriptor)
        else:
            poll.register(descriptor, select.POLLIN)
    deadline = time.monotonic() + limit
    while waiting and (left := deadline - time.monotonic()) > 0:
        for descriptor, _ in poll.poll(left * 1000):
            poll.unregister(descriptor)
            waiting.discard(descriptor)
