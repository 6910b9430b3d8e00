"""Change interfaces, addresses and routes in a namespace, over netlink.

Addresses have the form `10.77.0.10/24` or `fd77::10/64`. Duplicate address detection is skipped, because the
networks have no other hosts.
"""

import ipaddress
import os
import socket
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Protocol, TypeVar

from appliance.network.namespaces import Namespace, NetworkError, privilege_hint


def netlink_library() -> ModuleType:
    import pyroute2  # noqa: PLC0415  200 modules, and most verbs change no network

    module: ModuleType = pyroute2
    return module


IFNAMSIZ = 15  # characters
_IFA_F_NODAD = 0x02
_MAIN_TABLE, _UNICAST = 254, 1  # RT_TABLE_MAIN, RTN_UNICAST
_LINK_SCOPE = 253  # RT_SCOPE_LINK
_HOST_SCOPE, _LOCAL_TABLE = 254, 255  # RT_SCOPE_HOST, RT_TABLE_LOCAL

T = TypeVar("T")


class _Entry(Protocol):
    """A link, address or route of the kernel: numbers of its header, and attributes of several types."""

    def __getitem__(self, field: str) -> int: ...

    def get_attr(self, name: str) -> Any: ...


class Netlink(Protocol):
    """The part of pyroute2's `IPRoute` in use; the library has no types."""

    def link(self, command: str, **fields: object) -> object: ...

    def addr(self, command: str, **fields: object) -> object: ...

    def route(self, command: str, **fields: object) -> Iterable[_Entry]: ...

    def link_lookup(self, *, ifname: str) -> list[int]: ...

    def get_links(self) -> Iterable[_Entry]: ...

    def get_addr(self, **fields: int) -> Iterable[_Entry]: ...

    def get_routes(self, **fields: int) -> Iterable[_Entry]: ...

    def get_rules(self, **fields: int) -> Iterable[_Entry]: ...


def create_veth(near: Namespace, near_name: str, far: Namespace, far_name: str) -> None:
    """Create a pair of interfaces, and set both up."""
    for name in (near_name, far_name):
        if not 0 < len(name) <= IFNAMSIZ:
            raise ValueError(f"interface name {name!r} must have 1 to {IFNAMSIZ} characters")
    descriptor = far.open()
    try:
        _netlink(
            near,
            f"creating the veth pair {near_name} - {far_name}",
            lambda route: route.link(
                "add", ifname=near_name, kind="veth", peer={"ifname": far_name, "net_ns_fd": descriptor}
            ),
        )
    finally:
        os.close(descriptor)
    set_link(near, near_name, up=True)
    set_link(far, far_name, up=True)


def create_bridge(namespace: Namespace, name: str) -> None:
    _netlink(
        namespace,
        f"creating the bridge {name}",
        lambda route: route.link("add", ifname=name, kind="bridge", br_stp_state=0, br_forward_delay=0),
    )
    set_link(namespace, name, up=True)


def attach(namespace: Namespace, name: str, bridge: str) -> None:
    _netlink(
        namespace,
        f"attaching {name} to {bridge}",
        lambda route: route.link("set", index=_index(route, name), master=_index(route, bridge)),
    )


def set_link(namespace: Namespace, name: str, *, up: bool) -> None:
    _netlink(
        namespace,
        f"setting {name} {'up' if up else 'down'}",
        lambda route: route.link("set", index=_index(route, name), state="up" if up else "down"),
    )


def delete_link(namespace: Namespace, name: str) -> None:
    def delete(route: Netlink) -> None:
        for index in route.link_lookup(ifname=name):
            route.link("del", index=index)

    _netlink(namespace, f"deleting {name}", delete)


def add_address(namespace: Namespace, name: str, address: str) -> None:
    interface = ipaddress.ip_interface(address)
    flags = _IFA_F_NODAD if interface.version == 6 else 0
    _netlink(
        namespace,
        f"adding {address} to {name}",
        lambda route: route.addr(
            "add",
            index=_index(route, name),
            address=str(interface.ip),
            prefixlen=interface.network.prefixlen,
            flags=flags,
        ),
    )


def delete_address(namespace: Namespace, name: str, address: str) -> None:
    interface = ipaddress.ip_interface(address)

    def delete(route: Netlink) -> None:
        for index in route.link_lookup(ifname=name):
            if str(interface) in _held(route, index=index):
                length = interface.network.prefixlen
                route.addr("del", index=index, address=str(interface.ip), prefixlen=length)

    _netlink(namespace, f"removing {address} from {name}", delete)


def add_route(namespace: Namespace, destination: str, via: str) -> None:
    """Add a route; `destination` is a network, or "default"."""
    family = _family(via)
    everywhere = "::/0" if family == socket.AF_INET6 else "0.0.0.0/0"
    where = everywhere if destination == "default" else destination
    _netlink(
        namespace,
        f"routing {destination} via {via}",
        lambda route: route.route("add", family=family, dst=where, gateway=via),
    )


def add_near_route(namespace: Namespace, name: str, destination: str, *, source: str, hop_limit: int) -> None:
    length = 128 if _family(destination) == socket.AF_INET6 else 32
    _netlink(
        namespace,
        f"routing {destination} to {name}",
        lambda route: route.route(
            "add",
            family=_family(destination),
            dst=f"{destination}/{length}",
            oif=_index(route, name),
            prefsrc=source,
            scope=_LINK_SCOPE if length == 32 else 0,
            metrics={"hoplimit": hop_limit},
        ),
    )


