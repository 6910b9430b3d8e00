"""The requests of service clients that need an operator's approval: control decides each of them.

Invariants:
- A request reaches the monitors and the service only after control has approved it.
- A client waits for at most one answer, so the number of open questions is that of clients.
- If control ends first, all open requests are refused.
"""

import hashlib
from collections.abc import Callable

from appliance.channel.messages import ApprovalAnswered, ApprovalWanted, Message
from appliance.relay.loop import EventLoop

AWAY = "the appliance's control is not running: this call had no effect"
_SHOWN = 4096

Answered = Callable[[str], None]
"""Takes why the request is refused; empty: it is approved."""


class CallApprovals:
    """The open questions, which `send` passes to control."""

    def __init__(self, loop: EventLoop, send: Callable[[Message], None]) -> None:
        self._loop = loop
        self._send = send
        self._connected = False
        self._open: dict[int, Answered] = {}
        self._number = 0

    def ask(self, caller: tuple[str, str, str], type_: str, body: bytes, answered: Answered) -> None:
        """Ask control about a request. `caller` is the service, the host and the name of the client.

        `answered` is called once, in a later turn of the loop.
        """
        self._number += 1
        number, digest = self._number, hashlib.sha256(body).hexdigest()
        self._open[number] = answered
        if self._connected:
            self._send(ApprovalWanted(number, *caller, type_, digest, body[:_SHOWN]))
        else:
            self._loop.after(0, lambda: self.answered(ApprovalAnswered(number, AWAY)))

    def answered(self, answer: ApprovalAnswered) -> None:
        """Give control's answer to the client that waits for it."""
        waiting = self._open.pop(answer.number, None)
        if waiting is not None:
            waiting(answer.refused)

    def attach(self, connected: bool) -> None:
        """Refuse all requests that wait for a control that has gone."""
        self._connected = connected
        for number in list(self._open):
            self.answered(ApprovalAnswered(number, AWAY))
