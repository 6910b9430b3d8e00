"""Read the requests of a period that passed, and say which of them the log no longer names."""

import ipaddress
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from typing import TypeAlias

from appliance.audit.log.record import AuditRecord
from appliance.audit.log.record_format import LogEntry
from appliance.audit.log.repetition import KIND, PARAMETERS, repetitions
from appliance.audit.search.query import Filter
from appliance.features.policy_tools.learn import Observation
from appliance.policy.host_sets import canonical_address
from appliance.policy.model import Category, Request

ReadRecords: TypeAlias = Callable[[Filter], Iterator[LogEntry]]
"""Returns the records found, oldest first."""

ADOPTED = "adopted"
"""The event of a registration that was taken over from a ROS master, not made by the node itself."""
_EVENTS = ("decision", ADOPTED, "repetitions folded", "denials folded")
_OWN_NODE = "the appliance's own node"
_OWN_TOOLS = "/rosrv_"
"""The names of the nodes of our own tools begin so."""


@dataclass(frozen=True, slots=True)
class RecordedRequest:
    """A request that passed. `repeated`: further ones like a request that has a record of its own."""

    observation: Observation
    count: int
    repeated: bool


@dataclass(frozen=True)
class RecordedPeriod:
    """The requests of the log since a time, or all of them. Times are nanoseconds since the epoch.

    `start` is when the log's part of the period begins. `removed`: earlier records of the period are removed.
    `unnamed` has, for each host, the number of requests that passed and that the log only counts together with others
    of other names; `*` stands for several hosts.
    """

    read: ReadRecords
    since: int | None
    start: int
    removed: bool
    unnamed: dict[str, int] = field(default_factory=dict)

    def requests(self) -> Iterator[RecordedRequest]:
        """Yield the requests by the kinds of their records, and fill `unnamed`. Raises what `read` raises."""
        self.unnamed.clear()
        for event in _EVENTS:
            passed = Filter(decision=("allow", "would deny"), event=event, since=self.since)
            for entry in self.read(passed):
                yield from self._of(entry.record)

    def _of(self, record: AuditRecord) -> Iterator[RecordedRequest]:
        detail, caller = record.detail, record.caller_id or ""
        if record.reason == _OWN_NODE or caller.startswith(_OWN_TOOLS):
            return
        scope = detail.get("scope", KIND)
        if scope != KIND:
            host = record.host or "*"
            self.unnamed[host] = self.unnamed.get(host, 0) + repetitions(detail)
            return
        if record.host is None or record.category not in set(Category):
            return
        request = request_of(record.host, caller, str(record.category), record.resource or "")
        call, approval, adopted = str(detail.get("call", "")), "approval" in detail, record.event == ADOPTED
        names = detail.get(PARAMETERS)
        if names is not None:  # reads that this record only counts
            for name, count in names.items():
                yield RecordedRequest(
                    Observation(request, call, str(name), approval, adopted), count, repeated=False
                )
            return
        repeated = record.event not in ("decision", ADOPTED)
        observation = Observation(request, call, str(detail.get("key", "")), approval, adopted)
        yield RecordedRequest(observation, repetitions(detail) if repeated else 1, repeated)


def period_since(read: ReadRecords, since: int | None, now: int) -> RecordedPeriod:
    """Return the period since a time, or all of the log; an empty log begins `now`. Raises what `read` raises."""
    first = next(islice(read(Filter()), 1), None)
    if first is None:
        return RecordedPeriod(read, since, now if since is None else since, removed=False)
    start = max(first.record.time, since or first.record.time)
    removed = first.sequence > 1 and (since is None or first.record.time > since)
    return RecordedPeriod(read, since, start, removed)


def request_of(host: str, caller_id: str, category: str, resource: str) -> Request:
    address = canonical_address(ipaddress.ip_address(host))
    return Request(address, str(caller_id or ""), Category(category), str(resource))
