import os
import socket
from collections.abc import Iterator

import pytest

from appliance.supervisor.listener_store import ListenerRejectedError, ListenerStore

pytestmark = pytest.mark.usefixtures("sockets")


@pytest.fixture
def kept() -> Iterator[ListenerStore]:
    sockets = ListenerStore(limit=2)
    yield sockets
    sockets.close()


def _listening() -> int:
    return socket.create_server(("127.0.0.1", 0)).detach()


def _is_open(descriptor: int) -> bool:
    try:
        os.fstat(descriptor)
    except OSError:
        return False
    return True


def test_a_kept_socket_is_there_until_it_is_dropped(kept: ListenerStore) -> None:
    descriptor = _listening()
    kept.keep("outer:a1", descriptor)
    assert list(kept) == [("outer:a1", descriptor)]
    kept.drop("outer:a1")
    assert list(kept) == []
    assert not _is_open(descriptor)


def test_a_name_stands_for_one_socket(kept: ListenerStore) -> None:
    first, second, other = _listening(), _listening(), _listening()
    kept.keep("other", other)
    kept.keep("rvmaster", first)
    kept.keep("rvmaster", second)
    assert dict(kept) == {"rvmaster": second, "other": other}
    assert not _is_open(first)


def test_there_is_a_bound(kept: ListenerStore) -> None:
    kept.keep("one", _listening())
    kept.keep("two", _listening())
    third = _listening()
    with pytest.raises(ListenerRejectedError, match="exceeds the limit"):
        kept.keep("three", third)
    assert len(kept) == 2
    assert not _is_open(third)


@pytest.mark.parametrize("name", ["", "a b", "a\n", "-a", "x" * 201, "\u00e4", "a\0"])
def test_only_plain_names_are_accepted(kept: ListenerStore, name: str) -> None:
    descriptor = _listening()
    with pytest.raises(ListenerRejectedError, match="not a valid name"):
        kept.keep(name, descriptor)
    assert not _is_open(descriptor)


def test_only_listening_sockets_are_kept(kept: ListenerStore) -> None:
    read_end, write_end = os.pipe()
    os.close(write_end)
    with pytest.raises(ListenerRejectedError, match="not a socket"):
        kept.keep("pipe", read_end)
    idle = socket.socket().detach()
    with pytest.raises(ListenerRejectedError, match="does not listen"):
        kept.keep("idle", idle)
    assert not _is_open(read_end)
    assert not _is_open(idle)
