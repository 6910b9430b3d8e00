"""Find the address by which hosts of other networks reach this machine.

Address translation in front of this machine is invisible, so operators see the reason of each choice.
"""

import ipaddress
from collections.abc import Sequence
from dataclasses import dataclass

from appliance.network import interfaces
from appliance.network.namespaces import Namespace, NetworkError

_VERSIONS = (4, 6)  # IPv4 first, because every ROS 1 host has it


@dataclass(frozen=True)
class PublicAddress:
    """An address with the reason for its choice."""

    address: str
    reason: str


def outward_address(namespace: Namespace, *, without: Sequence[str]) -> PublicAddress:
    """Return the address towards the default route, or the only address if there is no route.

    Raises `NetworkError` if there is not exactly one, without the interfaces `without`.
    """
    for version in _VERSIONS:
        route = interfaces.default_route(namespace, version)
        if route is None or route.interface in without:
            continue
        address = route.source or _first(namespace, route, version)
        if address is not None and _counts(address):
            return PublicAddress(address, "this machine's address towards its default route")
    return only_address(namespace, without=without)


def only_address(namespace: Namespace, *, without: Sequence[str]) -> PublicAddress:
    """Return the only address, preferably of IPv4. Raises as `outward_address` does."""
    held = interfaces.addresses_by_interface(namespace)
    own = [text.partition("/")[0] for name, texts in held.items() if name not in without for text in texts]
    found = sorted(
        {ipaddress.ip_address(text) for text in own if _counts(text)},
        key=lambda address: (address.version, address),
    )
    for version in _VERSIONS:
        of_it = [str(address) for address in found if address.version == version]
        if len(of_it) == 1:
            return PublicAddress(of_it[0], "the only address of this machine")
        if of_it:
            raise NetworkError(f"this machine has several addresses ({', '.join(of_it)})")
    raise NetworkError("this machine has only loopback and link-local addresses")


def _first(namespace: Namespace, route: interfaces.DefaultRoute, version: int) -> str | None:
    """Return the address towards the gateway, or without a gateway (a modem), the interface's first address."""
    if route.gateway is not None:
        return interfaces.source_address_for(namespace, route.gateway)
    held = interfaces.addresses_by_interface(namespace).get(route.interface, [])
    own = [text.partition("/")[0] for text in held]
    return next(
        (address for address in own if ipaddress.ip_address(address).version == version and _counts(address)),
        None,
    )


def _counts(text: str) -> bool:
    address = ipaddress.ip_address(text)
    return not (address.is_loopback or address.is_link_local)
