import os
import socket

import pytest

from appliance.supervisor.errors import StartError
from appliance.supervisor.port_check import first_free, free_port, require_free, spare_ports

pytestmark = pytest.mark.nightly


def test_a_free_port_is_free() -> None:
    require_free("127.0.0.1", free_port())


def test_a_taken_port_is_reported_with_its_owner() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(StartError, match=rf"port {port} .* in use by process {os.getpid()} \("):
            require_free("0.0.0.0", port)


def test_a_port_is_free_again_when_only_old_connections_linger() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        client = socket.create_connection(("127.0.0.1", port))
        served, _address = listener.accept()
        served.close()  # closed here first, so that this end keeps the port in TIME_WAIT
        client.close()
    require_free("127.0.0.1", port)


def test_an_address_of_another_machine_is_an_error() -> None:
    with pytest.raises(StartError, match=r"no interface of this machine has 192\.0\.2\.1"):
        require_free("192.0.2.1", 1)


def test_the_first_free_port() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        assert first_free(range(port, port + 20)) > port
        client = socket.create_connection(("127.0.0.1", port))
        served, _address = listener.accept()
        served.close()
        client.close()
    assert first_free(range(port, port + 20)) > port
    with pytest.raises(OSError, match=f"no port from {port} to {port} is free"):
        first_free(range(port, port + 1))


def test_spare_ports_overlap_none_that_are_taken() -> None:
    within = range(1024, 65_536)
    assert spare_ports(64, [range(32_768, 61_000)], within) == range(65_472, 65_536)
    assert spare_ports(64, [range(65_500, 65_501), range(60_000, 65_490)], within) == range(59_936, 60_000)
    with pytest.raises(StartError, match=r"make \[Ports\] range in the policy smaller"):
        spare_ports(64, [range(1024, 32_768), range(32_800, 65_536)], within)
