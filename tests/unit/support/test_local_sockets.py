import asyncio
import errno
import select
import socket
import struct
from collections.abc import Iterator

import pytest

from appliance.base import clock
from tests.support.autojump import DeadlockError, LocalLoop, RealLoopError, autojump
from tests.support.determinism import WATCH, ChanceError

pytestmark = pytest.mark.usefixtures("local_sockets")


@pytest.fixture
def listening() -> Iterator[socket.socket]:
    with socket.create_server(("0.0.0.0", 0)) as sock:
        yield sock


def test_both_ends_have_the_addresses_of_tcp(listening: socket.socket) -> None:
    port = listening.getsockname()[1]
    with socket.create_connection(("10.0.0.2", port), source_address=("10.0.0.9", 0)) as near:
        far, address = listening.accept()
        with far:
            assert address == far.getpeername() == near.getsockname()
            assert address[0] == "10.0.0.9"
            assert near.getpeername() == ("10.0.0.2", port)
    with socket.create_connection(("10.0.0.2", port)) as near, listening.accept()[0] as far:
        assert far.getsockname() == near.getpeername() == ("10.0.0.2", port)


def test_a_listening_socket_keeps_its_address_in_another_object(listening: socket.socket) -> None:
    with socket.socket(fileno=listening.dup().detach()) as other:
        assert other.getsockname() == listening.getsockname()


def test_a_port_without_a_listener_refuses_as_over_tcp() -> None:
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", 9))
    with socket.socket() as sock:
        sock.setblocking(False)
        assert sock.connect_ex(("127.0.0.1", 9)) == errno.EINPROGRESS
        assert select.select([], [sock], [], 0)[1] == [sock]
        assert [sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) for _ in range(2)] == [
            errno.ECONNREFUSED,
            0,
        ]


@pytest.mark.parametrize("who", ["client", "server"])
def test_an_end_with_linger_0_resets_the_connection(who: str, listening: socket.socket) -> None:
    near = socket.create_connection(listening.getsockname())
    far = listening.accept()[0]
    resets, other = (near, far) if who == "client" else (far, near)
    resets.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    resets.close()
    with other, pytest.raises(ConnectionResetError):
        other.recv(1)


def test_a_closed_end_is_the_end_of_the_bytes(listening: socket.socket) -> None:
    with socket.create_connection(listening.getsockname()) as near:
        near.sendall(b"last")
    far = listening.accept()[0]
    with far:
        assert (far.recv(10), far.recv(10)) == (b"last", b"")


def test_a_test_sees_no_other_network_than_its_own() -> None:
    """The ports are the same in each test."""
    with socket.create_server(("127.0.0.1", 0)) as sock, pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", sock.getsockname()[1] + 1))


@pytest.mark.anyio
async def test_time_passes_while_no_socket_is_ready() -> None:
    async def late(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await asyncio.sleep(3600)
        writer.write(await reader.readexactly(2))
        writer.close()

    assert isinstance(asyncio.get_running_loop(), LocalLoop)
    async with await asyncio.start_server(late, "127.0.0.1", 0) as server:
        reader, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
        began = clock.now()
        writer.write(b"hi")
        assert await reader.read() == b"hi"
        writer.close()
    assert clock.now() - began == pytest.approx(3600)


def test_a_wait_without_end_fails_at_once() -> None:
    async def wait() -> None:
        await asyncio.get_running_loop().sock_accept(sock)

    with socket.create_server(("127.0.0.1", 0)) as sock, autojump(kind=LocalLoop) as new_loop:
        sock.setblocking(False)
        with (
            asyncio.Runner(loop_factory=new_loop) as runner,
            pytest.raises(DeadlockError, match="sock_accept"),
        ):
            runner.run(wait())


@pytest.mark.anyio
async def test_a_program_stays_forbidden() -> None:
    with pytest.raises(RealLoopError):
        await asyncio.create_subprocess_exec("true")


def test_a_real_socket_stays_forbidden() -> None:
    real = socket.socket.__bases__[0]
    with WATCH.watching(), pytest.raises(ChanceError):
        real()
