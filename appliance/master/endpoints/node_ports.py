"""Manage the ports and listening sockets of each incarnation, and the advertised address.

The port that was unused for the longest time is taken first, because a subscriber may still call a dead node's port.
A host may have `_TIMES_THE_REST` times as many ports as are left; a network that the policy names counts as one host.
"""

import asyncio
import errno
import math
import socket as sockets
from collections import deque
from collections.abc import Awaitable, Callable, Iterable, Sequence

import structlog

from appliance.base import clock
from appliance.base.counted import counted
from appliance.master.graph.registry import Incarnation
from appliance.policy.host_sets import Network
from appliance.policy.model import Address, plain_address
from appliance.policy.policy import Policy
from appliance.quotas.pool import Pool, QuotaClass
from appliance.quotas.table import NODE_PORTS
from appliance.rpc.server import Peer

_TIMES_THE_REST = 3


class NoPortError(Exception):
    """No port is available; the message has the remedy."""


class NodePorts:
    """The listening sockets of all incarnations. `keep` and `drop` notify the supervisor."""

    def __init__(
        self,
        host: str,
        ports: range,
        *,
        keep: Callable[[str, sockets.socket], None],
        drop: Callable[[str], None],
        policy: Callable[[], Policy],
        relays: int = 1,
        listen: Callable[[str, int], sockets.socket],
    ) -> None:
        self._each = 1 + relays
        self._listen = listen
        self._host = host
        self._keep = keep
        self._drop = drop
        self._range = ports
        self.unused = deque(ports)
        self._sockets: dict[str, sockets.socket] = {}
        self._policy = policy
        self._owners: dict[int, tuple[Address, Network]] = {}  # each port's host and charged network
        self.taken = self._counted()

    def policy_changed(self, ports: range) -> None:
        if ports != self._range:
            self._range = ports
            used = {socket.getsockname()[1] for socket in self._sockets.values()}
            self.unused = deque(port for port in ports if port not in used)
        self.taken = self._counted()

    def _counted(self) -> Pool[Network]:
        whole = len(self._range)
        bounds = NODE_PORTS.bounds.resize(whole, whole * _TIMES_THE_REST // (_TIMES_THE_REST + 1))
        pool: Pool[Network] = Pool("ports", bounds, lambda _named: QuotaClass.REGISTERED)
        self._owners = {
            port: (host, self._policy().named_as(host)) for port, (host, _named) in self._owners.items()
        }
        for _host, named in self._owners.values():
            pool.charge(named)
        return pool

    def _own(self, ports: Iterable[int], host: Address) -> None:
        named = self._policy().named_as(host)
        for port in ports:
            self._owners[port] = host, named
            self.taken.charge(named)

    def open(self, host: Address) -> tuple[int, ...]:
        """Return the outer port, and one port for each relay. Raises `NoPortError`."""
        named = self._policy().named_as(host)
        held, left = self.taken.held(named), len(self.unused)
        if left and held >= _TIMES_THE_REST * left:
            who = named if named.num_addresses > 1 else host
            raise NoPortError(
                f"{who} has {counted(held, 'port')} ({self._each} per node), and {left} are left for all other"
                " hosts: a host may"
                f" have {_TIMES_THE_REST} times as many as are left; widen [Ports] range"
            )
        opened = self._open(self._each)
        self._own(opened, host)
        return opened

    def _open(self, count: int) -> tuple[int, ...]:
        opened: list[sockets.socket] = []
        try:
            while len(opened) < count:
                opened.append(self.listen())
        except NoPortError:
            for sock in opened:
                self.unused.append(sock.getsockname()[1])
                sock.close()
            raise
        for sock in opened:
            name = f"port:{sock.getsockname()[1]}"
            self._sockets[name] = sock
            self._keep(name, sock)
        return tuple(sock.getsockname()[1] for sock in opened)

    def socket(self, port: int) -> sockets.socket:
        return self._sockets[f"port:{port}"]

    def descriptor(self, port: int) -> int:
        return self.socket(port).fileno()

    def adopt(self, name: str, sock: sockets.socket) -> None:
        self._sockets[name] = sock
        port = sock.getsockname()[1]
        if port in self.unused:
            self.unused.remove(port)

    def reserve(self, ports: Iterable[int]) -> None:
        """Until `close_unclaimed`, use these ports of restored nodes for no other node."""
        reserved = set(ports)
        self.unused = deque(port for port in self.unused if port not in reserved)

    def reopen(self, incarnation: Incarnation) -> None:
        """Open a restored node's ports, and unused ones instead of those that another program has.

        Raises `NoPortError`.
        """
        ports = [
            port if self._reopened(port) else self._open(1)[0] for port in incarnation.ports[: self._each]
        ]
        incarnation.outer_port, incarnation.relay_port, *more = *ports, *self._open(self._each - len(ports))
        incarnation.more_relay_ports = tuple(more)
        self._own(incarnation.ports, incarnation.host)

    def _reopened(self, port: int) -> bool:
        name = f"port:{port}"
        if name not in self._sockets:
            try:
                sock = self._listen(self._host, port)
            except OSError:
                return False
            self.adopt(name, sock)
            self._keep(name, sock)
        return True

    def close(self, incarnation: Incarnation) -> None:
        for port in incarnation.ports:
            owner = self._owners.pop(port, None)
            if owner is not None:
                self.taken.give_back(owner[1])
            sock = self._sockets.pop(f"port:{port}", None)
            if sock is None:
                continue
            sock.close()
            self._drop(f"port:{port}")
            if port in self._range:
                self.unused.append(port)

    def close_unclaimed(self, claimed: set[int]) -> None:
        """Close kept sockets that no incarnation claims. The next new ports are above the claimed ports."""
        for name, sock in list(self._sockets.items()):
            if sock.getsockname()[1] not in claimed:
                del self._sockets[name]
                sock.close()
                self._drop(name)
        last = max(claimed, default=0)
        unused = (port for port in self._range if port not in claimed)
        self.unused = deque(sorted(unused, key=lambda port: (port <= last, port)))

    def listen(self) -> sockets.socket:
        for _ in range(len(self.unused)):
            port = self.unused.popleft()
            try:
                return self._listen(self._host, port)
            except OSError as error:
                self.unused.append(port)
                if error.errno not in (errno.EADDRINUSE, errno.EACCES):  # these: another program has the port
                    raise NoPortError(
                        f"port {port} on {self._host} cannot be opened: {error.strerror}"
                    ) from error
        raise NoPortError(
            f"all ports {self._range.start}-{self._range.stop - 1} are in use"
            f" ({self._each} per node); widen [Ports] range"
        )


_log = structlog.get_logger()
_ANSWER_SECONDS = 3.0
_AGAIN_SECONDS = 30.0  # without an address; each call of the host would wait again
_MAX_ROUTES = 10_000


class AdvertisedAddresses:
    """Chooses the appliance's address that each host gets in URIs.

    A (network, address) pair of `advertised` has priority; otherwise, a host gets the address at which it reached the
    appliance. `fixed` is the address of the active one of two appliances, for hosts outside the network `tunnels`.
    """

    def __init__(
        self,
        advertised: Sequence[tuple[Network, Address]],
        route_to: Callable[[str], Awaitable[str | None]] | None,
        listen: str,
        *,
        fixed: str | None = None,
        tunnels: Network | None = None,
    ) -> None:
        address = plain_address(listen)
        self.listen = None if address.is_unspecified else str(address)
        self._advertised = advertised
        self._fixed = fixed
        self._tunnels = tunnels
        self._route_to = route_to
        # By host: the address, and how long it is valid. Without an address, it is asked again soon.
        self._routes: dict[Address, tuple[str | None, float]] = {}

    def address_for(self, peer: Peer) -> str:
        for network, address in self._advertised:
            if peer.host in network:
                return str(address)
        if self._fixed is not None and not peer.host.is_loopback:
            inside = self._tunnels is not None and peer.host in self._tunnels
            return peer.local if inside else self._fixed
        # The appliance's own nodes use a separate loopback listener. Proxy endpoints may not listen there.
        route, _until = self._routes.get(peer.host, (None, 0.0))
        return route or self.listen or peer.local

    def forget_routes(self) -> None:
        """Forget cached routes, because the addresses of the machine changed."""
        self._routes.clear()

    async def learn(self, peer: Peer) -> None:
        if self._route_to is None or self._fixed is not None:
            return
        if self._routes.get(peer.host, (None, -math.inf))[1] > clock.now():
            return
        if len(self._routes) > _MAX_ROUTES:
            self._routes.clear()
        try:
            async with asyncio.timeout(_ANSWER_SECONDS):
                found = await self._route_to(peer.text)
            self._routes[peer.host] = found, math.inf if found else clock.now() + _AGAIN_SECONDS
        except TimeoutError:
            self._routes[peer.host] = None, clock.now() + _AGAIN_SECONDS
            _log.warning(
                "the supervisor did not report the address at which a host reaches the appliance",
                host=peer.text,
            )
