import socket
import threading
from collections.abc import Iterator
from typing import cast

import pytest

from examples.landshark.doorway import CONNECTIONS, Doorway
from examples.landshark.lab import Host, Lab
from tests.support.requirements import need_root

LIMIT = 30.0


@pytest.fixture
def host() -> Iterator[Host]:
    need_root()
    with Lab("rosrv-door") as lab:
        yield lab.host("behind", "10.77.0.2/24")


@pytest.fixture
def echo(host: Host) -> Iterator[tuple[str, int]]:
    listener = host.run(lambda: socket.create_server(("127.0.0.1", 0)))

    def serve() -> None:
        while True:
            try:
                peer, _ = listener.accept()
            except OSError:
                return
            threading.Thread(target=answer, args=(peer,), daemon=True).start()

    def answer(peer: socket.socket) -> None:
        with peer:
            while piece := peer.recv(65536):
                peer.sendall(piece)

    threading.Thread(target=serve, daemon=True).start()
    yield listener.getsockname()
    listener.shutdown(socket.SHUT_RDWR)
    listener.close()


def receive_all(connection: socket.socket) -> bytes:
    pieces = []
    while piece := connection.recv(65536):
        pieces.append(piece)
    return b"".join(pieces)


def test_bytes_pass_both_ways(host: Host, echo: tuple[str, int]) -> None:
    sent = bytes(range(256)) * 4096
    with Doorway(host, echo) as door, socket.create_connection(("127.0.0.1", door.port), LIMIT) as client:

        def write() -> None:
            client.sendall(sent)
            client.shutdown(socket.SHUT_WR)

        writer = threading.Thread(target=write)
        writer.start()
        assert receive_all(client) == sent
        writer.join(LIMIT)


def test_no_listener_behind_it(host: Host) -> None:
    unused = host.run(lambda: socket.create_server(("127.0.0.1", 0)))
    target = unused.getsockname()
    unused.close()
    with Doorway(host, target) as door:
        for _ in range(CONNECTIONS + 1):  # none of them keeps its slot
            with socket.create_connection(("127.0.0.1", door.port), LIMIT) as client:
                assert client.recv(1) == b""


def test_closing_ends_as_many_connections_as_are_permitted(host: Host, echo: tuple[str, int]) -> None:
    clients = []
    with Doorway(host, echo) as door:
        for _ in range(CONNECTIONS):
            clients.append(socket.create_connection(("127.0.0.1", door.port), LIMIT))
            clients[-1].sendall(b"hello")
            assert clients[-1].recv(5) == b"hello"
    for client in clients:
        with client:
            assert client.recv(1) == b""
    assert "doorway" not in {thread.name for thread in threading.enumerate()}


def test_a_doorway_at_its_limit_closes_while_the_target_does_not_answer() -> None:
    """No connection to the target ends, and closing does not wait for one."""
    silence, waiting = threading.Event(), threading.Semaphore(0)

    class SilentHost:
        def run(self, _connect: object) -> socket.socket:
            waiting.release()
            silence.wait(LIMIT)
            raise OSError("no answer")

    with Doorway(cast(Host, SilentHost()), ("192.0.2.1", 1)) as door:
        clients = [socket.create_connection(("127.0.0.1", door.port), LIMIT) for _ in range(CONNECTIONS)]
        assert all(waiting.acquire(timeout=LIMIT) for _ in clients)
    assert "doorway" not in {thread.name for thread in threading.enumerate()}
    silence.set()
    for client in clients:
        client.close()


def test_closing_ends_open_connections(host: Host, echo: tuple[str, int]) -> None:
    with Doorway(host, echo) as door:
        client = socket.create_connection(("127.0.0.1", door.port), LIMIT)
        client.sendall(b"hello")
        assert client.recv(5) == b"hello"
    with client:
        assert client.recv(1) == b""
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", door.port), LIMIT).close()
