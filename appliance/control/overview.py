"""The graph as an operator sees it: nodes, topics, services, who is connected to whom, how much flows.

Everything is read from the registry and the relay's reports at one moment. The appliance's own nodes are left out.
"""

from typing import Any

from appliance.control.assembly import Parts
from appliance.master.graph.registry import Incarnation, Kind, Life
from appliance.master.reach.relays import RelayControl
from appliance.specifications.allocation import SERVICE, TOPIC

_ANY_TYPE = "*"


def graph_of(parts: Parts) -> dict[str, Any]:
    """The graph now, in plain values."""
    registry = parts.registry
    shown = [one for one in registry.all() if one.life is not Life.REPLACED and not one.own]
    live = [one for one in shown if one.life is Life.LIVE]
    names = {one.key: one.name for one in shown}
    return {
        "nodes": [_node(one) for one in sorted(shown, key=lambda one: one.name)],
        "topics": _topics(parts, live, names),
        "services": _services(parts, live, names),
    }


def _node(incarnation: Incarnation) -> dict[str, Any]:
    return {
        "name": incarnation.name,
        "host": str(incarnation.host),
        "state": "live" if incarnation.life is Life.LIVE else "lost",
        "publishes": sorted(incarnation.resources(Kind.PUBLICATION)),
        "subscribes": sorted(incarnation.resources(Kind.SUBSCRIPTION)),
        "offers": sorted(incarnation.resources(Kind.SERVICE)),
    }


def _topics(parts: Parts, live: list[Incarnation], names: dict[str, str]) -> list[dict[str, Any]]:
    relay = parts.relay
    topics: dict[str, dict[str, Any]] = {}
    for one in live:
        for registration in one.registrations.values():
            if registration.kind not in (Kind.PUBLICATION, Kind.SUBSCRIPTION):
                continue
            topic = topics.setdefault(
                registration.resource,
                {"name": registration.resource, "type": _ANY_TYPE, "publishers": [], "subscribers": []},
            )
            if registration.detail != _ANY_TYPE:
                topic["type"] = registration.detail
            if registration.kind is Kind.PUBLICATION:
                topic["publishers"].append({"node": one.name, **relay.flow(one.key, registration.resource)})
            else:
                topic["subscribers"].append(one.name)
    for name, topic in topics.items():
        topic["mediated"] = parts.mediation.carries_topic(name)
        topic["connections"] = _connections(relay, TOPIC, name, names)
    return [topics[name] for name in sorted(topics)]


def _services(parts: Parts, live: list[Incarnation], names: dict[str, str]) -> list[dict[str, Any]]:
    relay = parts.relay
    return [
        {
            "name": registration.resource,
            "node": one.name,
            "mediated": parts.mediation.carries_service(registration.resource),
            **relay.flow(one.key, registration.resource),
            "connections": _connections(relay, SERVICE, registration.resource, names),
        }
        for one in live
        for registration in one.registrations.values()
        if registration.kind is Kind.SERVICE
    ]


def _connections(
    relay: RelayControl, kind: str, resource: str, names: dict[str, str]
) -> list[dict[str, str]]:
    return [
        {"from": names[one.key], "to": one.caller_id, "host": one.host}
        for one in relay.connections.values()
        if one.kind == kind and one.resource == resource and one.key in names
    ]
