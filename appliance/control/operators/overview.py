"""Describe the graph for operators: nodes, topics, services, connections, traffic."""

from collections.abc import Iterator

from msgspec.structs import asdict

from appliance.channel.answers.graph_answers import Connection, Graph, Node, Publisher, Service, Topic
from appliance.master.endpoints.relay_control import RelayControl
from appliance.master.endpoints.traffic import RelayTraffic
from appliance.master.graph.registry import Incarnation, Kind, Life, Registry
from appliance.specifications.allocation import SERVICE, TOPIC


def graph_of(registry: Registry, relay: RelayControl) -> Graph:
    shown = [
        incarnation
        for incarnation in registry.all()
        if incarnation.life is not Life.REPLACED and not incarnation.own
    ]
    live = [incarnation for incarnation in shown if incarnation.life is Life.LIVE]
    names = {incarnation.key: incarnation.name for incarnation in shown}
    return Graph(
        [_node(incarnation) for incarnation in sorted(shown, key=lambda incarnation: incarnation.name)],
        _topics(registry, relay, live, names),
        _services(relay, live, names),
    )


def hosts_connected(registry: Registry, carried: RelayTraffic) -> Iterator[set[str]]:
    for connection in carried.connections.values():
        holder = registry.by_key(connection.key)
        yield {connection.host} if holder is None else {connection.host, str(holder.host)}


def _node(incarnation: Incarnation) -> Node:
    return Node(
        incarnation.name,
        str(incarnation.host),
        "live" if incarnation.life is Life.LIVE else "lost",
        publishes=sorted(incarnation.resources(Kind.PUBLICATION)),
        subscribes=sorted(incarnation.resources(Kind.SUBSCRIPTION)),
        offers=sorted(incarnation.resources(Kind.SERVICE)),
    )


def _topics(
    registry: Registry, relay: RelayControl, live: list[Incarnation], names: dict[str, str]
) -> list[Topic]:
    connections = _connections(relay, TOPIC, names)
    publishers: dict[str, list[Publisher]] = {}
    subscribers: dict[str, list[str]] = {}
    for incarnation in live:
        for registration in incarnation.registrations.values():
            topic = registration.resource
            if registration.kind is Kind.PUBLICATION:
                publisher = Publisher(
                    **asdict(relay.carried.flow(incarnation.key, topic)), node=incarnation.name
                )
                publishers.setdefault(topic, []).append(publisher)
            elif registration.kind is Kind.SUBSCRIPTION:
                subscribers.setdefault(topic, []).append(incarnation.name)
    return [
        Topic(
            name,
            registry.type_of(name),
            mediated=relay.carries_topic(name),
            publishers=publishers.get(name, []),
            subscribers=subscribers.get(name, []),
            connections=connections.get(name, []),
        )
        for name in sorted(publishers.keys() | subscribers.keys())
    ]


def _services(relay: RelayControl, live: list[Incarnation], names: dict[str, str]) -> list[Service]:
    connections = _connections(relay, SERVICE, names)
    return [
        Service(
            **asdict(relay.carried.flow(incarnation.key, registration.resource)),
            name=registration.resource,
            node=incarnation.name,
            mediated=relay.carries_service(registration.resource),
            connections=connections.get(registration.resource, []),
        )
        for incarnation in live
        for registration in incarnation.registrations.values()
        if registration.kind is Kind.SERVICE
    ]


def _connections(relay: RelayControl, kind: str, names: dict[str, str]) -> dict[str, list[Connection]]:
    found: dict[str, list[Connection]] = {}
    for connection in relay.carried.connections.values():
        if connection.kind == kind and connection.key in names:
            row = Connection(names[connection.key], connection.caller_id, connection.host)
            found.setdefault(connection.resource, []).append(row)
    return found
