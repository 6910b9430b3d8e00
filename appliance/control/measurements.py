"""What control measures, for the api, which makes Prometheus's format of it."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from itertools import islice
from typing import TypeVar

from appliance.channel.answers.host_answers import Host
from appliance.channel.answers.measures import Measures
from appliance.channel.answers.status import Status
from appliance.channel.messages import MonitorRow
from appliance.control.assembly import Parts
from appliance.master.endpoints.traffic import MOST_RESOURCES, OTHERS, Carried, Traffic
from appliance.master.graph.registry import Life
from appliance.policy.model import Category
from appliance.specifications.records import KINDS

MOST_DELAYED = 200  # topics with a histogram of their own
MOST_MARGINS = 1000  # series

_Labels = tuple[str, str]
_Number = TypeVar("_Number", int, float)
_DECISIONS = tuple(
    (category.value, outcome) for category in Category for outcome in ("allow", "deny", "would deny")
)


def measures_of(parts: Parts, status: Status, hosts: list[Host], queued_deliveries: int) -> Measures:
    """Counters of requests, and the state of registry and relay at this moment, beside the status.

    Topics and services are named as far as `MOST_RESOURCES` goes (histograms: `MOST_DELAYED`): who registers names
    without end fills `OTHERS`.
    """
    lives = Counter(incarnation.life for incarnation in parts.registry.all() if not incarnation.own)
    kinds = Counter(
        registration.kind.value for node, registration in parts.registry.in_order() if not node.own
    )
    records = parts.monitors.records
    meter, carried = parts.trail.meter, parts.relay.carried
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
        margins=list(islice(_margins(parts.monitors.rollout.rows), MOST_MARGINS)),
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
        connections=dict(Counter(connection.kind for connection in parts.relay.carried.connections.values())),
    )


def _margins(rows: Mapping[str, MonitorRow]) -> Iterator[tuple[str, str, bool, float]]:
    """The closest approach of the day of each comparison that came up."""
    for name, row in rows.items():
        for margin in row.margins:
            if margin.today is not None:
                yield name, f"{margin.line}:{margin.column}", margin.holds, margin.today.distance


def _at(counts: Mapping[_Labels, int], kind: str) -> dict[str, int]:
    """How often that happened, by resource."""
    sums = by_resource((resource, (count,)) for (what, resource), count in counts.items() if what == kind)
    return {resource: count for resource, (count,) in sums.items()}


def carried_of(carried: Carried) -> tuple[dict[str, list[int]], dict[str, list[float]]]:
    """What went through each topic and service since control started, and how late; all incarnations together."""
    rows: list[tuple[str, Traffic]] = [*carried.past.items()]
    rows += [(resource, traffic) for (_key, resource), traffic in carried.traffic.items()]
    return by_resource((name, (row.messages, row.bytes, row.dropped)) for name, row in rows), by_resource(
        ((name, (*row.delays, row.delay_seconds)) for name, row in rows if row.delays), MOST_DELAYED
    )


def from_zero(counts: Mapping[_Labels, int], expected: Iterable[_Labels]) -> dict[_Labels, int]:
    """The counts, those that did not happen yet as 0: Prometheus sees no increase where a counter only begins."""
    return dict.fromkeys(expected, 0) | dict(counts)


def by_resource(
    rows: Iterable[tuple[str, tuple[_Number, ...]]], most: int = MOST_RESOURCES
) -> dict[str, list[_Number]]:
    """The sums of each resource's rows; of the first `most` by name, of all others together."""
    sums: dict[str, list[_Number]] = {}
    for resource, values in rows:
        name = resource if resource in sums or len(sums) < most else OTHERS
        row = sums.setdefault(name, [0] * len(values))
        for place, more in enumerate(values):
            row[place] += more
    return sums
