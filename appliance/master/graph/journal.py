"""Writes the registry's changes to the store, and reads the registry back after a restart."""

import ipaddress

from appliance.master.graph.registry import (
    Durable,
    EraseNode,
    EraseRegistration,
    Incarnation,
    Kind,
    Life,
    Registration,
    Registry,
    SaveNode,
    SaveRegistration,
)
from appliance.ros.uris import parse_node_uri
from appliance.store.state import IncarnationRow, RegistrationRow, StateStore

_SHELVED = "revoked "  # before the kind of a registration that the policy took back


def write(effect: Durable, store: StateStore) -> None:
    """Keep one change of the registry."""
    match effect:
        case SaveNode(node):
            store.save_incarnation(
                IncarnationRow(
                    node.key, node.name, str(node.host), node.api_text, node.told, node.outer_port, node.relay_port,
                    node.own, node.life.value, node.changed, node.more_relay_ports,
                )
            )  # fmt: skip
        case EraseNode(key):
            store.forget_incarnation(key)
        case SaveRegistration(key, one, shelved):
            store.save_registration(
                RegistrationRow(key, _kept_kind(one.kind, shelved), one.resource, one.detail, one.order)
            )
        case EraseRegistration(key, kind, resource, shelved):
            store.remove_registration(key, _kept_kind(kind, shelved), resource)


def _kept_kind(kind: Kind, shelved: bool) -> str:
    return f"{_SHELVED}{kind.value}" if shelved else kind.value


def restore(registry: Registry, store: StateStore) -> int:
    """Fill `registry` with what the store kept; the number of incarnations."""
    incarnations, registrations = store.load_registry()
    by_key = {
        row.key: Incarnation(
            key=row.key,
            name=row.name,
            host=ipaddress.ip_address(row.host),
            api=parse_node_uri(row.api),
            api_text=row.api,
            told=row.told,
            outer_port=row.outer_port,
            relay_port=row.relay_port,
            own=row.own,
            life=Life(row.life),
            changed=row.changed,
            more_relay_ports=row.more_relay_ports,
        )
        for row in incarnations
    }
    for row in registrations:
        owner = by_key.get(row.key)
        if owner is not None:
            kind = Kind(row.kind.removeprefix(_SHELVED))
            place = owner.shelf if row.kind.startswith(_SHELVED) else owner.registrations
            place[kind, row.resource] = Registration(kind, row.resource, row.detail, row.ordinal)
    for incarnation in by_key.values():
        registry.restore(incarnation)
    return len(by_key)
