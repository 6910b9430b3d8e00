"""Answer coroutines that wait until all records so far are on disk."""

import asyncio
import contextlib
import itertools
from collections.abc import Iterable
from typing import NamedTuple


class Waiter(NamedTuple):
    """A future and its event loop."""

    loop: asyncio.AbstractEventLoop
    future: asyncio.Future[str | None]


def answer(waiting: Iterable[Waiter], result: str | None) -> None:
    """Answer all waiters, with one call for each run of waiters of the same event loop."""
    for loop, group in itertools.groupby(waiting, lambda waiter: waiter.loop):
        # A closed loop raises RuntimeError; its coroutines no longer wait.
        with contextlib.suppress(RuntimeError):
            loop.call_soon_threadsafe(_settle, [waiter.future for waiter in group], result)


def _settle(futures: list[asyncio.Future[str | None]], result: str | None) -> None:
    for future in futures:
        if not future.done():
            future.set_result(result)
