"""Tests of the port scan on loopback."""

import resource
import socket
from pathlib import Path

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


def test_few_files_make_a_scan_slower_and_no_error() -> None:
    """A process that may open few files scans with fewer connections at once."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    open_now = max(int(entry.name) for entry in Path("/proc/self/fd").iterdir())
    with socket.create_server(("127.0.0.1", 0), backlog=500) as server:
        resource.setrlimit(resource.RLIMIT_NOFILE, (open_now + 40, hard))
        try:
            result = scan("127.0.0.1", [server.getsockname()[1]] * 300, seconds=10)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert len(result.open) == 300


def test_a_scan_of_no_ports_ends() -> None:
    """Nothing to scan is nothing found, and nothing answered."""
    assert not scan("127.0.0.1", [], seconds=10).answered


def test_the_machine_itself_is_not_another() -> None:
    """The machine's own addresses are refused for a check from outside."""
    for address in ("127.0.0.1", "::1", "localhost"):
        with pytest.raises(NetworkError, match="is this machine"):
            addresses_of(address)
