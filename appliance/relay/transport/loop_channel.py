"""A `Channel` served by the relay's loop."""

import os
from collections import deque
from collections.abc import Callable

from appliance.channel.channel import AGAIN_SECONDS, Channel, ChannelClosedError
from appliance.channel.messages import Message
from appliance.relay.loop import READ, WRITE, EventLoop, LoopTimer


class LoopLink:
    """One end of a lifeline or link. `ended(reason)` is called once, when the link fails.

    A message of another link ends the link as if the other end had died. A restatement is carried out one quantum at a
    time. If `received` returns True, that message and later ones wait for
    `go_on`, and nothing more is read until then.
    """

    def __init__(
        self,
        loop: EventLoop,
        channel: Channel,
        received: Callable[[Message, tuple[int, ...]], bool | None],
        ended: Callable[[str], None],
    ) -> None:
        self._loop = loop
        self._channel = channel
        self._received = received
        self._ended = ended
        self._events = READ
        self._live = True
        self._waits = False
        self._end_of_link: str | None = None  # the reason, once the link has ended
        self._arrived: deque[tuple[Message, tuple[int, ...]]] = deque()
        self._slice: LoopTimer | None = None
        self._again: LoopTimer | None = None  # the next attempt of a write that the kernel refused
        loop.watch(channel.fileno(), READ, self._ready)

    def send(self, message: Message) -> None:
        """Send a message. Raises `ChannelFullError`: a link that only this end gave up would not be opened again."""
        if not self._live:
            return
        try:
            self._channel.send(message)
        except ChannelClosedError as error:
            self._end(str(error))
        else:
            self._watch()

    def catch_up(self) -> None:
        if self._live and not self._waits:
            if self._end_of_link is None:
                self._take_in()
            self._finish()

    def go_on(self) -> None:
        if self._waits:
            self._waits = False
            self._watch()
            self.catch_up()

    def close(self) -> None:
        if self._live:
            self._live = False
            self._loop.unwatch(self._channel.fileno())
            self._channel.close()
            for timer in filter(None, (self._slice, self._again)):
                timer.cancel()
            for _message, descriptors in self._arrived:
                for descriptor in descriptors:
                    os.close(descriptor)
            self._arrived.clear()

    def _ready(self, events: int) -> None:
        if events & WRITE:
            self._flush()
        if events & ~WRITE and self._live:
            self._take_in()
            self._carry_out()

    def _flush(self) -> None:
        self._again = None
        try:
            self._channel.flush()
        except ChannelClosedError as error:
            self._end(str(error))
        else:
            self._watch()

    def _take_in(self) -> None:
        """Receive messages; if the link has ended, carry out all that arrived before reporting it."""
        try:
            self._arrived += self._channel.receive()
        except (ChannelClosedError, ValueError) as error:
            self._end_of_link = str(error)
            self._loop.unwatch(self._channel.fileno())
            self._finish()

    def _carry_out(self) -> None:
        while self._arrived and not self._waits:
            arrived = self._arrived.popleft()
            if self._received(*arrived):
                self._arrived.appendleft(arrived)
                self._waits = True
                self._watch()
            if self._loop.over():
                break
        if self._slice is not None:
            self._slice.cancel()
        more = self._arrived and not self._waits
        self._slice = self._loop.after(0, self._carry_out) if more else None

    def _finish(self) -> None:
        while self._arrived and not self._waits:
            self._carry_out()
        if self._end_of_link is not None and not self._arrived:
            self._end(self._end_of_link)

    def _watch(self) -> None:
        if self._channel.delayed and self._again is None:
            self._again = self._loop.after(AGAIN_SECONDS, self._flush)
        writes = self._channel.pending and not self._channel.delayed
        events = (0 if self._waits else READ) | (WRITE if writes else 0)
        if events != self._events and self._end_of_link is None:
            self._events = events
            self._loop.change(self._channel.fileno(), events)

    def _end(self, reason: str) -> None:
        if self._live:
            self.close()
            self._ended(reason)
