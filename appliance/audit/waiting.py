"""Who waits until everything recorded so far is on disk, and the answer: on disk, or why not."""

import asyncio
import contextlib
import itertools
from collections.abc import Callable, Iterable
from typing import NamedTuple

Settled = Callable[[str | None], None]


class Barrier(NamedTuple):
    """Somebody who is called, on the log's thread."""

    settled: Settled


class Waiter(NamedTuple):
    """A future of somebody's event loop."""

    loop: asyncio.AbstractEventLoop
    future: asyncio.Future[str | None]


def answer(waiting: Iterable[Barrier | Waiter], result: str | None) -> None:
    """Answer all of them; those of one event loop with one call into it."""
    for loop, group in itertools.groupby(waiting, lambda one: one.loop if isinstance(one, Waiter) else None):
        futures = []
        for one in group:
            if isinstance(one, Waiter):
                futures.append(one.future)
            else:
                one.settled(result)
        if loop is not None:
            # A closed loop raises RuntimeError: nobody waits any more.
            with contextlib.suppress(RuntimeError):
                loop.call_soon_threadsafe(_settle, futures, result)


def _settle(futures: list[asyncio.Future[str | None]], result: str | None) -> None:
    for future in futures:
        if not future.done():
            future.set_result(result)
