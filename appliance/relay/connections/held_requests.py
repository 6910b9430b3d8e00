"""Hold the requests of service clients that need an operator's approval until control has decided.

- A request reaches the monitors and the service only after its approval.
- Control gets at most `MOST_OF_HOST` requests of a host at once, because one thread answers all hosts.
- If control ends first, all open requests are refused.
"""

import hashlib
from collections.abc import Callable
from itertools import islice

from appliance.channel.messages import HeldRequestDecided, Message, RequestHeld
from appliance.relay.loop import EventLoop

AWAY = "the appliance's control is not running: this call had no effect"
MOST_OF_HOST = 2
_SHOWN = 4096

Answered = Callable[[str], None]
"""Called with the reason for a refusal, or with an empty string if the request is approved."""


class HeldRequests:
    """The requests that wait for control, at most one for each client."""

    def __init__(self, loop: EventLoop, send: Callable[[Message], None]) -> None:
        self._loop = loop
        self._send = send
        self._connected = False
        self._open: dict[int, tuple[str, Answered]] = {}  # by number: the host, and who waits
        self._queues: dict[str, dict[int, RequestHeld]] = {}  # by host; control has the first ones
        self._number = 0

    def ask(self, caller: tuple[str, str, str], type_: str, body: bytes, answered: Answered) -> int:
        """Return the request's number. `caller` is the service, with the host and name of its client.

        `answered` is called once, in a later turn of the loop, unless the request is forgotten.
        """
        self._number += 1
        number, host, digest = self._number, caller[1], hashlib.sha256(body).hexdigest()
        self._open[number] = host, answered
        if self._connected:
            queue = self._queues.setdefault(host, {})
            queue[number] = RequestHeld(number, *caller, type_, digest, body[:_SHOWN], len(body))
            if len(queue) <= MOST_OF_HOST:
                self._send(queue[number])
        else:
            self._loop.after(0, lambda: self.answered(HeldRequestDecided(number, AWAY)))
        return number

    def forget(self, number: int) -> None:
        host, _answered = self._open.pop(number, ("", None))
        queue = self._queues.get(host, {})
        if number in islice(queue, MOST_OF_HOST):  # its answer will come
            self._open[number] = host, lambda _refused: None
        else:
            queue.pop(number, None)

    def answered(self, answer: HeldRequestDecided) -> None:
        host, waiting = self._open.pop(answer.number, ("", None))
        if waiting is None:
            return
        queue = self._queues.get(host, {})
        if queue.pop(answer.number, None) is not None:
            for wanted in islice(queue.values(), MOST_OF_HOST - 1, MOST_OF_HOST):
                self._send(wanted)
            if not queue:
                del self._queues[host]
        waiting(answer.refused)

    def attach(self, connected: bool) -> None:
        self._connected = connected
        self._queues.clear()
        for number in list(self._open):
            self.answered(HeldRequestDecided(number, AWAY))
