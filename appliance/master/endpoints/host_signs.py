"""Find signs of life of a robot's hosts."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from appliance.base import clock
from appliance.master.endpoints.traffic import RelayTraffic, Traffic
from appliance.master.graph.registry import Kind, Registry
from appliance.policy.model import Address


@dataclass(frozen=True, slots=True)
class HostSigns:
    """A host's signs of life: `live` returns whether it has a live node, `moved` the last publication's time or 0.

    `publishers` returns the host and the name of each of the robot's nodes that publishes a topic. `silence` returns
    the seconds since a time in which the host published nothing; without those in which no relay heard its publishers.
    """

    live: Callable[[Address], bool]
    moved: Callable[[Address, frozenset[str]], float]
    publishers: Callable[[str], list[tuple[Address, str]]] = lambda _topic: []
    silence: Callable[[Address, frozenset[str], float], float] = lambda _host, _names, since: (
        clock.now() - since
    )


def host_signs(registry: Registry, carried: RelayTraffic) -> HostSigns:
    def live(host: Address) -> bool:
        return any(node.host == host for node in registry.live())

    def published(host: Address, names: frozenset[str]) -> Iterator[Traffic]:
        for name in names:
            for node in registry.registrants(Kind.PUBLICATION, name):
                if node.host == host:
                    yield carried.traffic.get((node.key, name), Traffic())

    def moved(host: Address, names: frozenset[str]) -> float:
        return max((traffic.moved for traffic in published(host, names)), default=0.0)

    def silence(host: Address, names: frozenset[str], since: float) -> float:
        counted = (traffic.silence(since) for traffic in published(host, names))
        return min(counted, default=clock.now() - since)

    def publishers(topic: str) -> list[tuple[Address, str]]:
        nodes = registry.registrants(Kind.PUBLICATION, topic)
        return [(node.host, node.name) for node in nodes if not node.own]

    return HostSigns(live, moved, publishers, silence)
