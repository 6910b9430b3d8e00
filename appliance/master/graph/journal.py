"""Writes the registry's changes to the store, and reads the registry back after a restart."""

import ipaddress

from appliance.master.graph.registry import Incarnation, Kind, Life, Registration, Registry
from appliance.ros.uris import parse_node_uri
from appliance.store.state import IncarnationRow, RegistrationRow, StateStore

_SHELVED = "revoked "  # before the kind of a registration that the policy took back


class StoreJournal:
    """The registry's `Journal` on the state store."""

    def __init__(self, store: StateStore) -> None:
        self._store = store

    def incarnation_saved(self, incarnation: Incarnation) -> None:
        """A new incarnation, or a changed `life`."""
        self._store.save_incarnation(
            IncarnationRow(
                incarnation.key, incarnation.name, str(incarnation.host), incarnation.api_text, incarnation.told,
                incarnation.outer_port, incarnation.relay_port, incarnation.own, incarnation.life.value,
                incarnation.changed, incarnation.more_relay_ports,
            )
        )  # fmt: skip

    def incarnation_forgotten(self, key: str) -> None:
        """The incarnation and all its registrations are gone."""
        self._store.forget_incarnation(key)

    def registration_saved(self, key: str, registration: Registration) -> None:
        """A registration was made."""
        self._store.save_registration(
            RegistrationRow(
                key, registration.kind.value, registration.resource, registration.detail, registration.order
            )
        )

    def registration_removed(self, key: str, kind: Kind, resource: str) -> None:
        """A registration is gone."""
        self._store.remove_registration(key, kind.value, resource)

    def registration_shelved(self, key: str, registration: Registration) -> None:
        """A registration was taken back by the policy and is remembered."""
        kind = f"{_SHELVED}{registration.kind.value}"
        self._store.save_registration(
            RegistrationRow(key, kind, registration.resource, registration.detail, registration.order)
        )

    def registration_unshelved(self, key: str, kind: Kind, resource: str) -> None:
        """A registration that was taken back is remembered no longer."""
        self._store.remove_registration(key, f"{_SHELVED}{kind.value}", resource)


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
