"""Limit the open connections of each robot, of each address, and in total.

A connection counts from `accept` to `close`: for its address until a robot's certificate is verified, then for the
robot. In IPv6 an address is a /64 network, and before it is proven its /48: one customer may have all of that. Each
robot that has come from an address adds to the address's limit, because its next connections wait there for their
handshakes, perhaps beside those of many robots behind the same address.

An address is *proven* once a robot or an operator has connected from it. All unproven addresses together get at most
half of the connections. When this half or the total is used up, the unproven address with the most connections loses
its oldest one. `Shares` limits the rate of handshakes, and of requests without a certificate or token.
"""

import asyncio
import contextlib
import errno
import ipaddress
import resource
import socket
from collections import Counter, OrderedDict

import structlog

from appliance.base import clock
from appliance.base.counted import counted
from rosrv_fleet.config import Limits

_OTHER_FILES = 256  # open files that are not connections: uploads, the database, workers
_LEAST_CONNECTIONS = 64
_LOG_SECONDS = 60.0
_MAX_PROVEN = 10_000
_OF_EACH_ROBOT = 4  # connections that an appliance opens at once: segments, evidence, presence, bundles
# Handshakes, or requests: of each proven address, behind which there may be many robots, and of all others together.
_PROVEN_A_SECOND, _PROVEN_AT_ONCE = 200.0, 256.0
_OTHERS_A_SECOND, _OTHER_AT_ONCE = 50.0, 32.0
# All others together, even if each comes once: IPv6 has any number of addresses. A thousand robots may begin at once.
_ALL_OTHERS_A_SECOND, _ALL_OTHERS_AT_ONCE = 200.0, 1000.0
_log = structlog.get_logger()


class TooFewFilesError(OSError):
    """The limit of open files is too low to serve."""


class Shares:
    """The rate at which each address may request a costly operation. Not thread-safe."""

    def __init__(self) -> None:
        # By address, unless its whole share is left: the time of its last request, and the rest of its share then.
        self._left: dict[bool, dict[str, tuple[float, float]]] = {False: {}, True: {}}
        self._looked = 0.0
        self._all_others = (clock.now(), _ALL_OTHERS_AT_ONCE)

    def take(self, owner: str, *, proven: bool) -> bool:
        """Count one operation, or return False if the address or all unproven addresses have used up their rate."""
        now = clock.now()
        if now - self._looked >= 1.0:
            self._looked = now
            self._forget_rested(now)
        left = self._left_of(owner, now, proven=proven)
        if left >= 1.0 and not proven and not self._take_of_all(now):
            return False
        if len(self._left[proven]) < _MAX_PROVEN or owner in self._left[proven]:
            self._left[proven][owner] = (now, left - 1.0 if left >= 1.0 else left)
        return left >= 1.0

    def _left_of(self, owner: str, now: float, *, proven: bool) -> float:
        there = self._left[proven]
        rate = _PROVEN_A_SECOND if proven else _OTHERS_A_SECOND / max(1, len(there))
        most = _PROVEN_AT_ONCE if proven else _OTHER_AT_ONCE
        at, left = there.get(owner, (now, most))
        return min(most, left + (now - at) * rate)

    def _take_of_all(self, now: float) -> bool:
        at, left = self._all_others
        left = min(_ALL_OTHERS_AT_ONCE, left + (now - at) * _ALL_OTHERS_A_SECOND)
        self._all_others = (now, left - 1.0 if left >= 1.0 else left)
        return left >= 1.0

    def _forget_rested(self, now: float) -> None:
        for proven, most in ((False, _OTHER_AT_ONCE), (True, _PROVEN_AT_ONCE)):
            lefts = {owner: self._left_of(owner, now, proven=proven) for owner in self._left[proven]}
            for owner, left in lefts.items():
                if left >= most:
                    del self._left[proven][owner]


