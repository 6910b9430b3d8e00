"""Find signs of life of a robot's hosts."""

from collections.abc import Callable
from dataclasses import dataclass

from appliance.master.endpoints.traffic import RelayTraffic
from appliance.master.graph.registry import Kind, Registry
from appliance.policy.model import Address


@dataclass(frozen=True, slots=True)
class HostSigns:
    """A host's signs of life: `live` returns whether it has a live node, `moved` the last publication's time or 0.

    `publishers` returns the host and the name of each of the robot's nodes that publishes a topic.
    """

    live: Callable[[Address], bool]
    moved: Callable[[Address, frozenset[str]], float]
    publishers: Callable[[str], list[tuple[Address, str]]] = lambda _topic: []


def host_signs(registry: Registry, carried: RelayTraffic) -> HostSigns:
    def live(host: Address) -> bool:
        return any(node.host == host for node in registry.live())

    def moved(host: Address, names: frozenset[str]) -> float:
        times = (
            carried.traffic[node.key, name].moved
            for name in names
            for node in registry.registered(Kind.PUBLICATION, name)
            if node.host == host and (node.key, name) in carried.traffic
        )
        return max(times, default=0.0)

    def publishers(topic: str) -> list[tuple[Address, str]]:
        nodes = registry.registered(Kind.PUBLICATION, topic)
        return [(node.host, node.name) for node in nodes if not node.own]

    return HostSigns(live, moved, publishers)
