"""One end of a link to a process that may be restarted; each life of the process has its own channel."""

import asyncio
import itertools
import os
from collections.abc import Callable
from typing import Any

from appliance.channel.channel import Channel, ChannelClosedError
from appliance.channel.messages import Message


class Link:
    """The present channel; `heard(message)` gets messages of the present process only.

    `lost(reason)` is called when the process is gone and has no successor yet; the reason is empty unless the process
    sent an invalid message.
    """

    def __init__(
        self,
        heard: Callable[[Message], None],
        lost: Callable[[str], None] = lambda _reason: None,
        took: Callable[[Message, tuple[int, ...]], None] | None = None,
    ) -> None:
        self.channel: Channel | None = None  # None: not connected
        self._heard = heard
        self._lost = lost
        self._took = took
        self._numbers = itertools.count(1)
        self._asked: dict[int, asyncio.Future[Any]] = {}

    @property
    def unanswered(self) -> int:
        return len(self._asked)

    def attach(self, channel: Channel) -> None:
        self.close()
        self.channel = channel

        def received(message: Message, descriptors: tuple[int, ...]) -> None:
            if descriptors and self._took is not None and self.channel is channel:
                self._took(message, descriptors)
                return
            for descriptor in descriptors:
                os.close(descriptor)
            if self.channel is channel:
                self._heard(message)

        def ended(reason: str = "") -> None:
            if self.channel is channel:
                self.close()
                self._lost(reason)

        channel.attach(asyncio.get_running_loop(), received, ended, ended)

    def send(self, message: Message, descriptors: tuple[int, ...] = (), *, soon: bool = False) -> bool:
        """Send a message; return False if the link is not connected. Raises `ChannelFullError`."""
        if self.channel is None:
            return False
        self.channel.send(message, descriptors, soon=soon)
        return True

    async def ask(
        self, question: Callable[[int], Message], seconds: float, descriptors: tuple[int, ...] = ()
    ) -> Any:
        """Return the answer to a question. Raises `TimeoutError`, `ChannelFullError` and `ChannelClosedError`."""
        number = next(self._numbers)
        answer = self._asked[number] = asyncio.get_running_loop().create_future()
        try:
            if not self.send(question(number), descriptors):
                raise ChannelClosedError("the link is not connected")
            async with asyncio.timeout(seconds):
                return await answer
        finally:
            del self._asked[number]

    def answered(self, number: int, answer: object) -> None:
        future = self._asked.get(number)
        if future is not None and not future.done():
            future.set_result(answer)

    def release(self) -> Channel | None:
        """Give the channel to another link, which gets all later messages."""
        channel, self.channel = self.channel, None
        if channel is not None:
            channel.detach()
        return channel

    def close(self) -> None:
        if self.channel is None:
            return
        self.channel.close()
        self.channel = None
        for future in self._asked.values():
            if not future.done():
                future.set_exception(ChannelClosedError("it ended before it answered"))
