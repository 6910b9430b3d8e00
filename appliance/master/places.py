"""Where an incarnation is found: its outer face's port, its relay port, and the sockets that listen there.

Control opens every listening socket and gives the supervisor a duplicate to keep, so that neither control's death
nor the relay's closes a port; a restarted control gets them back by name.

Ports come from the policy's `[Ports]` range, two per incarnation, the longest unused first: a subscriber that still
knocks at a dead node's port finds nobody, not somebody else.
"""

import errno
import socket as sockets
from collections import deque
from collections.abc import Callable

from appliance.master.http import listen
from appliance.master.registry import Incarnation


class NoPortError(Exception):
    """Every port of the range is in use; the text says what to change."""


class Places:
    """The listening sockets of all incarnations.

    `keep(name, socket)` and `drop(name)` tell the supervisor; `host` is the address RVMaster listens on.
    """

    def __init__(
        self,
        host: str,
        ports: range,
        *,
        keep: Callable[[str, sockets.socket], None],
        drop: Callable[[str], None],
    ) -> None:
        self._host = host
        self._keep = keep
        self._drop = drop
        self._range = ports
        self._unused = deque(ports)
        self._sockets: dict[str, sockets.socket] = {}

    def set_range(self, ports: range) -> None:
        """Take new ports from this range from now on; those in use stay."""
        if ports == self._range:
            return
        self._range = ports
        used = {one.getsockname()[1] for one in self._sockets.values()}
        self._unused = deque(port for port in ports if port not in used)

    def open(self) -> tuple[int, int]:
        """Reserve two ports with listening sockets: (outer, relay). Raises `NoPortError`."""
        outer = self._listen()
        try:
            relay = self._listen()
        except NoPortError:
            self._unused.append(outer.getsockname()[1])
            outer.close()
            raise
        ports = (outer.getsockname()[1], relay.getsockname()[1])
        self._sockets[f"port:{ports[0]}"], self._sockets[f"port:{ports[1]}"] = outer, relay
        self._keep(f"port:{ports[0]}", outer)
        self._keep(f"port:{ports[1]}", relay)
        return ports

    def socket(self, port: int) -> sockets.socket:
        """The listening socket of a port that was opened or adopted."""
        return self._sockets[f"port:{port}"]

    def adopt(self, name: str, sock: sockets.socket) -> None:
        """Take a kept socket back after a restart of control."""
        self._sockets[name] = sock
        port = sock.getsockname()[1]
        if port in self._unused:
            self._unused.remove(port)

    def reopen(self, incarnation: Incarnation) -> bool:
        """Open the same ports again (after a restart of the appliance); False when another process has one."""
        opened: list[sockets.socket] = []
        for port in (incarnation.outer_port, incarnation.relay_port):
            if f"port:{port}" in self._sockets:
                continue
            try:
                opened.append(listen(self._host, port))
            except OSError:
                for one in opened:
                    one.close()
                return False
        for one in opened:
            name = f"port:{one.getsockname()[1]}"
            self.adopt(name, one)
            self._keep(name, one)
        return True

    def close(self, incarnation: Incarnation) -> None:
        """Close both ports; they go to the end of the line."""
        for port in (incarnation.outer_port, incarnation.relay_port):
            sock = self._sockets.pop(f"port:{port}", None)
            if sock is None:
                continue
            sock.close()
            self._drop(f"port:{port}")
            if port in self._range:
                self._unused.append(port)

    def close_unclaimed(self, claimed: set[int]) -> None:
        """Close kept sockets that belong to no known incarnation; the next to be opened come after those claimed."""
        for name, sock in list(self._sockets.items()):
            port = sock.getsockname()[1]
            if port not in claimed:
                del self._sockets[name]
                sock.close()
                self._drop(name)
                self._unused.append(port)
        last = max(claimed, default=0)
        self._unused = deque(sorted(self._unused, key=lambda port: (port <= last, port)))

    def _listen(self) -> sockets.socket:
        for _ in range(len(self._unused)):
            port = self._unused.popleft()
            try:
                return listen(self._host, port)
            except OSError as error:
                if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                    raise NoPortError(
                        f"port {port} on {self._host} cannot be opened: {error.strerror}"
                    ) from error
                self._unused.append(port)  # another program has it for now
        raise NoPortError(
            f"all ports {self._range.start}-{self._range.stop - 1} are in use (two per node); widen [Ports] range"
        )
