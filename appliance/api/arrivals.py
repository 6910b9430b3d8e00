"""Connections of REST from the moment they are accepted, TLS handshake included: who has a place, and who makes room.

A peer is known here that has shown a good token lately, or is on this machine; every other is a stranger. Invariants:

1. All connections, in whatever state, are a pool of the table of shares. Nothing is made for a connection without a
   place: no transport, no TLS.
2. A peer within its share that finds no place gets that of a stranger: the one that waits for a request longest, or
   else the one that came first. Of known peers only what has waited for `_PATIENCE` seconds makes room, and only for
   another of them.
"""

import contextlib
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass

from appliance.api.rates import peer_key
from appliance.shares.pool import Bounds, Pool, Standing
from appliance.shares.queue import Queue

_PATIENCE = 1.0


@dataclass(eq=False, slots=True)
class Arrival:
    """A connection that has a place."""

    peer: str
    socket: socket.socket

    def cut(self) -> None:
        """End it: whoever reads or writes there finds the end."""
        with contextlib.suppress(OSError):
            self.socket.shutdown(socket.SHUT_RDWR)


class Arrivals:
    """Who has a place. `standing(peer)` says whether a peer is known."""

    def __init__(
        self,
        bounds: Bounds,
        standing: Callable[[str], Standing],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._standing = standing
        self._clock = clock
        self.connected: Pool[str] = Pool("connections to REST", bounds, standing)
        self._here: Queue[str, Arrival] = Queue(standing)
        self._waiting: Queue[str, Arrival] = Queue(standing)

    def come(self, sock: socket.socket, host: str) -> Arrival | None:
        """The place of a connection that was accepted from this address; None when there is none."""
        peer = peer_key(host)
        pool = self.connected
        while pool.take(peer):
            if pool.held(peer) >= pool.bounds.host or not self._make_room(peer):
                return None
        arrival = Arrival(peer, sock)
        self._here.put(arrival, peer, self._clock())
        self.waits(arrival)
        return arrival

    def waits(self, arrival: Arrival) -> None:
        """Its handshake or its next request is awaited from now on."""
        self._waiting.put(arrival, arrival.peer, self._clock())

    def served(self, arrival: Arrival) -> None:
        """A request of it is being served."""
        self._waiting.remove(arrival)

    def go(self, arrival: Arrival) -> None:
        """It has ended; to say it twice is fine."""
        self._waiting.remove(arrival)
        if self._here.remove(arrival):
            self.connected.give_back(arrival.peer)

    def _make_room(self, peer: str) -> bool:
        found = self._waiting.longest(Standing.STRANGER) or self._here.longest(Standing.STRANGER)
        if found is None and self._standing(peer) is Standing.REGISTERED:
            found = self._waiting.longest(Standing.REGISTERED)
            if found is not None and self._clock() - found[2] < _PATIENCE:
                found = None
        if found is None:
            return False
        self.go(found[0])
        found[0].cut()
        return True
