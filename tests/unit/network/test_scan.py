"""Tests of the port scan on loopback."""

import socket

import pytest

from appliance.network.namespaces import NetworkError
from appliance.network.scan import addresses_of, scan


def test_open_and_refused_ports_are_told_apart() -> None:
    """A port with a listener is open, one that is bound without listening is refused."""
    with socket.create_server(("127.0.0.1", 0)) as server, socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        listening, bound = server.getsockname()[1], closed.getsockname()[1]
        result = scan("127.0.0.1", [listening, bound], seconds=10)
    assert (result.open, result.refused, result.silent, result.answered) == ((listening,), 1, 0, True)


def test_a_scan_of_no_ports_ends() -> None:
    """Nothing to scan is nothing found, and nothing answered."""
    assert not scan("127.0.0.1", [], seconds=10).answered


def test_the_machine_itself_is_not_another() -> None:
    """The machine's own addresses are refused for a check from outside."""
    for address in ("127.0.0.1", "::1", "localhost"):
        with pytest.raises(NetworkError, match="is this machine"):
            addresses_of(address)
