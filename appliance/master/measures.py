"""What control measures, in plain values: for the api, which makes Prometheus's format of it."""

from collections import Counter
from typing import Any

from appliance.master.core import Master
from appliance.master.registry import Life


def measures_of(master: Master) -> dict[str, Any]:
    """Counters of requests, and the state of registry and relay at this moment."""
    lives = Counter(one.life for one in master.registry.all() if not one.own)
    kinds = Counter(one.kind.value for node, one in master.registry.in_order() if not node.own)
    relayed: dict[str, list[int]] = {}
    for (_key, resource), traffic in master.relay.traffic.items():
        row = relayed.setdefault(resource, [0, 0, 0])
        for place, more in enumerate((traffic.messages, traffic.bytes, traffic.dropped)):
            row[place] += more
    return {
        **master.recorder.meter.values(),
        "nodes": {"live": lives[Life.LIVE], "lost": lives[Life.SHADOW]},
        "registrations": dict(kinds),
        "relayed": relayed,
        "monitors": [[kind, name, count] for (kind, name), count in master.monitors.records.counts.items()],
        "connections": dict(Counter(one.kind for one in master.relay.connections.values())),
    }
