"""What operators can do with the running appliance, over the admin socket and over REST alike.

One core for both: a request of `appliance.channel.admin` in, an answer out. A request is answered by the method that
takes it: of `Looks`, `Policies`, `Monitors`, `Tokens`, `RecordingOrders`, `EvidenceOrders`, or `Hosts` and
its parts. To add a question, write the request and the struct that answers it, and such a method.
"""

import inspect
import typing
from collections.abc import Awaitable, Callable
from typing import Any, NamedTuple

from appliance.base.withdrawal import WithdrawnError, require_awaited
from appliance.channel import admin
from appliance.channel.admin import A
from appliance.control.errors import SenselessError, UnknownThingError
from appliance.control.evidence_orders import EvidenceOrders, NotSealedError
from appliance.control.policies import Policies, PolicyRefusedError, RevisionChangedError
from appliance.control.queries import Looks
from appliance.control.recording_orders import RecorderAwayError, RecordingOrders
from appliance.control.token_orders import TokenRefusedError, Tokens
from appliance.hosts.certification import Certification
from appliance.hosts.checked_ports import CheckedPorts
from appliance.hosts.enrolment import Hosts
from appliance.hosts.host_table import (
    HostForbiddenError,
    HostRefusedError,
    HostsChangedError,
    UnknownHostError,
)
from appliance.hosts.self_service import SelfService
from appliance.master.endpoints.topic_taps_control import TooManyLooksError
from appliance.specifications.specification_files import SpecificationsRefusedError
from appliance.specifications.specifications import (
    DryRunUnderWayError,
    Monitors,
    MonitorsChangedError,
    UnknownMonitorError,
)
from appliance.store.writer_thread import StoreError

# The first that an error is.
_TROUBLES: dict[type[Exception], admin.Trouble] = {
    RevisionChangedError: "conflict",
    HostsChangedError: "conflict",
    UnknownThingError: "unknown",
    SenselessError: "request",
    TooManyLooksError: "busy",
    DryRunUnderWayError: "busy",
    WithdrawnError: "busy",
    UnknownMonitorError: "unknown",
    UnknownHostError: "unknown",
    HostForbiddenError: "forbidden",
    HostRefusedError: "refused",
    TokenRefusedError: "refused",
    RecorderAwayError: "failed",
    NotSealedError: "failed",
    StoreError: "failed",
}
# What must be kept, else it is not begun. Not who is let in no more: he is out at once, and the answer says what is not
# kept. Not recordings: the recorder looks after its own room.
KEPT = (admin.CHANGES | {admin.TokenAdd, admin.HostEnrol, admin.HostRenewItself, admin.HostRenewed}) - {
    admin.HostRevoke, admin.TokenRevoke, admin.RecordNow, admin.RecordingOfMemory, admin.RecordingRemove
}  # fmt: skip
Orders = (
    Policies | Monitors | Tokens | RecordingOrders | EvidenceOrders
    | Hosts | SelfService | CheckedPorts | Certification
)  # fmt: skip
_Method = Callable[..., Awaitable[Any]]


class _Taken(NamedTuple):
    """What takes a request; `wants_who`: it is told who asks; `orders`: it is more than a look."""

    method: _Method
    wants_who: bool
    orders: bool


class Administration:
    """Carries out requests; `durable` waits until what was recorded is on disk, or cannot be.

    `require_room()` raises `StoreError` when the disk takes nothing: what could not be kept is not begun.
    """

    def __init__(
        self,
        looks: Looks,
        *orders: Orders,
        durable: Callable[[], Awaitable[object]],
        require_room: Callable[[], None],
    ) -> None:
        self._looks = looks
        self._durable = durable
        self._require_room = require_room
        self._methods: dict[type, _Taken] = {}
        for part in (looks, *orders):
            for _name, method in inspect.getmembers(part, inspect.iscoroutinefunction):
                kind, names = request_of(method)
                if kind is not None:
                    self._methods[kind] = _Taken(method, "who" in names, part is not looks)

    async def carry_out(self, request: admin.AdminRequest[A], *, who: str) -> admin.AdminAnswer[A]:
        """Do what is asked on behalf of `who` (the name of a token, or `operator` for the admin socket).

        What somebody did is in the audit log when it is answered: who then searches finds it. An order whose client
        gave up is not begun (`appliance/base/withdrawal.py`, which says when one that was begun is withdrawn).
        """
        answer = await self._answer(request, who)
        if self._methods[type(request)].orders:
            await self._durable()
        return answer

    async def _answer(self, request: admin.AdminRequest[A], who: str) -> admin.AdminAnswer[A]:
        method, wants_who, _ = self._methods[type(request)]
        try:
            require_awaited()
            if type(request) in KEPT:
                self._require_room()
            return admin.AdminAnswer(True, await (method(request, who) if wants_who else method(request)))
        except (PolicyRefusedError, SpecificationsRefusedError) as error:
            text = self._in_force(error)
            return admin.AdminAnswer(False, error=text, findings=error.findings, trouble="refused")
        except MonitorsChangedError as error:
            return admin.AdminAnswer(False, error=str(error), trouble="conflict", tag=error.tag)
        except tuple(_TROUBLES) as error:
            return admin.AdminAnswer(False, error=str(error), trouble=_trouble(error))

    def _in_force(self, error: PolicyRefusedError | SpecificationsRefusedError) -> str:
        if isinstance(error, PolicyRefusedError):
            return f"the policy was refused; revision {self._looks.policies.revision} stays in force"
        revision = self._looks.parts.monitors.revision
        return f"refused; revision {revision} of the specifications stays in force"


def request_of(method: _Method) -> tuple[type | None, list[str]]:
    """The request that a method takes, and the names of its parameters; None when it takes none."""
    names = list(inspect.signature(method).parameters)
    kind = typing.get_type_hints(method).get(names[0]) if names else None
    is_request = inspect.isclass(kind) and issubclass(kind, admin.AdminRequest)
    return kind if is_request else None, names


def _trouble(error: Exception) -> admin.Trouble:
    if isinstance(error, HostRefusedError) and error.ours:
        return "failed"
    return next(trouble for kind, trouble in _TROUBLES.items() if isinstance(error, kind))
