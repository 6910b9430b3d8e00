"""Collect the measurements of control. The api formats them for Prometheus."""

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import TypeVar

from appliance.channel.answers.host_answers import Host
from appliance.channel.answers.measures import Measures
from appliance.channel.answers.status import Status
from appliance.control.assembly.assembly import Parts
from appliance.master.endpoints.traffic import MOST_RESOURCES, OTHERS, RelayTraffic, Traffic
from appliance.master.graph.registry import Life
from appliance.policy.model import Category
from appliance.specifications.records import KINDS
from appliance.telemetry.audit_trail import Meter

MOST_DELAYED = 200  # the most topics that have their own histogram

_Labels = tuple[str, str]
_Number = TypeVar("_Number", int, float)
_DECISIONS = tuple(
    (category.value, outcome) for category in Category for outcome in ("allow", "deny", "would deny", "ask")
)


def measures_of(
    parts: Parts, meter: Meter, status: Status, hosts: list[Host], queued_deliveries: int
) -> Measures:
    """Return the measurements; all but `MOST_RESOURCES` topics and services are summed in `OTHERS`.

    For histograms, the limit is `MOST_DELAYED`.
    """
    lives = Counter(incarnation.life for incarnation in parts.core.registry.all() if not incarnation.own)
    kinds = Counter(
        registration.kind.value for node, registration in parts.core.registry.in_order() if not node.own
    )
    records = parts.monitors.records
    carried = parts.core.carried
    relayed, delayed = carried_of(carried)
    done = from_zero(records.counts, ((kind, name) for name in parts.monitors.names() for kind in KINDS))
    return Measures(
        status=status,
        hosts=hosts,
        queued_deliveries=queued_deliveries,
        decisions=[(*labels, count) for labels, count in from_zero(meter.decisions, _DECISIONS).items()],
        decision_seconds=meter.decision_seconds.values(),
        calls=[(call, histogram.values()) for call, histogram in meter.calls.items()],
        nodes={"live": lives[Life.LIVE], "lost": lives[Life.SHADOW]},
        registrations=dict(kinds),
        relayed=relayed,
        delayed=delayed,
        monitors=[(*labels, count) for labels, count in done.items()],
        slices={
            name: (row.slices, row.slice_limit)
            for name, row in parts.monitors.rollout.rows.items()
            if row.slice_limit
        },
        drop_at=_at(records.at, "drop"),
        change_at=_at(records.at, "change"),
        limited=[(*labels, count) for labels, count in carried.limited_messages.items()],
        memory={
            what: sum(held.get(what, 0) for held in carried.memory.values())
            for what in ("frames", "queues", "latched", "headers")
        },
        connections=dict(Counter(connection.kind for connection in carried.connections.values())),
    )


def _at(counts: Mapping[_Labels, int], kind: str) -> dict[str, int]:
    sums = by_resource((resource, (count,)) for (what, resource), count in counts.items() if what == kind)
    return {resource: count for resource, (count,) in sums.items()}


def carried_of(carried: RelayTraffic) -> tuple[dict[str, list[int]], dict[str, list[float]]]:
    rows: list[tuple[str, Traffic]] = [*carried.past.items()]
    rows += [(resource, traffic) for (_key, resource), traffic in carried.traffic.items()]
    return by_resource((name, (row.messages, row.bytes, row.dropped)) for name, row in rows), by_resource(
        ((name, (*row.delays, row.delay_seconds)) for name, row in rows if row.delays), MOST_DELAYED
    )


def from_zero(counts: Mapping[_Labels, int], expected: Iterable[_Labels]) -> dict[_Labels, int]:
    """Add 0 for events that have not happened yet, because a Prometheus counter must start at 0."""
    return dict.fromkeys(expected, 0) | dict(counts)


def by_resource(
    rows: Iterable[tuple[str, tuple[_Number, ...]]], most: int = MOST_RESOURCES
) -> dict[str, list[_Number]]:
    sums: dict[str, list[_Number]] = {}
    for resource, values in rows:
        name = resource if resource in sums or len(sums) < most else OTHERS
        row = sums.setdefault(name, [0] * len(values))
        for place, more in enumerate(values):
            row[place] += more
    return sums
