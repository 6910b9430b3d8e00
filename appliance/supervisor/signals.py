"""Block ending signals while the isolation is built or removed, so that nothing is left on the machine.

Signals during the build are delivered when the supervisor's loop runs, and signals during the removal are ignored.
Other threads must also block them (`block`), or the kernel would deliver the signals to them.
"""

import signal
from collections.abc import Iterator
from contextlib import contextmanager

_ENDING = frozenset({signal.SIGTERM, signal.SIGINT, signal.SIGHUP})


@contextmanager
def hold() -> Iterator[None]:
    """Hold the signals except within `hear`, and then ignore them. Main thread only."""
    before = block()
    try:
        yield
    finally:
        handlers = {number: signal.signal(number, signal.SIG_IGN) for number in _ENDING}
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for number, handler in handlers.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


@contextmanager
def hear() -> Iterator[None]:
    before = signal.pthread_sigmask(signal.SIG_UNBLOCK, _ENDING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def block() -> set[int]:
    return {int(number) for number in signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING)}
