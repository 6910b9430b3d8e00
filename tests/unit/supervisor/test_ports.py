"""Tests of `appliance.supervisor.ports`."""

import os
import socket

import pytest

from appliance.supervisor.errors import StartError
from appliance.supervisor.ports import free_port, require_free


def test_a_free_port_is_free() -> None:
    """The port that is chosen can be listened on."""
    require_free("127.0.0.1", free_port())


def test_a_taken_port_is_told_with_its_owner() -> None:
    """The message names the port and the process that has it."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(StartError, match=rf"port {port} .* in use by process {os.getpid()} \("):
            require_free("0.0.0.0", port)


def test_a_port_is_free_again_when_only_old_connections_linger() -> None:
    """A port whose listener is gone is not refused because of a connection in TIME_WAIT."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        client = socket.create_connection(("127.0.0.1", port))
        served, _address = listener.accept()
        served.close()  # closed here first: this end keeps the port in TIME_WAIT
        client.close()
    require_free("127.0.0.1", port)


def test_an_address_of_another_machine_is_an_error() -> None:
    """Listening where this machine has no address is refused in words."""
    with pytest.raises(StartError, match=r"cannot listen on 192\.0\.2\.1:1"):
        require_free("192.0.2.1", 1)
