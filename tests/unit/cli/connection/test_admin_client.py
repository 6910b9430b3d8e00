import socket
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from appliance.channel.admin import TokenAdd
from appliance.channel.operations import OPERATIONS
from appliance.cli.connection import admin_client
from appliance.cli.connection.admin_client import AdminSocket, NotRunningError

NO_TEXT = "alice\udcff"


def test_it_waits_for_the_slowest_answer() -> None:
    assert max(operation.seconds for operation in OPERATIONS) < admin_client.SECONDS


@pytest.mark.real
def test_an_appliance_that_ends_during_an_order_leaves_its_outcome_open(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server, ThreadPoolExecutor() as pool:
        server.bind(str(tmp_path / admin_client.ADMIN_SOCKET))
        server.listen()
        for most in (
            10,
            65536,
        ):  # bytes read before the end: with unread ones, the kernel resets the connection
            asked = pool.submit(AdminSocket(tmp_path).ask, TokenAdd("ann", "viewer", 60.0))
            connection, _address = server.accept()
            connection.recv(most)
            connection.close()
            error = asked.exception(10)
            assert isinstance(error, NotRunningError)
            assert admin_client.UNKNOWN in str(error)
            assert "the appliance " in str(error)


def test_undecodable_bytes_are_an_error(tmp_path: Path) -> None:
    with pytest.raises(NotRunningError, match=r"'alice\\udcff' is not valid UTF-8"):
        AdminSocket(tmp_path).ask(TokenAdd(NO_TEXT, "viewer", 60.0))
