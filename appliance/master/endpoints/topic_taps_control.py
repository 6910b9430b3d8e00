"""Looks into topics: asked of the relay that carries one, and ended after a while. Few at a time."""

import asyncio
from collections.abc import Callable

from appliance.channel import messages

MOST = 8
"""Looks at once; a relay refuses more."""


class TooManyLooksError(Exception):
    """Others look already."""


class TopicLooks:
    """What is seen of topics, until it is enough."""

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
        """The next messages of a topic, fewer where no more came in time. Raises `TooManyLooksError`."""
        if len(self._open) >= MOST:
            raise TooManyLooksError(f"{MOST} looks into topics are under way: try again")
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
        """A relay has seen a message."""
        count, seen, enough = self._open.get(message.number, (0, [], None))
        if len(seen) < count:
            seen.append(message)
        if enough is not None and len(seen) >= count:
            enough.set()
