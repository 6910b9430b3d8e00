"""This end of a link to a process that may be started again: one channel after the other, and questions over them."""

import asyncio
import itertools
from collections.abc import Callable
from typing import Any

from appliance.channel.channel import Channel, ChannelClosedError
from appliance.channel.messages import Message


class Link:
    """Whoever is there now: `heard(message)` gets what it says, and nothing of who was there before.

    `lost(reason)` is called when it is gone and no other has come; the reason is empty unless it said something wrong.
    """

    def __init__(
        self, heard: Callable[[Any], None], lost: Callable[[str], None] = lambda _reason: None
    ) -> None:
        self.channel: Channel | None = None  # None: nobody is there
        self._heard = heard
        self._lost = lost
        self._numbers = itertools.count(1)
        self._asked: dict[int, asyncio.Future[Any]] = {}

    @property
    def unanswered(self) -> int:
        """How many questions wait for their answers."""
        return len(self._asked)

    def attach(self, channel: Channel) -> None:
        """Somebody is there, in the place of who was before."""
        self.close()
        self.channel = channel

        def received(message: Any, _descriptors: tuple[int, ...]) -> None:
            if self.channel is channel:
                self._heard(message)

        def ended(reason: str = "") -> None:
            if self.channel is channel:
                self.close()
                self._lost(reason)

        channel.attach(asyncio.get_running_loop(), received, ended, ended)

    def send(self, message: Message, descriptors: tuple[int, ...] = (), *, soon: bool = False) -> bool:
        """Tell it something, as `Channel.send`; False when nobody is there. Raises `ChannelFullError`."""
        if self.channel is None:
            return False
        self.channel.send(message, descriptors, soon=soon)
        return True

    async def ask(self, question: Callable[[int], Message], seconds: float) -> Any:
        """What `answered` is given for this question, which gets a number.

        Raises `TimeoutError`, `ChannelFullError`, and `ChannelClosedError` when nobody is there or it ended meanwhile.
        """
        number = next(self._numbers)
        answer = self._asked[number] = asyncio.get_running_loop().create_future()
        try:
            if not self.send(question(number)):
                raise ChannelClosedError("nobody is there")
            async with asyncio.timeout(seconds):
                return await answer
        finally:
            del self._asked[number]

    def answered(self, number: int, answer: Any) -> None:
        """This is the answer to the question of that number; nothing if nobody waits for it any more."""
        future = self._asked.get(number)
        if future is not None and not future.done():
            future.set_result(answer)

    def close(self) -> None:
        """Nobody is there any more; what was asked is not answered."""
        if self.channel is None:
            return
        self.channel.close()
        self.channel = None
        for future in self._asked.values():
            if not future.done():
                future.set_exception(ChannelClosedError("it ended before it answered"))
