import ipaddress
import socket

import pytest

from appliance.policy.model import plain_address
from appliance.rpc.server import listen
from tests.support.http_server import WAIT

pytestmark = pytest.mark.anyio


@pytest.mark.parametrize(
    ("text", "plain"),
    [("10.0.0.1", "10.0.0.1"), ("::ffff:10.0.0.1", "10.0.0.1"), ("fe80::1%eth0", "fe80::1"), ("::1", "::1")],
)
def test_plain_address(text: str, plain: str) -> None:
    assert plain_address(text) == ipaddress.ip_address(plain)


@pytest.mark.nightly
def test_listen_on_both_families() -> None:
    with listen("::", 0) as sock, socket.create_connection(("127.0.0.1", sock.getsockname()[1]), WAIT):
        accepted, address = sock.accept()
        accepted.close()
        assert plain_address(address[0]) == ipaddress.ip_address("127.0.0.1")


@pytest.mark.nightly
def test_listen_on_a_port_in_use() -> None:
    with listen("127.0.0.1", 0) as sock, pytest.raises(OSError, match="in use"):
        listen("127.0.0.1", sock.getsockname()[1])
