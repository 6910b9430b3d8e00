"""Read the requests of a period that passed, and say which of them the log no longer names."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice

from appliance.audit.log.log_database import LogUnreadableError
from appliance.audit.log.record import AuditRecord
from appliance.audit.log.repetition import KIND, PARAMETERS, repetitions
from appliance.audit.search.query import Filter, FilterError
from appliance.base import clock
from appliance.base.timestamps import TimestampError, parse_timestamp
from appliance.cli.connection.admin_client import NotRunningError
from appliance.cli.connection.target import Appliance
from appliance.features.policy_tools.learn import Observation
from appliance.features.policy_tools.policy_input import request_of, usage_error
from appliance.policy.model import Category

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

    appliance: Appliance
    since: int | None
    start: int
    removed: bool
    unnamed: dict[str, int] = field(default_factory=dict)

    def requests(self) -> Iterator[RecordedRequest]:
        """Yield the requests by the kinds of their records, and fill `unnamed`. Exits if the log is unreadable."""
        self.unnamed.clear()
        try:
            for event in _EVENTS:
                passed = Filter(decision=("allow", "would deny"), event=event, since=self.since)
                for entry in self.appliance.audit().export(passed):
                    yield from self._of(entry.record)
        except (LogUnreadableError, NotRunningError, FilterError) as error:
            raise usage_error(str(error)) from error

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


def recorded_period(appliance: Appliance, since: str | None) -> RecordedPeriod:
    """Return the period since a time, or all of the log. Exits with usage errors, and if the log is unreadable."""
    try:
        asked = None if since is None else parse_timestamp(since, clock.wall_ns(), None)
        first = next(islice(appliance.audit().export(Filter()), 1), None)
    except (LogUnreadableError, NotRunningError, TimestampError, FilterError) as error:
        raise usage_error(str(error)) from error
    if first is None:
        return RecordedPeriod(appliance, asked, asked or clock.wall_ns(), removed=False)
    start = max(first.record.time, asked or first.record.time)
    removed = first.sequence > 1 and (asked is None or first.record.time > asked)
    return RecordedPeriod(appliance, asked, start, removed)
