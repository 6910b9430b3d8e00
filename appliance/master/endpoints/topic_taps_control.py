"""Tap topics at the relays that carry them, for a limited time and only a few at once."""

import asyncio
from collections.abc import Callable

import msgspec

from appliance.channel import messages
from appliance.quotas.pool import Pool, QuotaClass
from appliance.quotas.table import TOPIC_LOOKS

_STOP_SECONDS = 5.0
_TEST_SECONDS = 20.0


class TooManyTapsError(Exception):
    """The maximum number of taps, or the person's share, is already open."""


class TapRequests:
    """The open taps, and the open requests for the safe messages and tests of monitors.

    `relay_of(topic)` returns the relay that carries the topic; only that one answers. `send(message, relay)` returns
    whether the relay is there.
    """

    def __init__(self, relay_of: Callable[[str], int], send: Callable[[messages.Message, int], bool]) -> None:
        self._relay_of = relay_of
        self._send = send
        self._number = 0
        self._people: Pool[str] = Pool("queries", TOPIC_LOOKS.bounds, lambda _who: QuotaClass.REGISTERED)
        self._open: dict[tuple[int, int], tuple[int, list[messages.MessageSeen], asyncio.Event]] = {}
        self._asked: dict[tuple[int, int], asyncio.Future[messages.StopBegun | messages.GuardTested]] = {}
        """By relay and number."""

    async def look(
        self, topic: str, count: int, seconds: float, who: str, *, latched: bool
    ) -> list[messages.MessageSeen]:
        """Return up to `count` messages, or those that came in `seconds`. Raises `TooManyTapsError`."""
        if self._people.take(who):
            mine, total = self._people.held(who), self._people.total
            raise TooManyTapsError(
                f"{total} queries of topics' messages are running, {mine} of {who}: try again"
            )
        relay = self._relay_of(topic)
        self._number += 1
        number, seen, enough = self._number, list[messages.MessageSeen](), asyncio.Event()
        self._open[relay, number] = count, seen, enough
        try:
            if self._send(messages.LookWanted(number, topic, count, latched), relay):
                async with asyncio.timeout(seconds):
                    await enough.wait()
        except TimeoutError:
            pass
        finally:
            del self._open[relay, number]
            self._people.give_back(who)
            self._send(messages.LookEnded(number), relay)
        return seen

    async def stop(self, topic: str) -> list[str] | None:
        """Return the names of the monitors that have a safe message and send it; None if the relay does not answer."""
        return await self._safe_messages(topic, begin=True)

    async def stoppers(self, topic: str) -> list[str] | None:
        """Return the names of monitors with a safe message; None if the relay does not answer."""
        return await self._safe_messages(topic, begin=False)

    async def test(self, wanted: messages.GuardTestWanted) -> messages.GuardTested | None:
        """Return the outcome of a guard's test; None if the relay does not answer. The message gets its number here."""
        found = await self._answer(
            wanted.command, lambda number: msgspec.structs.replace(wanted, number=number), _TEST_SECONDS
        )
        return found if isinstance(found, messages.GuardTested) else None

    async def _safe_messages(self, topic: str, *, begin: bool) -> list[str] | None:
        found = await self._answer(
            topic, lambda number: messages.StopWanted(number, topic, begin), _STOP_SECONDS
        )
        return found.monitors if isinstance(found, messages.StopBegun) else None

    async def _answer(
        self, topic: str, numbered: Callable[[int], messages.Message], seconds: float
    ) -> messages.StopBegun | messages.GuardTested | None:
        self._number += 1
        relay, number = self._relay_of(topic), self._number
        answer: asyncio.Future[messages.StopBegun | messages.GuardTested] = (
            asyncio.get_running_loop().create_future()
        )
        self._asked[relay, number] = answer
        try:
            if not self._send(numbered(number), relay):
                return None
            async with asyncio.timeout(seconds):
                return await answer
        except TimeoutError:
            return None
        finally:
            del self._asked[relay, number]

    def seen(
        self, message: messages.MessageSeen | messages.StopBegun | messages.GuardTested, relay: int
    ) -> None:
        if not isinstance(message, messages.MessageSeen):
            answer = self._asked.get((relay, message.number))
            if answer is not None and not answer.done():
                answer.set_result(message)
            return
        count, seen, enough = self._open.get((relay, message.number), (0, [], None))
        if len(seen) < count:
            seen.append(message)
        if enough is not None and len(seen) >= count:
            enough.set()
