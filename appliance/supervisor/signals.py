"""Signals that end a program, where ending in the middle would leave something on the machine.

They are blocked while the surroundings are made and taken away, and delivered to the supervisor's loop in between:

1. What is sent while the surroundings are made is heard as soon as the loop runs, which then ends in order.
2. What is sent while they are taken away asks for what is being done already: it is forgotten.
3. A thread made here blocks them, too (`block`): else the kernel would give it what the main thread does not take.
"""

import signal
from collections.abc import Iterator
from contextlib import contextmanager

_ENDING = frozenset({signal.SIGTERM, signal.SIGINT, signal.SIGHUP})


@contextmanager
def held() -> Iterator[None]:
    """Let them wait for `heard`, and forget those that wait at the end of the block. In the main thread only."""
    before = block()
    try:
        yield
    finally:
        handlers = {number: signal.signal(number, signal.SIG_IGN) for number in _ENDING}
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for number, handler in handlers.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


@contextmanager
def heard() -> Iterator[None]:
    """Have those that waited, and all that come, delivered for the length of the block, to handlers that are there."""
    before = signal.pthread_sigmask(signal.SIG_UNBLOCK, _ENDING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def block() -> set[int]:
    """Have the calling thread, and the threads and programs that it starts, not see them; what it blocked before."""
    return {int(number) for number in signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING)}
