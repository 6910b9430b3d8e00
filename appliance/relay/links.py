"""A `Channel` served by the relay's loop: messages in, messages out, the end noticed once."""

from collections.abc import Callable
from typing import Any

import msgspec

from appliance.channel.channel import Channel, ChannelClosedError, ChannelFullError
from appliance.channel.messages import Message
from appliance.relay.loop import READ, WRITE, Loop


class Link:
    """One end of a lifeline or link. `ended(reason)` is called once, when it is of no use any more.

    A message that is not of the link, or a backlog beyond its limit, ends it as the other end's death does.
    """

    def __init__(
        self,
        loop: Loop,
        channel: Channel,
        received: Callable[[Any, tuple[int, ...]], None],
        ended: Callable[[str], None],
    ) -> None:
        self._loop = loop
        self._channel = channel
        self._received = received
        self._ended = ended
        self._writing = False
        self._live = True
        loop.watch(channel.fileno(), READ, self._ready)

    def send(self, message: Message) -> None:
        """Send now, or when the other end reads; nothing is sent after the end."""
        if not self._live:
            return
        try:
            self._channel.send(message)
        except (ChannelClosedError, ChannelFullError) as error:
            self._end(str(error))
        else:
            self._watch()

    def catch_up(self) -> None:
        """Carry out what the other end has sent and the loop has not come to yet."""
        if self._live:
            self._ready(READ)

    def close(self) -> None:
        """Close this end; `ended` is not called."""
        if self._live:
            self._live = False
            self._loop.unwatch(self._channel.fileno())
            self._channel.close()

    def _ready(self, events: int) -> None:
        try:
            if events & WRITE:
                self._channel.flush()
            messages = self._channel.receive() if events & ~WRITE else []
        except (ChannelClosedError, msgspec.DecodeError) as error:
            self._end(str(error))
            return
        self._watch()
        for message, descriptors in messages:
            self._received(message, descriptors)

    def _watch(self) -> None:
        if self._writing != self._channel.pending:
            self._writing = self._channel.pending
            self._loop.change(self._channel.fileno(), READ | WRITE if self._writing else READ)

    def _end(self, reason: str) -> None:
        self.close()
        self._ended(reason)
