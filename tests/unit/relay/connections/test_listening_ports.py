import errno
import os
from collections import Counter, deque
from collections.abc import Callable
from types import SimpleNamespace
from typing import cast

import pytest

from appliance.quotas.pool import QuotaClass
from appliance.relay.connections import listening_ports
from appliance.relay.connections.listening_ports import ListeningPorts
from appliance.relay.context import RelayContext
from appliance.relay.loop import QUANTUM
from appliance.relay.relay_limits import RelayLimits

_COST = QUANTUM // 10  # of one `accept`


class Peer:
    """A connection that waits at the listening socket; `gone`, it left before `tune`."""

    def __init__(self, host: str = "10.0.0.9", *, gone: bool = False) -> None:
        self.host, self.gone, self.closed = host, gone, False

    def close(self) -> None:
        self.closed = True


class Listening:
    def __init__(self, world: "World", descriptor: int) -> None:
        self._world, self._descriptor = world, descriptor

    def fileno(self) -> int:
        return self._descriptor

    def setblocking(self, _flag: bool) -> None: ...

    def accept(self) -> tuple[Peer, tuple[str, int]]:
        self._world.spent += _COST
        if not self._world.waiting:
            raise BlockingIOError
        found = self._world.waiting.popleft()
        if isinstance(found, int):
            raise OSError(found, os.strerror(found))
        return found, (found.host, 4000)


class World:
    """A loop, its processor time and a listening socket, at which connections and errors wait."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.waiting: deque[Peer | int] = deque()
        self.watched: dict[int, Callable[[int], None]] = {}
        self.timers: list[Callable[[], None]] = []
        self.charged: Counter[str] = Counter()
        self.arrived: list[str] = []
        self.spent = 0
        loop = SimpleNamespace(
            used=lambda: self.spent,
            charge=lambda payer, used: self.charged.update({payer: used}),
            watch=lambda descriptor, _events, handler, _payer: self.watched.update({descriptor: handler}),
            unwatch=self.watched.pop,
            after=lambda _seconds, resume: self.timers.append(resume),
            discard=lambda sock: self.watched.pop(sock.fileno(), None),
        )
        monkeypatch.setattr(
            listening_ports, "socket", SimpleNamespace(socket=lambda *, fileno: Listening(self, fileno))
        )
        monkeypatch.setattr(listening_ports, "tune", self._tune)
        context = SimpleNamespace(
            loop=loop,
            limits=RelayLimits(),
            table=SimpleNamespace(quota_class=lambda _host: QuotaClass.REGISTERED),
            payer=lambda host: f"payer of {host}",
        )
        self.ports = ListeningPorts(
            cast(RelayContext, context),
            arrived=lambda _key, _sock, host: self.arrived.append(host),
            turned_away=lambda *_refusal: pytest.fail("no limit is reached"),
            make_room=lambda _host: False,
        )
        self.ports.open("a", 3)

    @staticmethod
    def _tune(peer: Peer) -> None:
        if peer.gone:
            raise OSError(errno.EINVAL, "the peer has left")

    def turn(self) -> int:
        """Return the number of calls of `accept` in one turn of the loop."""
        self.spent = 0
        self.watched[3](1)
        return self.spent // _COST


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    return World(monkeypatch)


def test_a_flood_of_aborted_connections_takes_one_quantum_of_a_turn(world: World) -> None:
    """The next turn continues, and a connected peer behind the flood arrives."""
    world.waiting.extend([errno.ECONNABORTED] * 25)
    world.waiting.append(Peer())
    assert [world.turn() for _ in range(3)] == [10, 10, 7]
    assert world.arrived == ["10.0.0.9"]
    assert set(world.charged) == {"payer of 10.0.0.9"}, "an aborted connection has no host"


def test_a_flood_of_connected_peers_takes_one_quantum_and_is_charged_to_its_host(world: World) -> None:
    world.waiting.extend(Peer(f"::ffff:10.0.0.{number % 2}") for number in range(25))
    assert world.turn() == 10
    assert Counter(world.arrived) == {"10.0.0.0": 5, "10.0.0.1": 5}
    assert world.charged == {"payer of 10.0.0.0": 5 * _COST, "payer of 10.0.0.1": 5 * _COST}


def test_a_peer_that_left_before_it_is_served_holds_no_connection(world: World) -> None:
    left = Peer(gone=True)
    world.waiting.extend([left, Peer()])
    world.turn()
    assert left.closed and world.arrived == ["10.0.0.9"]
    assert world.ports.connected.total == 1


@pytest.mark.parametrize("number", [errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM])
def test_without_a_descriptor_listening_pauses_and_resumes(world: World, number: int) -> None:
    world.waiting.extend([number, Peer()])
    assert world.turn() == 1
    assert world.watched == {}, "no turn of the loop is used meanwhile"
    [resume] = world.timers
    resume()
    world.turn()
    assert world.arrived == ["10.0.0.9"]


def test_a_port_that_was_closed_in_the_pause_stays_closed(world: World) -> None:
    world.waiting.append(errno.EMFILE)
    world.turn()
    world.ports.close("a")
    world.timers[0]()
    assert world.watched == {}
