"""One relay process, as control sees it: its link while it is there, and which nodes it was told of."""

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from appliance.channel import messages
from appliance.channel.channel import Channel, ChannelClosedError


class RelayPost:
    """The place of relay `index`. What is sent while nobody is there is stated afresh when somebody is."""

    def __init__(self, index: int) -> None:
        self.index = index
        self.placed: set[str] = set()  # incarnations whose port this relay has
        self._channel: Channel | None = None
        self._epoch = 0

    @property
    def there(self) -> bool:
        """Whether a relay is there."""
        return self._channel is not None

    def attach(
        self,
        channel: Channel,
        received: Callable[[Any, tuple[int, ...]], None],
        lost: Callable[[], None],
    ) -> None:
        """Serve this link from now on; `lost()` is called when it ends before another takes its place."""
        before, self._channel = self._channel, channel
        if before is not None:
            before.close()
        self.placed.clear()

        def closed() -> None:
            if self._channel is channel:
                self._channel = None
                lost()

        channel.attach(asyncio.get_running_loop(), received, closed)

    def send(self, message: messages.Message, descriptors: tuple[int, ...] = ()) -> bool:
        """Tell the relay; False when it is not there."""
        if self._channel is None:
            return False
        try:
            self._channel.send(message, descriptors)
        except ChannelClosedError:
            return False  # its end is reported by the loop
        return True

    @contextmanager
    def restating(self) -> Iterator[None]:
        """What is sent inside is all that the relay is to have."""
        self._epoch += 1
        self.send(messages.StateBegan(self._epoch))
        yield
        self.send(messages.StateEnded(self._epoch))
