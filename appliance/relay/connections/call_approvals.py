"""Hold the requests of service clients that need an operator's approval until control has decided.

- A request reaches the monitors and the service only after its approval.
- Control gets at most `MOST_OF_HOST` requests of a host at once, because one thread answers all hosts.
- If control ends first, all open requests are refused.
"""

import hashlib
from collections.abc import Callable

from appliance.channel.messages import ApprovalAnswered, ApprovalWanted, Message
from appliance.relay.loop import EventLoop

AWAY = "the appliance's control is not running: this call had no effect"
MOST_OF_HOST = 2
_SHOWN = 4096

Answered = Callable[[str], None]
"""Called with the reason for a refusal, or with an empty string if the request is approved."""


class CallApprovals:
    """The requests that wait for control, at most one for each client."""

    def __init__(self, loop: EventLoop, send: Callable[[Message], None]) -> None:
        self._loop = loop
        self._send = send
        self._connected = False
        self._open: dict[int, tuple[str, Answered]] = {}  # by number: the host, and who waits
        self._sent: dict[str, set[int]] = {}  # by host
        self._unsent: dict[str, dict[int, ApprovalWanted]] = {}  # by host, oldest first
        self._number = 0

    def ask(self, caller: tuple[str, str, str], type_: str, body: bytes, answered: Answered) -> int:
        """Return the request's number. `caller` is the service, with the host and name of its client.

        `answered` is called once, in a later turn of the loop, unless the request is forgotten.
        """
        self._number += 1
        number, host, digest = self._number, caller[1], hashlib.sha256(body).hexdigest()
        self._open[number] = host, answered
        if self._connected:
            wanted = ApprovalWanted(number, *caller, type_, digest, body[:_SHOWN], len(body))
            self._unsent.setdefault(host, {})[number] = wanted
            self._send_next(host)
        else:
            self._loop.after(0, lambda: self.answered(ApprovalAnswered(number, AWAY)))
        return number

    def forget(self, number: int) -> None:
        if number not in self._open:
            return
        host, _answered = self._open[number]
        if number in self._sent.get(host, ()):
            self._open[number] = host, lambda _refused: None
        else:
            del self._open[number]
            self._unsent.get(host, {}).pop(number, None)

    def answered(self, answer: ApprovalAnswered) -> None:
        host, waiting = self._open.pop(answer.number, ("", None))
        if waiting is None:
            return
        self._sent.get(host, set()).discard(answer.number)
        self._send_next(host)
        waiting(answer.refused)

    def attach(self, connected: bool) -> None:
        self._connected = connected
        self._sent.clear()
        self._unsent.clear()
        for number in list(self._open):
            self.answered(ApprovalAnswered(number, AWAY))

    def _send_next(self, host: str) -> None:
        sent, unsent = self._sent.setdefault(host, set()), self._unsent.setdefault(host, {})
        while unsent and len(sent) < MOST_OF_HOST:
            number = next(iter(unsent))
            sent.add(number)
            self._send(unsent.pop(number))
        if not unsent:
            del self._unsent[host]
        if not sent:
            del self._sent[host]