class ClientConnections:
    """The open connections by owner. For the event loop's thread only."""

    def __init__(self, limits: Limits) -> None:
        """Raise the limit of open files as far as permitted, or raise `TooFewFilesError` if that is not enough."""
        self._limits = limits
        self._most = permitted_connections(limits.connections)
        self._owners: Counter[str] = Counter()
        self._open: dict[int, CountedSocket] = {}
        self._others: dict[
            str, dict[int, CountedSocket]
        ] = {}  # those of addresses that are not proven, oldest first
        self._others_open = 0
        self._proven: OrderedDict[str, set[str]] = OrderedDict()  # the robots that have come from there
        self._handshakes, self._requests = Shares(), Shares()
        self._logged = 0.0

    def accepted(self, connection: "CountedSocket", address: str) -> bool:
        connection.network = owner_of(address)
        owner, proven = self._owner(connection.network)
        most = self._limits.address_connections
        most = max(most, min(most + _OF_EACH_ROBOT * len(self._proven.get(owner, ())), self._most // 2))
        if self._owners[owner] >= most:
            return self._refused(owner, most)
        if not self._handshakes.take(owner, proven=proven):
            return self._refused(
                f"handshakes of {owner}", int(_PROVEN_A_SECOND if proven else _OTHERS_A_SECOND)
            )
        full = len(self._open) >= self._most
        if (full or (not proven and self._others_open >= self._most // 2)) and not self._made_room(
            owner, proven
        ):
            return self._refused("all", self._most)
        self._owners[owner] += 1
        connection.owner = owner
        self._open[connection.fileno()] = connection
        if not proven:
            self._others.setdefault(owner, {})[connection.fileno()] = connection
            self._others_open += 1
        # A client that does not complete the handshake in this time is cut off.
        connection.due = asyncio.get_running_loop().call_later(self._limits.header_seconds, _cut, connection)
        return True

    def established(self, number: int, robot: str | None) -> bool:
        connection = self._open.get(number)
        if connection is None:  # it was closed to admit another connection
            return False
        if connection.due is not None:
            connection.due.cancel()
        if robot is None:
            return True
        self.prove(connection.network)
        self._proven[connection.network].add(robot)
        owner = f"robot {robot}"
        if self._owners[owner] >= self._limits.robot_connections:
            return self._refused(owner, self._limits.robot_connections)
        self._release(connection.owner)
        self._owners[owner] += 1
        connection.owner = owner
        return True

    def prove(self, network: str) -> None:
        self._proven.setdefault(network, set())
        self._proven.move_to_end(network)
        if len(self._proven) > _MAX_PROVEN:
            self._proven.popitem(last=False)
        others = self._others.get(_wide(network), {})
        for number, one in [(number, one) for number, one in others.items() if one.network == network]:
            self._forget(number, one)

    def may_ask(self, network: str) -> bool:
        owner, proven = self._owner(network)
        return self._requests.take(owner, proven=proven)

    def is_proven(self, network: str) -> bool:
        return network in self._proven

    def _owner(self, network: str) -> tuple[str, bool]:
        proven = network in self._proven
        return (network if proven else _wide(network)), proven

    def _made_room(self, owner: str, proven: bool) -> bool:
        """Close the oldest connection of the unproven address with the most.

        Return False if this would only move the shortage to the new connection's own address.
        """
        most = max(self._others, key=lambda one: len(self._others[one]), default=None)
        if most is None or (not proven and len(self._others[most]) <= len(self._others.get(owner, ())) + 1):
            return False
        oldest = next(iter(self._others[most].values()))
        self.closed(oldest.fileno())
        _cut(oldest)
        return True

    def closed(self, number: int) -> None:
        connection = self._open.pop(number, None)
        if connection is not None:
            if connection.due is not None:
                connection.due.cancel()
            self._forget(number, connection)
            self._release(connection.owner)

    def _forget(self, number: int, connection: "CountedSocket") -> None:
        others = self._others.get(connection.owner, {})
        if others.pop(number, None) is not None:
            self._others_open -= 1
            if not others:
                del self._others[connection.owner]

    def _release(self, owner: str) -> None:
        self._owners[owner] -= 1
        if not self._owners[owner]:
            del self._owners[owner]

    def _refused(self, owner: str, most: int) -> bool:
        if clock.now() - self._logged > _LOG_SECONDS:
            self._logged = clock.now()
            _log.warning("connections are refused", owner=owner, limit=most)
        return False


class CountedSocket(socket.socket):
    """A connection that is counted until it is closed."""

    table: ClientConnections
    network = ""
    """The client's address, in IPv6 its /64 network."""
    owner = ""
    """Whose connection it is: the network, a wider one until that is proven, or the robot."""
    due: asyncio.TimerHandle | None = None

    def close(self) -> None:
        if self.fileno() >= 0:
            self.table.closed(self.fileno())
        super().close()


class CountingListener(socket.socket):
    """A listening socket that immediately closes connections above a limit."""

    table: ClientConnections

    def accept(self) -> tuple[socket.socket, object]:
        number, address = self._accept()  # type: ignore[attr-defined]  # `socket.accept` also calls it
        connection = CountedSocket(self.family, self.type, self.proto, fileno=number)
        connection.table = self.table
        if not self.table.accepted(connection, str(address[0])):
            connection.close()
            raise ConnectionAbortedError(errno.ECONNABORTED, "too many connections", address[0])
        return connection, address


def listen(host: str, port: int, table: ClientConnections) -> CountingListener:
    (family, kind, protocol, _name, address), *_others = socket.getaddrinfo(
        host or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
    )
    listener = CountingListener(family, kind, protocol)
    listener.table = table
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        raise OSError(error.errno, f"{host}:{port}: {error.strerror}; change listen") from error
    return listener


def owner_of(address: str) -> str:
    parsed = ipaddress.ip_address(address.partition("%")[0])
    if isinstance(parsed, ipaddress.IPv6Address) and parsed.ipv4_mapped is None:
        return str(ipaddress.ip_network((parsed, 64), strict=False))
    return address


def _wide(network: str) -> str:
    return str(ipaddress.ip_network(network).supernet(new_prefix=48)) if ":" in network else network


def permitted_connections(wanted: int) -> int:
    """Raise the limit of open files, and return the number of connections that it permits.

    Raise `TooFewFilesError` if the number is too low to serve.
    """
    _soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = wanted + _OTHER_FILES
    files = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
    resource.setrlimit(resource.RLIMIT_NOFILE, (files, hard))
    most = files - _OTHER_FILES
    if most < _LEAST_CONNECTIONS:
        raise TooFewFilesError(
            f"only {counted(files, 'file')} may be open: raise the limit (LimitNOFILE, ulimit -n) to {needed}"
        )
    if most < wanted:
        _log.warning(
            "the limit of open files permits fewer connections", connections=most, wanted=wanted, files=files,
            advice=f"raise LimitNOFILE or ulimit -n to {needed}",
        )  # fmt: skip
    return most


def _cut(connection: CountedSocket) -> None:
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)
