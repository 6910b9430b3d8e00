import socket
import threading
from collections.abc import Iterator

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


def test_closing_ends_open_connections(host: Host, echo: tuple[str, int]) -> None:
    with Doorway(host, echo) as door:
        client = socket.create_connection(("127.0.0.1", door.port), LIMIT)
        client.sendall(b"hello")
        assert client.recv(5) == b"hello"
    with client:
        assert client.recv(1) == b""
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", door.port), LIMIT).close()
