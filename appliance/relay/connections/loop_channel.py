"""A `Channel` served by the relay's loop: messages in, messages out, the end noticed once."""

import os
from collections import deque
from collections.abc import Callable
from typing import Any

import msgspec

from appliance.channel.channel import Channel, ChannelClosedError, ChannelFullError
from appliance.channel.messages import Message
from appliance.relay.loop import READ, WRITE, Loop, Timer


class Link:
    """One end of a lifeline or link. `ended(reason)` is called once, when it is of no use any more.

    A message that is not of the link, or a backlog beyond its limit, ends it as the other end's death does.
    A restatement of thousands of messages is carried out a quantum at a time, so that it delays nothing else.
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
        self._arrived: deque[tuple[Any, tuple[int, ...]]] = deque()
        self._slice: Timer | None = None
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
        """Carry out everything the other end has sent and the loop has not come to yet."""
        if self._live:
            self._take_in()
            while self._arrived:
                self._carry_out()

    def close(self) -> None:
        """Close this end; `ended` is not called."""
        if self._live:
            self._live = False
            self._loop.unwatch(self._channel.fileno())
            self._channel.close()
            if self._slice is not None:
                self._slice.cancel()
            for _message, descriptors in self._arrived:
                for descriptor in descriptors:
                    os.close(descriptor)
            self._arrived.clear()

    def _ready(self, events: int) -> None:
        if events & WRITE:
            try:
                self._channel.flush()
            except ChannelClosedError as error:
                self._end(str(error))
                return
            self._watch()
        if events & ~WRITE:
            self._take_in()
            self._carry_out()

    def _take_in(self) -> None:
        """Read what is there. At the end of the link, what came before it is carried out first."""
        try:
            self._arrived += self._channel.receive()
        except (ChannelClosedError, msgspec.DecodeError) as error:
            while self._arrived:
                self._carry_out()
            self._end(str(error))

    def _carry_out(self) -> None:
        while self._arrived:
            self._received(*self._arrived.popleft())
            if self._loop.over():
                break
        if self._slice is not None:
            self._slice.cancel()
        self._slice = self._loop.after(0, self._carry_out) if self._arrived else None

    def _watch(self) -> None:
        if self._writing != self._channel.pending:
            self._writing = self._channel.pending
            self._loop.change(self._channel.fileno(), READ | WRITE if self._writing else READ)

    def _end(self, reason: str) -> None:
        if self._live:
            self.close()
            self._ended(reason)
