"""The lifeline and the link to control, for all children that serve control."""

import asyncio
import os
import socket
from collections.abc import Callable

from appliance.channel.channel import Channel, ChannelClosedError, ChannelFullError
from appliance.channel.link import Link
from appliance.channel.messages import Failed, LinkOpened, MemoryGiven, Message, Ping, Pong, Ready, Stop


class Child:
    """A child's loop. It ends when the supervisor sends `Stop` or is gone."""

    def __init__(
        self,
        lifeline: Channel,
        link: object,
        *,
        said: Callable[[Message], None],
        linked: Callable[[], None] = lambda: None,
        lost: Callable[[str], None] = lambda _reason: None,
        took: Callable[[Message, tuple[int, ...]], None] | None = None,
        memory_given: Callable[[MemoryGiven, int], None] = lambda _given, descriptor: os.close(descriptor),
    ) -> None:
        """`link` is the union of the messages on the link to control.

        `lost(reason)` is called when control closes the link or ends. `took(message, descriptors)` gets control's
        messages with descriptors. `memory_given` takes over the descriptor.
        """
        self._lifeline = lifeline
        self._link = link
        self._linked = linked
        self._memory_given = memory_given
        self._control = Link(said, lost, took)
        self.ended = asyncio.Event()
        self.stopped = False
        """Whether the supervisor ended this process because the whole appliance is stopped by order."""

    def attach(self, ready: Ready) -> None:
        self._lifeline.attach(asyncio.get_running_loop(), self._supervisor_said, self.ended.set)
        self._answer(ready)

    def tell(self, message: Message) -> bool:
        """Send a message to control; return False if there is no link.

        If control does not read, close the link: control asks again over its next link.
        """
        try:
            return self._control.send(message)
        except ChannelFullError:
            self._control.close()
            return False

    def fail(self, reason: str, output: list[str]) -> None:
        """Report that this process cannot serve; `output` has the last lines of the program that it ran."""
        self._answer(Failed(reason, output))

    def close(self) -> None:
        self._control.close()

    def _supervisor_said(self, message: Message, descriptors: tuple[int, ...]) -> None:
        match message:
            case Ping(number):
                self._answer(Pong(number))
            case Stop(failed):
                self.stopped = not failed
                self.ended.set()
            case LinkOpened(role="control"):
                self._control.attach(Channel(socket.socket(fileno=descriptors[0]), self._link))
                self._linked()
            case MemoryGiven():
                self._memory_given(message, descriptors[0])
            case _:
                for descriptor in descriptors:
                    os.close(descriptor)

    def _answer(self, message: Message) -> None:
        try:
            self._lifeline.send(message)
        except ChannelClosedError:
            self.ended.set()  # the supervisor is gone
