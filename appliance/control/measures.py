"""What control measures, in plain values: for the api, which makes Prometheus's format of it."""

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

from appliance.control.assembly import Parts
from appliance.master.graph.registry import Life
from appliance.master.reach.carried import MOST_RESOURCES, OTHERS, Carried, Traffic
from appliance.policy.model import Category
from appliance.specifications.observed import KINDS

MOST_DELAYED = 200  # topics with a histogram of their own

_Labels = tuple[str, str]
_DECISIONS = tuple(
    (category.value, outcome) for category in Category for outcome in ("allow", "deny", "would deny")
)


def measures_of(parts: Parts) -> dict[str, Any]:
    """Counters of requests, and the state of registry and relay at this moment.

    Topics and services are named as far as `MOST_RESOURCES` goes (histograms: `MOST_DELAYED`): who registers names
    without end fills `OTHERS`.
    """
    lives = Counter(one.life for one in parts.registry.all() if not one.own)
    kinds = Counter(one.kind.value for node, one in parts.registry.in_order() if not node.own)
    records = parts.monitors.records
    values = parts.recorder.meter.values()
    decided = {(category, outcome): count for category, outcome, count in values["decisions"]}
    return {
        **values,
        "decisions": [[*labels, count] for labels, count in from_zero(decided, _DECISIONS).items()],
        "nodes": {"live": lives[Life.LIVE], "lost": lives[Life.SHADOW]},
        "registrations": dict(kinds),
        **carried_of(parts.relay.carried),
        "monitors": [
            [kind, name, count]
            for (kind, name), count in from_zero(
                records.counts, ((kind, name) for name in parts.monitors.names() for kind in KINDS)
            ).items()
        ],
        **{
            f"{kind}_at": by_resource(
                (resource, (count,)) for (what, resource), count in records.at.items() if what == kind
            )
            for kind in ("drop", "change")
        },
        "limited": [[*labels, count] for labels, count in parts.relay.carried.limited_messages.items()],
        "memory": {
            what: sum(held.get(what, 0) for held in parts.relay.carried.memory.values())
            for what in ("frames", "queues", "latched", "headers")
        },
        "connections": dict(Counter(one.kind for one in parts.relay.connections.values())),
    }


def carried_of(carried: Carried) -> dict[str, dict[str, list[float]]]:
    """What went through each topic and service since control started, and how late; all incarnations together."""
    rows: list[tuple[str, Traffic]] = [*carried.past.items()]
    rows += [(resource, traffic) for (_key, resource), traffic in carried.traffic.items()]
    return {
        "relayed": by_resource((name, (one.messages, one.bytes, one.dropped)) for name, one in rows),
        "delayed": by_resource(
            ((name, (*one.delays, one.delay_seconds)) for name, one in rows if one.delays), MOST_DELAYED
        ),
    }


def from_zero(counts: Mapping[_Labels, int], expected: Iterable[_Labels]) -> dict[_Labels, int]:
    """The counts, those that did not happen yet as 0: Prometheus sees no increase where a counter only begins."""
    return dict.fromkeys(expected, 0) | dict(counts)


def by_resource(
    rows: Iterable[tuple[str, tuple[float, ...]]], most: int = MOST_RESOURCES
) -> dict[str, list[float]]:
    """The sums of each resource's rows; of the first `most` by name, of all others together."""
    sums: dict[str, list[float]] = {}
    for resource, values in rows:
        name = resource if resource in sums or len(sums) < most else OTHERS
        row = sums.setdefault(name, [0] * len(values))
        for place, more in enumerate(values):
            row[place] += more
    return sums
