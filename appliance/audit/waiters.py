"""Who waits until everything recorded so far is on disk, and the answer: on disk, or why not."""

import asyncio
import contextlib
import itertools
from collections.abc import Iterable
from typing import NamedTuple


class Waiter(NamedTuple):
    """A future of somebody's event loop."""

    loop: asyncio.AbstractEventLoop
    future: asyncio.Future[str | None]


def answer(waiting: Iterable[Waiter], result: str | None) -> None:
    """Answer all of them; those of one event loop with one call into it."""
    for loop, group in itertools.groupby(waiting, lambda waiter: waiter.loop):
        # A closed loop raises RuntimeError: nobody waits any more.
        with contextlib.suppress(RuntimeError):
            loop.call_soon_threadsafe(_settle, [waiter.future for waiter in group], result)


def _settle(futures: list[asyncio.Future[str | None]], result: str | None) -> None:
    for future in futures:
        if not future.done():
            future.set_result(result)
