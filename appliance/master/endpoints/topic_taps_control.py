"""Tap topics at the relays that carry them, for a limited time and only a few at once."""

import asyncio
from collections.abc import Callable

from appliance.channel import messages

MOST = 8
"""The most taps at once; relays have the same limit."""


class TooManyTapsError(Exception):
    """The maximum number of taps is already open."""


class TapRequests:
    """The open taps, which collect messages of topics."""

    def __init__(self) -> None:
        self._number = 0
        self._open: dict[int, tuple[int, list[messages.MessageSeen], asyncio.Event]] = {}

    async def look(
        self,
        topic: str,
        count: int,
        seconds: float,
        send: Callable[[messages.Message], bool],
        *,
        latched: bool,
    ) -> list[messages.MessageSeen]:
        """Return the next `count` messages of a topic, fewer after the time limit. Raises `TooManyTapsError`."""
        if len(self._open) >= MOST:
            raise TooManyTapsError(f"{MOST} queries of topics' messages are running: try again")
        self._number += 1
        number, seen, enough = self._number, list[messages.MessageSeen](), asyncio.Event()
        self._open[number] = count, seen, enough
        try:
            if send(messages.LookWanted(number, topic, count, latched)):
                async with asyncio.timeout(seconds):
                    await enough.wait()
        except TimeoutError:
            pass
        finally:
            del self._open[number]
            send(messages.LookEnded(number))
        return seen

    def seen(self, message: messages.MessageSeen) -> None:
        count, seen, enough = self._open.get(message.number, (0, [], None))
        if len(seen) < count:
            seen.append(message)
        if enough is not None and len(seen) >= count:
            enough.set()
