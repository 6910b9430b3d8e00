"""Keep the services that features provide (`control/core.py`), for the parts of control that use them."""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import reduce

from appliance.channel import messages
from appliance.control.assembly.current import Provided
from appliance.policy.judgement import PolicyContext
from appliance.policy.model import CallHold, Request

OwnServiceAnswer = Callable[[messages.OwnServiceCalled], Awaitable[messages.OwnServiceAnswered]]


class PolicyServices:
    """The facts that features add to each policy in force."""

    def __init__(self) -> None:
        self.facts: list[Callable[[PolicyContext], PolicyContext]] = []
        self.listeners: list[Callable[[], None]] = []
        self.first: list[Callable[[], None]] = []

    def added_to(self, known: PolicyContext) -> PolicyContext:
        return reduce(lambda known, facts: facts(known), self.facts, known)

    def changed(self) -> None:
        for listener in self.listeners:
            listener()

    def began(self) -> None:
        for begun in self.first:
            begun()


@dataclass(frozen=True)
class HeldCalls:
    """Answers for calls that need an approval.

    `call` holds a call of the Master API, and returns the text for the caller. `request` decides about one
    request to a service.
    """

    call: Callable[[Request], CallHold]
    request: Callable[[messages.RequestHeld], Awaitable[messages.HeldRequestDecided]]


_NOT_HELD = "no operator can approve calls on this appliance"


class CallHolder:
    """Asks the feature that holds calls, if there is one."""

    def __init__(self) -> None:
        self.held: Provided[HeldCalls] = Provided()

    def call(self, request: Request) -> CallHold:
        held = self.held()
        return CallHold(_NOT_HELD, waits=False) if held is None else held.call(request)

    async def request(self, wanted: messages.RequestHeld) -> messages.HeldRequestDecided:
        held = self.held()
        if held is None:
            return messages.HeldRequestDecided(wanted.number, _NOT_HELD)
        return await held.request(wanted)


class OwnServiceTable:
    """The services on the appliance's own node, by the ends of their names."""

    def __init__(self) -> None:
        self.answers: dict[str, OwnServiceAnswer] = {}

    async def called(self, call: messages.OwnServiceCalled) -> messages.OwnServiceAnswered:
        (answer,) = (answer for name, answer in self.answers.items() if call.service.endswith(f"/{name}"))
        return await answer(call)
