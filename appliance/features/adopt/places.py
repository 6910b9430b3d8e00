"""Find the host of each node of the robot's master: where its URI leads, and its port answers."""

import asyncio
import ipaddress
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from appliance.base import clock
from appliance.features.adopt.machine_facts import MachineFacts
from appliance.policy.model import Address
from appliance.rpc.master_reader import CALLER
from appliance.rpc.xmlrpc_client import CallFailedError, XmlRpcClient
from roswire.errors import InvalidUriError
from roswire.uris import NodeUri, parse_node_uri
from roswire.xmlrpc import Value, XmlRpcLimits

_SECONDS = 2.0
_WHOLE_SECONDS = 30.0
_AT_ONCE = 16
_LIMITS = XmlRpcLimits(body=256 << 10)


class NodePlace(NamedTuple):
    """A node: its registered URI, unchanged, and the host at which the appliance sees and calls it."""

    text: str
    uri: NodeUri
    host: Address

    @property
    def call_uri(self) -> NodeUri:
        return NodeUri("http", str(self.host), self.uri.port, self.uri.path)


@dataclass(frozen=True)
class Places:
    """The places of nodes by name, and the reasons why other nodes have none."""

    found: dict[str, NodePlace] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)


class NodeCaller(Protocol):
    """Calls a node. Raises `CallFailedError`."""

    async def __call__(self, uri: NodeUri, method: str, /, *params: Value) -> Value: ...


async def call_node(uri: NodeUri, method: str, /, *params: Value) -> Value:
    return await XmlRpcClient(uri, timeout=_SECONDS, limits=_LIMITS).call(method, CALLER, *params)


def parsed(nodes: Mapping[str, str]) -> tuple[dict[str, NodeUri], dict[str, str]]:
    """Return the URIs by the names of nodes, and the reasons why others are not valid."""
    valid, invalid = {}, {}
    for name, text in nodes.items():
        try:
            valid[name] = parse_node_uri(text)
        except InvalidUriError as error:
            invalid[name] = str(error)
    return valid, invalid


def names_to_resolve(uris: Iterable[NodeUri]) -> list[str]:
    return sorted({uri.host for uri in uris if not _is_address(uri.host)})


async def find_places(nodes: Mapping[str, str], facts: MachineFacts, call: NodeCaller = call_node) -> Places:
    """Return the places of nodes. `facts` has the sockets of their ports and the addresses of their hosts."""
    uris, missing = parsed(nodes)
    turns, until = asyncio.Semaphore(_AT_ONCE), clock.now() + _WHOLE_SECONDS

    async def one(name: str, uri: NodeUri) -> tuple[str, NodePlace | str]:
        async with turns:
            if clock.now() > until:
                return (
                    name,
                    f"it was not asked within {_WHOLE_SECONDS:g} s, because too many nodes do not answer",
                )
            return name, await _place(nodes[name], uri, facts, call)

    found: dict[str, NodePlace] = {}
    for name, place in await asyncio.gather(*(one(*row) for row in uris.items())):
        if isinstance(place, str):
            missing[name] = place
        else:
            found[name] = place
    return Places(found, missing)


async def _place(text: str, uri: NodeUri, facts: MachineFacts, call: NodeCaller) -> NodePlace | str:
    addresses = [uri.host] if _is_address(uri.host) else facts.resolved.get(uri.host, [])
    if not addresses:
        return f"{uri.host} is not known on this machine: add it to /etc/hosts"
    reason = ""
    for address in sorted(set(addresses), key=lambda one: (":" in one, one)):
        host = _seen_at(address, uri.port, facts)
        if host is None:
            reason = reason or f"no process of this machine listens on port {uri.port}"
            continue
        place = NodePlace(text, uri, host)
        try:
            await call(place.call_uri, "getPid")
        except CallFailedError as error:
            loopback = facts.is_here(address) and "; does it listen on loopback only (ROS_HOSTNAME, ROS_IP)?"
            reason = f"{error}{loopback or ''}"
        else:
            return place
    return reason


def _seen_at(address: str, port: int, facts: MachineFacts) -> Address | None:
    """Return the address at which the appliance sees a node's calls; None if the node does not exist."""
    if not facts.is_here(address):
        return ipaddress.ip_address(address)
    if port not in facts.sockets:
        return None
    reaches = facts.reaches.get(port, "")
    outside = reaches and not ipaddress.ip_address(reaches).is_loopback and reaches in facts.own
    return ipaddress.ip_address(reaches if outside else facts.link)


def _is_address(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True
