"""Keep the services that features provide (`control/core.py`), for the parts of control that use them."""

from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass

from appliance.channel import messages
from appliance.control.assembly.current import Provided
from appliance.policy.model import Address, Request
from appliance.policy.policy import Approval

OwnServiceAnswer = Callable[[messages.OwnServiceCalled], Awaitable[messages.OwnServiceAnswered]]


class PolicyServices:
    """The facts that features add to each policy in force."""

    def __init__(self) -> None:
        self.hosts: list[Callable[[], Mapping[str, Address]]] = []
        self.holders: list[Callable[[], Mapping[str, Address]]] = []
        self.approvals: list[Callable[[], frozenset[Approval]]] = []
        self.listeners: list[Callable[[], None]] = []
        self.first: list[Callable[[], None]] = []

    def all_hosts(self) -> dict[str, Address]:
        return {name: host for hosts in self.hosts for name, host in hosts().items()}

    def all_holders(self) -> dict[str, Address]:
        return {group: host for holders in self.holders for group, host in holders().items()}

    def all_approvals(self) -> frozenset[Approval]:
        return frozenset(approval for approvals in self.approvals for approval in approvals())

    def changed(self) -> None:
        for listener in self.listeners:
            listener()

    def began(self) -> None:
        for begun in self.first:
            begun()


@dataclass(frozen=True)
class HeldCalls:
    """Answers for calls that need an approval.

    `call` holds a call of the Master API, and returns the text for the denied caller. `request` decides about one
    request to a service.
    """

    call: Callable[[Request], str]
    request: Callable[[messages.RequestHeld], Awaitable[messages.HeldRequestDecided]]


_NO_APPROVALS = "no operator can approve calls on this appliance"


class CallHolder:
    """Asks the feature that holds calls, if there is one."""

    def __init__(self) -> None:
        self.held: Provided[HeldCalls] = Provided()

    def call(self, request: Request) -> str:
        held = self.held()
        return _NO_APPROVALS if held is None else held.call(request)

    async def request(self, wanted: messages.RequestHeld) -> messages.HeldRequestDecided:
        held = self.held()
        if held is None:
            return messages.HeldRequestDecided(wanted.number, _NO_APPROVALS)
        return await held.request(wanted)


class OwnServiceTable:
    """The services on the appliance's own node, by the ends of their names."""

    def __init__(self) -> None:
        self.answers: dict[str, OwnServiceAnswer] = {}

    async def called(self, call: messages.OwnServiceCalled) -> messages.OwnServiceAnswered:
        (answer,) = (answer for name, answer in self.answers.items() if call.service.endswith(f"/{name}"))
        return await answer(call)
