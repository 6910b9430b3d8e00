import errno
import os
import socket
from collections import Counter, deque
from collections.abc import Iterator

import pytest

from appliance.relay.connections import listening_ports
from appliance.relay.connections.listening_ports import ListeningPorts
from appliance.relay.loop import QUANTUM, EventLoop
from tests.support.local_sockets import LocalSocket
from tests.support.virtual_clock import let_time_pass
from tests.unit.relay.contexts import context_of

pytestmark = pytest.mark.usefixtures("local_sockets")

HOSTS = ("10.0.0.0", "10.0.0.1", "10.0.0.8", "10.0.0.9")
_COST = QUANTUM // 10  # of one `accept`


class World:
    """A listening socket, at which peers wait behind `errors`, and the processor time that `accept` takes."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.errors = deque[int]()
        self.charged = Counter[str]()
        self.arrived = list[str]()
        self.spent = 0
        self.loop = EventLoop(lambda: self.spent)
        patch.setattr(self.loop, "charge", lambda payer, used: self.charged.update({payer: used}))
        accept = LocalSocket.accept

        def accept_later(sock: LocalSocket) -> object:
            self._accept()
            return accept(sock)

        patch.setattr(LocalSocket, "accept", accept_later)
        self.ports = ListeningPorts(
            context_of(self.loop, named_hosts=HOSTS),
            arrived=self._arrived,
            turned_away=lambda *_refusal: pytest.fail("no limit is reached"),
            make_room=lambda _host: False,
        )
        self.open = [socket.create_server(("127.0.0.1", 0))]
        self.ports.open("a", self.open[0].dup().detach())

    def connect(self, *hosts: str) -> None:
        where = self.open[0].getsockname()
        self.open += [socket.create_connection(where, source_address=(host, 0)) for host in hosts]

    def _accept(self) -> None:
        self.spent += _COST
        if self.errors:
            number = self.errors.popleft()
            raise OSError(number, os.strerror(number))

    def _arrived(self, _key: str, sock: socket.socket, host: str) -> None:
        self.open.append(sock)
        self.arrived.append(host)

    def turn(self) -> int:
        """Return the number of calls of `accept` in one turn of the loop."""
        self.spent = 0
        self.loop.turn(0)
        return self.spent // _COST

    def close(self) -> None:
        self.ports.close_all()
        self.loop.close()
        for sock in self.open:
            sock.close()


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    world = World(monkeypatch)
    yield world
    world.close()


def test_a_flood_of_aborted_connections_takes_one_quantum_of_a_turn(world: World) -> None:
    """The next turn continues, and a connected peer behind the flood arrives."""
    world.errors.extend([errno.ECONNABORTED] * 25)
    world.connect("10.0.0.9")
    assert [world.turn() for _ in range(3)] == [10, 10, 7]
    assert world.arrived == ["10.0.0.9"]
    assert set(world.charged) == {"10.0.0.9"}, "an aborted connection has no host"


def test_a_flood_of_connected_peers_takes_one_quantum_and_is_charged_to_its_host(world: World) -> None:
    world.connect(*(f"::ffff:10.0.0.{number % 2}" for number in range(25)))
    assert world.turn() == 10
    assert Counter(world.arrived) == {"10.0.0.0": 5, "10.0.0.1": 5}
    assert world.charged == {"10.0.0.0": 5 * _COST, "10.0.0.1": 5 * _COST}


def test_a_peer_that_left_before_it_is_served_holds_no_connection(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = list[socket.socket]()

    def tune(sock: socket.socket) -> None:
        seen.append(sock)
        if len(seen) == 1:
            raise OSError(errno.EINVAL, "the peer has left")

    monkeypatch.setattr(listening_ports, "tune", tune)
    world.connect("10.0.0.8", "10.0.0.9")
    world.turn()
    assert seen[0].fileno() == -1
    assert world.arrived == ["10.0.0.9"]
    assert world.ports.connected.total == 1


@pytest.mark.parametrize("number", [errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM])
def test_without_a_descriptor_listening_pauses_and_resumes(world: World, number: int) -> None:
    world.errors.append(number)
    world.connect("10.0.0.9")
    assert [world.turn() for _ in range(3)] == [1, 0, 0], "no turn of the loop is used meanwhile"
    let_time_pass(1)
    assert [world.turn() for _ in range(3)] == [0, 2, 0]
    assert world.arrived == ["10.0.0.9"]


def test_a_port_that_was_closed_in_the_pause_stays_closed(world: World) -> None:
    world.errors.append(errno.EMFILE)
    world.connect("10.0.0.9")
    assert world.turn() == 1
    world.ports.close("a")
    let_time_pass(1)
    assert [world.turn() for _ in range(3)] == [0, 0, 0]
    assert world.arrived == []
