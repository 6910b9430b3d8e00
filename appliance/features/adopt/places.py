"""Find the host of each node of the robot's master: where its URI leads, and its port answers."""

import asyncio
import ipaddress
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from appliance.features.adopt.machine_facts import MachineFacts
from appliance.policy.model import Address
from appliance.rpc.host_shares import HostShare, serve_by_host
from appliance.rpc.master_reader import CALLER
from appliance.rpc.xmlrpc_client import (
    CallFailedError,
    RefusedError,
    UnansweredError,
    UnreachedError,
    XmlRpcClient,
)
from roswire.errors import InvalidUriError, RosError
from roswire.node.tcpros_streams import ANY, exchange_headers
from roswire.uris import NodeUri, parse_node_uri
from roswire.xmlrpc import Value, XmlRpcLimits

TOPIC_SECONDS = 5.0
"""The time of `requestTopic`: a node that needs four seconds for it is slow, and no reason to leave connections."""

_SECONDS = 2.0
_MAX_ADDRESSES = 8  # of one name
MAX_FAILED = 64
"""The places of one host, or its ports, that may fail: registered URIs do not make the appliance scan ports."""

_SHARE = HostShare(host=3.0, whole=5.0)
_LIMITS = XmlRpcLimits(body=256 << 10)


class NodePlace(NamedTuple):
    """A node: its registered URI, unchanged, and the host at which the appliance sees and calls it."""

    text: str
    uri: NodeUri
    host: Address

    @property
    def call_uri(self) -> NodeUri:
        return NodeUri("http", str(self.host), self.uri.port, self.uri.path)

    def is_here(self, facts: MachineFacts) -> bool:
        return str(self.host) == facts.link or facts.is_here(str(self.host))

    def share(self, facts: MachineFacts) -> str:
        """Return the share by which it is asked: that of its port on this machine, or of its host."""
        return f"port {self.uri.port}" if self.is_here(facts) else str(self.host)


@dataclass(frozen=True)
class Places:
    """The places of nodes by name, and the reasons why other nodes have none."""

    found: dict[str, NodePlace] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)
    own: dict[str, str] = field(default_factory=dict)
    """The missing nodes of this machine: their processes are connected to a master, and do not answer."""


class NodeCaller(Protocol):
    """Calls a node. Raises `CallFailedError`."""

    async def __call__(self, uri: NodeUri, method: str, /, *params: Value) -> Value: ...


async def call_node(uri: NodeUri, method: str, /, *params: Value) -> Value:
    seconds = TOPIC_SECONDS if method == "requestTopic" else _SECONDS
    return await XmlRpcClient(uri, timeout=seconds, limits=_LIMITS).call(method, CALLER, *params)


class ServiceProbe(Protocol):
    """Asks whether a port has a service of this name. Raises `UnansweredError`."""

    async def __call__(self, uri: NodeUri, service: str) -> bool: ...


async def has_service(uri: NodeUri, service: str) -> bool:
    """Return whether the port answers as this service; a call of it is not made."""
    header = {"callerid": CALLER, "service": service, "md5sum": ANY, "probe": "1"}
    try:
        async with asyncio.timeout(TOPIC_SECONDS):
            reader, writer = await asyncio.open_connection(uri.host, uri.port)
            try:
                answer = await exchange_headers(reader, writer, header, TOPIC_SECONDS)
            finally:
                writer.close()
    except TimeoutError:
        raise UnansweredError(f"{service} did not answer within {TOPIC_SECONDS:g} s") from None
    except (OSError, RosError):
        return False
    return answer.get("md5sum", ANY) != ANY  # not of a program that sends back what it gets


def parse_places(nodes: Mapping[str, str]) -> tuple[dict[str, NodeUri], dict[str, str]]:
    """Return the URIs by the names of nodes, and the reasons why others are not valid."""
    valid, invalid = {}, {}
    for name, text in nodes.items():
        try:
            valid[name] = parse_node_uri(text)
        except InvalidUriError as error:
            invalid[name] = str(error)
    return valid, invalid


def names_to_resolve(uris: Iterable[NodeUri]) -> list[str]:
    return [*dict.fromkeys(uri.host for uri in uris if not _is_address(uri.host))]


async def find_places(nodes: Mapping[str, str], facts: MachineFacts, call: NodeCaller = call_node) -> Places:
    """Return the places of nodes. `facts` has the sockets of their ports and the addresses of their hosts.

    Each place is asked once, whatever its names are. This machine's own places are asked first, and each of its ports
    has a share of its own, so that no other host delays them. A host of which too many places fail is not asked
    further: registered URIs do not make it scan ports.
    """
    uris, missing = parse_places(nodes)
    places: dict[str, list[NodePlace]] = {}
    for name, uri in uris.items():
        possible = _possible(nodes[name], uri, facts)
        if isinstance(possible, str):
            missing[name] = possible
        else:
            places[name] = possible
    each = sorted(
        (place for rows in places.values() for place in rows), key=lambda place: not place.is_here(facts)
    )
    shares = {place.call_uri: place.share(facts) for place in each}

    failed = Counter[str]()

    async def ask(uri: NodeUri) -> CallFailedError | None:
        if failed[shares[uri]] >= MAX_FAILED:
            return CallFailedError(
                f"it was not asked, because {MAX_FAILED} others of {uri.host} do not answer"
            )
        try:
            await call(uri, "getPid")
        except CallFailedError as error:
            failed[shares[uri]] += 1
            return error
        return None

    asked = await serve_by_host(shares, ask, _SHARE)
    found: dict[str, NodePlace] = {}
    silent: dict[str, NodePlace] = {}
    for name, possible in places.items():
        for place in possible:
            outcome = asked.get(place.call_uri, _NOT_ASKED)
            if outcome is None:
                found[name] = place
                missing.pop(name, None)
                break
            here = place.is_here(facts)
            loopback = "; does it listen on loopback only (ROS_HOSTNAME, ROS_IP)?" if here else ""
            missing[name] = f"{outcome}{loopback}"
            if here and isinstance(outcome, RefusedError | UnreachedError | UnansweredError):
                silent[name] = place
    taken = {port for place in found.values() for port in _ports_of(place, facts)}
    own = {
        name: missing[name]
        for name, place in silent.items()
        if name in missing and place.uri.port in facts.reaches and place.uri.port not in taken
    }
    return Places(found, missing, own)


_NOT_ASKED = UnansweredError("it was not asked in time, because too many nodes of its host do not answer")


def _possible(text: str, uri: NodeUri, facts: MachineFacts) -> list[NodePlace] | str:
    """Return the places at which a node may be, or why there is none."""
    addresses = [uri.host] if _is_address(uri.host) else facts.resolved.get(uri.host, [])
    if not addresses:
        return f"{uri.host} is not known on this machine: add it to /etc/hosts"
    ordered = sorted(set(addresses), key=lambda one: (":" in one, one))[:_MAX_ADDRESSES]
    hosts = [host for one in ordered if (host := _seen_at(one, uri.port, facts)) is not None]
    places = [NodePlace(text, uri, host) for host in dict.fromkeys(hosts)]
    return places or f"no process of this machine listens on port {uri.port}"


def _ports_of(place: NodePlace, facts: MachineFacts) -> list[int]:
    """Return all ports of the process of a node on this machine."""
    return facts.sockets.get(place.uri.port, []) if place.is_here(facts) else []


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
