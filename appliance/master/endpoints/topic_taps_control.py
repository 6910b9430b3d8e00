"""Tap topics at the relays that carry them, for a limited time and only a few at once."""

import asyncio
from collections.abc import Callable

from appliance.channel import messages

MOST = 8
"""The most taps at once; relays have the same limit."""

_STOP_SECONDS = 5.0


class TooManyTapsError(Exception):
    """The maximum number of taps is already open."""


class TapRequests:
    """The open taps, and the open requests for the safe messages of monitors.

    `sender(topic)` returns the function that sends a message to the relay that carries the topic.
    """

    def __init__(self, sender: Callable[[str], Callable[[messages.Message], bool]]) -> None:
        self._sender = sender
        self._number = 0
        self._open: dict[int, tuple[int, list[messages.MessageSeen], asyncio.Event]] = {}
        self._stops: dict[int, asyncio.Future[list[str]]] = {}

    async def look(
        self, topic: str, count: int, seconds: float, *, latched: bool
    ) -> list[messages.MessageSeen]:
        """Return up to `count` messages, or those that came in time. Raises `TooManyTapsError`."""
        if len(self._open) >= MOST:
            raise TooManyTapsError(f"{MOST} queries of topics' messages are running: try again")
        send = self._sender(topic)
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

    async def stop(self, topic: str) -> list[str]:
        """Return the names of the monitors that have a safe message and send it."""
        return await self._safe_messages(topic, begin=True) or []

    async def stoppers(self, topic: str) -> list[str] | None:
        """Return the names of monitors with a safe message; None if the relay does not answer."""
        return await self._safe_messages(topic, begin=False)

    async def _safe_messages(self, topic: str, *, begin: bool) -> list[str] | None:
        self._number += 1
        number = self._number
        begun: asyncio.Future[list[str]] = asyncio.get_running_loop().create_future()
        self._stops[number] = begun
        try:
            if not self._sender(topic)(messages.StopWanted(number, topic, begin)):
                return None
            async with asyncio.timeout(_STOP_SECONDS):
                return await begun
        except TimeoutError:
            return None
        finally:
            del self._stops[number]

    def seen(self, message: messages.MessageSeen | messages.StopBegun) -> None:
        if isinstance(message, messages.StopBegun):
            begun = self._stops.get(message.number)
            if begun is not None and not begun.done():
                begun.set_result(message.monitors)
            return
        count, seen, enough = self._open.get(message.number, (0, [], None))
        if len(seen) < count:
            seen.append(message)
        if enough is not None and len(seen) >= count:
            enough.set()
