"""Keep the services that features provide (`control/core.py`), for the parts of control that use them."""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from appliance.channel import messages
from appliance.policy.model import CallHold, Request

T = TypeVar("T")


class Provided(Generic[T]):
    """A service that at most one feature provides."""

    def __init__(self) -> None:
        self._service: T | None = None

    def provide(self, service: T) -> None:
        """Raises `RuntimeError` if another feature provides the service."""
        if self._service is not None:
            raise RuntimeError("two features provide the same service of control")
        self._service = service

    def __call__(self) -> T | None:
        return self._service


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