def add_local_route(namespace: Namespace, network: str) -> None:
    _netlink(
        namespace,
        f"adding the own network {network}",
        lambda route: route.route("replace", **_local_route(route, network)),
    )


def delete_local_route(namespace: Namespace, network: str) -> None:
    _netlink(
        namespace,
        f"removing the own network {network}",
        lambda route: route.route("del", **_local_route(route, network)),
    )


def _local_route(route: Netlink, network: str) -> dict[str, object]:
    kind = {"type": "local", "table": _LOCAL_TABLE, "scope": _HOST_SCOPE}
    return {"family": socket.AF_INET, "dst": network, "oif": _index(route, "lo"), **kind}


def links(namespace: Namespace) -> list[str]:
    return _netlink(namespace, "listing interfaces", lambda route: list(_names(route).values()))


def addresses(namespace: Namespace) -> list[str]:
    return _netlink(namespace, "listing addresses", _held)


def addresses_by_interface(namespace: Namespace) -> dict[str, list[str]]:
    def read(route: Netlink) -> dict[str, list[str]]:
        names = _names(route)
        held: dict[str, list[str]] = {name: [] for name in names.values()}
        for entry in route.get_addr():
            # On a point-to-point link, IFA_ADDRESS is the other end's address. IPv6 has IFA_LOCAL only on such a link.
            own = entry.get_attr("IFA_LOCAL") or entry.get_attr("IFA_ADDRESS")
            held.setdefault(names.get(entry["index"], ""), []).append(f"{own}/{entry['prefixlen']}")
        return held

    return _netlink(namespace, "listing addresses", read)


@dataclass(frozen=True)
class DefaultRoute:
    """A default route; `source` is the preferred source address, if any."""

    interface: str
    gateway: str | None
    source: str | None


def default_route(namespace: Namespace, version: int) -> DefaultRoute | None:
    def read(route: Netlink) -> DefaultRoute | None:
        family = socket.AF_INET if version == 4 else socket.AF_INET6
        names = _names(route)
        entries = [
            entry
            for entry in route.get_routes(family=family, table=_MAIN_TABLE)
            if not entry["dst_len"] and entry["type"] == _UNICAST
        ]
        for entry in sorted(entries, key=lambda entry: entry.get_attr("RTA_PRIORITY") or 0):
            hops = entry.get_attr("RTA_MULTIPATH") or []
            hop = hops[0] if hops else entry
            index = hop["oif"] if hops else entry.get_attr("RTA_OIF")
            if index in names:
                return DefaultRoute(names[index], hop.get_attr("RTA_GATEWAY"), entry.get_attr("RTA_PREFSRC"))
        return None

    return _netlink(namespace, "looking up the default route", read)


def networks(namespace: Namespace) -> list[str]:
    """Return the networks of routes and addresses, without default routes."""

    def read(route: Netlink) -> list[str]:
        routes = [
            f"{entry.get_attr('RTA_DST')}/{entry['dst_len']}"
            for entry in route.get_routes()
            if entry["dst_len"]
        ]
        return [str(ipaddress.ip_interface(text).network) for text in routes + _held(route)]

    return sorted(set(_netlink(namespace, "listing routes", read)))


def source_address_for(namespace: Namespace, peer: str) -> str:
    """Return the source address of packets to `peer`. Raises `NetworkError` without a route."""
    family = _family(peer)

    def look_up(route: Netlink) -> str:
        for answer in route.route("get", family=family, dst=peer):
            source = answer.get_attr("RTA_PREFSRC")
            if source:
                return str(source)
        raise NetworkError(f"no source address for {peer} in {namespace.name}")

    return _netlink(namespace, f"looking up the route to {peer}", look_up)


def tables_of_sources(namespace: Namespace, link: str) -> list[tuple[str, int]]:
    """Return each source with a routing table of its own, and that table, unless packets from `link` use it."""

    def read(route: Netlink) -> list[tuple[str, int]]:
        rules = [*route.get_rules(family=socket.AF_INET), *route.get_rules(family=socket.AF_INET6)]
        tables = [(entry, entry.get_attr("FRA_TABLE") or entry["table"]) for entry in rules]
        used = {table for entry, table in tables if entry.get_attr("FRA_IIFNAME") == link}
        used |= {_LINK_SCOPE, _MAIN_TABLE, _LOCAL_TABLE}
        return [
            (str(entry.get_attr("FRA_SRC")), table)
            for entry, table in tables
            if entry["src_len"] and table not in used
        ]

    return _netlink(namespace, "listing routing rules", read)


def _netlink(namespace: Namespace, what: str, work: Callable[[Netlink], T]) -> T:
    pyroute2 = netlink_library()

    def inside() -> T:
        with pyroute2.IPRoute() as route:
            return work(route)

    try:
        return namespace.run(inside)
    except pyroute2.NetlinkError as error:
        reason = f"{os.strerror(error.code)}{privilege_hint(error.code)}"
        raise NetworkError(f"{what} in {namespace.name}: {reason}") from error


def _names(route: Netlink) -> dict[int, str]:
    return {link["index"]: str(link.get_attr("IFLA_IFNAME")) for link in route.get_links()}


def _held(route: Netlink, **of: int) -> list[str]:
    return [f"{entry.get_attr('IFA_ADDRESS')}/{entry['prefixlen']}" for entry in route.get_addr(**of)]


def _index(route: Netlink, name: str) -> int:
    found = route.link_lookup(ifname=name)
    if not found:
        raise NetworkError(f"interface {name} does not exist")
    return int(found[0])


def _family(address: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ipaddress.ip_address(address).version == 6 else socket.AF_INET
