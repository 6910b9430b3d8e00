import asyncio
from collections.abc import Callable
from typing import Any

from appliance.channel.channel import Channel


class Heard:
    def __init__(self, channel: Channel, closed: Callable[[], None] = lambda: None) -> None:
        self.messages: list[Any] = []
        self._changed = asyncio.Event()
        channel.attach(asyncio.get_running_loop(), self._received, closed)

    def _received(self, message: Any, _descriptors: tuple[int, ...]) -> None:
        self.messages.append(message)
        self._changed.set()

    async def until(self, count: int) -> list[Any]:
        async with asyncio.timeout(20):
            while len(self.messages) < count:
                self._changed.clear()
                await self._changed.wait()
        return self.messages
