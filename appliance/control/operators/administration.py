"""Carry out operators' orders and queries, from the admin socket and from REST."""

from collections.abc import Awaitable, Callable, Iterable
from typing import Any

from appliance.base.withdrawal import WithdrawnError, require_awaited
from appliance.channel import admin
from appliance.channel.admin import A
from appliance.channel.channel import ChannelFullError
from appliance.channel.operations import ORDERS
from appliance.control.assembly.policies import RevisionChangedError
from appliance.control.errors import (
    PolicyRefusedError,
    SenselessError,
    TokenRefusedError,
    UnavailableError,
    UnknownThingError,
)
from appliance.control.operators.request_method import RequestMethod
from appliance.hosts.host_table import (
    HostForbiddenError,
    HostRefusedError,
    HostsChangedError,
    UnknownHostError,
)
from appliance.master.endpoints.topic_taps_control import TooManyTapsError
from appliance.specifications.specification_files import MonitorsChangedError, SpecificationsRefusedError
from appliance.specifications.specification_manager import (
    DryRunUnderWayError,
    UnknownMonitorError,
)
from appliance.store.writer_thread import StoreError

# The first matching exception class is used.
_TROUBLES: dict[type[Exception], admin.Trouble] = {
    RevisionChangedError: "conflict",
    HostsChangedError: "conflict",
    UnknownThingError: "unknown",
    SenselessError: "request",
    TooManyTapsError: "busy",
    DryRunUnderWayError: "busy",
    WithdrawnError: "busy",
    UnknownMonitorError: "unknown",
    UnknownHostError: "unknown",
    HostForbiddenError: "forbidden",
    HostRefusedError: "refused",
    TokenRefusedError: "refused",
    UnavailableError: "failed",
    StoreError: "failed",
    ChannelFullError: "failed",
}
# Requests that are rejected if the store or the audit log cannot be written, except rows with `full_disk`: a block or
# revocation takes effect at once, and its answer reports if it was not stored. The recorder checks its own disk space.
# A full disk is a reason to switch over.
KEPT = ORDERS | {admin.TokenAdd, admin.TokenRotate}


class Administration:
    """Carries out requests. `require_room()` guards requests in `KEPT` without `full_disk`, and so does the trail.

    `obstacle()` returns why nothing can be recorded, and so granted, now, or None. `in_force` returns the revisions of
    the policy and of the specifications.
    """

    def __init__(
        self,
        methods: Iterable[RequestMethod[object]],
        *,
        in_force: Callable[[], tuple[int, int]],
        durable: Callable[[], Awaitable[object]],
        require_room: Callable[[], None],
        obstacle: Callable[[], str | None],
    ) -> None:
        self._revisions = in_force
        self._durable = durable
        self._require_room = require_room
        self._obstacle = obstacle
        self._methods = {method.request: method for method in methods}

    async def carry_out(self, request: admin.AdminRequest[A], *, who: str) -> admin.AdminAnswer[A]:
        """Carry out a request of `who`: the name of a token, or `operator` for the admin socket.

        The records of an order are in the audit log before the answer, so that a later search finds them.
        """
        method = self._methods.get(type(request))
        if method is None:
            error = f"{admin.verb_of(request)}: this appliance lacks the feature that answers this request"
            return admin.AdminAnswer(False, error=error, trouble="unknown")
        answer = await self._answer(method, request, who)
        if method.order:
            await self._durable()
        return answer

    async def _answer(
        self, method: RequestMethod[Any], request: admin.AdminRequest[A], who: str
    ) -> admin.AdminAnswer[A]:
        try:
            require_awaited()
            if method.request in KEPT and not method.full_disk:
                self._require_room()
                if (obstacle := self._obstacle()) is not None:
                    raise UnavailableError(obstacle)
            return admin.AdminAnswer(True, await method.answer(request, *([who] if method.who else [])))
        except (PolicyRefusedError, SpecificationsRefusedError) as error:
            text = self._in_force(error)
            return admin.AdminAnswer(False, error=text, findings=error.findings, trouble="refused")
        except MonitorsChangedError as error:
            return admin.AdminAnswer(False, error=str(error), trouble="conflict", tag=error.tag)
        except tuple(_TROUBLES) as error:
            return admin.AdminAnswer(False, error=str(error), trouble=_trouble(error))

    def _in_force(self, error: PolicyRefusedError | SpecificationsRefusedError) -> str:
        policy, specifications = self._revisions()
        if isinstance(error, PolicyRefusedError):
            return f"the policy was rejected; revision {policy} stays in force"
        return f"rejected; revision {specifications} of the specifications stays in force"


def _trouble(error: Exception) -> admin.Trouble:
    if isinstance(error, HostRefusedError) and error.ours:
        return "failed"
    return next(trouble for kind, trouble in _TROUBLES.items() if isinstance(error, kind))
