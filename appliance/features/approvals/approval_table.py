"""Keep the calls that wait for an approval, and the approvals.

1. A call has one number while it waits, however often its host repeats it. If no operator answered, its repetition
   keeps the number: the operator may have it from the agent. A call with other arguments is another call.
2. An approval of one call is used once, by the same host, for the same service and arguments.
3. A refusal pauses for `WAIT_SECONDS`, and no repetition shortens that.
4. An entry keeps the charged host of its call, even if another one would be charged now.
"""

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple

from appliance.features.approvals.quotas import APPROVALS
from appliance.policy.model import Address, Category
from appliance.policy.policy import Approval, Policy
from appliance.quotas.pool import Pool, QuotaClass
from appliance.store.ends import EndKind, EndTable

_MAX_UNANSWERED = 256
APPROVING = EndKind("approval", stored=False)
WAIT_SECONDS = 120.0
"""How long a call waits for an answer, and how long an approval of one call can be used."""


class ApprovalState(StrEnum):
    WAITS = "waits"
    APPROVED = "approved"
    REFUSED = "refused"


class HeldCall(NamedTuple):
    """A call that needs an approval; `digest` is the SHA-256 of a service's arguments."""

    host: Address
    category: Category
    resource: str
    digest: str = ""

    @property
    def approval(self) -> Approval:
        return self.host, self.category, self.resource


class ChargedHost(NamedTuple):
    """The key of a host's quota: its network in the policy, or its address."""

    network: str
    named: bool

    @classmethod
    def of(cls, policy: Policy, host: Address) -> "ChargedHost":
        return cls(policy.alike(host).removesuffix("/32").removesuffix("/128"), policy.names(host))

    def __str__(self) -> str:
        return self.network


@dataclass(frozen=True, slots=True)
class ApprovalEntry:
    """A held call or an approval."""

    number: int
    call: HeldCall
    charged: ChargedHost
    caller_id: str
    type: str
    arguments: bytes
    """The first bytes of the arguments; `size` is the length of all of them."""
    size: int
    since: float
    """Monotonic seconds."""
    state: ApprovalState = ApprovalState.WAITS
    once: bool = False
    """An approval is for one call; otherwise for all calls of this host and name until its end."""
    who: str = ""
    credentials: frozenset[str] = frozenset()
    """The ids of the approver's tokens and sessions; the approval ends with the last of them."""

    @property
    def for_some_time(self) -> bool:
        return self.state is ApprovalState.APPROVED and not self.once


class ApprovalTable:
    """The held calls and approvals; the first entry has the number `first`."""

    def __init__(
        self, first: int, ends: EndTable, held: Callable[[ApprovalEntry, float], None] = lambda *_entry: None
    ) -> None:
        self._next = first
        self._ends = ends
        self._held = held
        self._entries: dict[int, ApprovalEntry] = {}
        self._by_call: dict[HeldCall, int] = {}
        self._unanswered: OrderedDict[HeldCall, int] = OrderedDict()  # their numbers, oldest first
        self.pool: Pool[ChargedHost] = Pool(
            "waiting calls and approvals",
            APPROVALS.bounds,
            lambda charged: QuotaClass.NAMED if charged.named else QuotaClass.UNKNOWN,
        )

    def entries(self) -> list[ApprovalEntry]:
        return list(self._entries.values())

    def entry(self, number: int) -> ApprovalEntry | None:
        return self._entries.get(number)

    def find(self, call: HeldCall) -> ApprovalEntry | None:
        for one in (call, call._replace(digest="")):
            if (number := self._by_call.get(one)) is not None:
                return self._entries[number]
        return None

    def hold(
        self,
        call: HeldCall,
        charged: ChargedHost,
        now: float,
        *,
        caller_id: str,
        type_: str,
        arguments: bytes,
        size: int,
    ) -> ApprovalEntry | str:
        if refusal := self.pool.take(charged):
            return refusal
        number = self._unanswered.pop(call, 0) or self._next
        entry = ApprovalEntry(number, call, charged, caller_id, type_, arguments, size, now)
        self._next = max(self._next, number + 1)
        self._held(entry, WAIT_SECONDS)
        return self._put(entry, WAIT_SECONDS)

    def approve(
        self,
        entry: ApprovalEntry,
        seconds: float | None,
        who: str,
        now: float,
        *,
        credentials: frozenset[str],
    ) -> ApprovalEntry:
        """Approve one call (`seconds` is None), or all calls of its host and name for some seconds.

        The caller has ended the entries that the latter covers.
        """
        call = entry.call if seconds is None else entry.call._replace(digest="")
        self._by_call.pop(entry.call, None)
        return self._put(
            replace(
                entry,
                call=call,
                since=entry.since if entry.for_some_time else now,
                state=ApprovalState.APPROVED,
                once=seconds is None,
                who=who,
                credentials=credentials,
            ),
            WAIT_SECONDS if seconds is None else seconds,
        )

    def equal_entries(self, entry: ApprovalEntry) -> list[ApprovalEntry]:
        """Return the other entries of the same host and name."""
        return [
            one
            for one in self._entries.values()
            if one.number != entry.number and one.call.approval == entry.call.approval
        ]

    def refuse(self, entry: ApprovalEntry, who: str) -> ApprovalEntry:
        return self._put(replace(entry, state=ApprovalState.REFUSED, who=who), WAIT_SECONDS)

    def seconds_left(self, entry: ApprovalEntry) -> float:
        return self._ends.time_left(APPROVING, str(entry.number)) or 0.0

    def end_unanswered(self, entry: ApprovalEntry) -> None:
        """End a call that no operator answered, and keep its number for a repetition."""
        self.end(entry)
        self._unanswered[entry.call] = entry.number
        while len(self._unanswered) > _MAX_UNANSWERED:
            self._unanswered.popitem(last=False)

    def forget_unanswered(self, asks: Callable[[HeldCall], bool]) -> None:
        """Forget the numbers of calls about which the policy no longer asks."""
        for call in [call for call in self._unanswered if not asks(call)]:
            del self._unanswered[call]

    def end(self, entry: ApprovalEntry) -> None:
        if self._entries.pop(entry.number, None) is not None:
            self._by_call.pop(entry.call, None)
            self._ends.forget(APPROVING, str(entry.number))
            self.pool.give_back(entry.charged)

    def approvals(self) -> frozenset[Approval]:
        """Return the approvals for some time on topics and parameters. Calls of services are decided one by one."""
        return frozenset(
            entry.call.approval
            for entry in self._entries.values()
            if entry.for_some_time and entry.call.category is not Category.CALL
        )

    def _put(self, entry: ApprovalEntry, seconds: float) -> ApprovalEntry:
        self._ends.set(APPROVING, str(entry.number), seconds)
        self._entries[entry.number] = entry
        self._by_call[entry.call] = entry.number
        return entry
