from pathlib import Path

import pytest

from appliance.channel.admin import TokenAdd
from appliance.channel.operations import OPERATIONS
from appliance.cli.connection import admin_client
from appliance.cli.connection.admin_client import AdminSocket, NotRunningError

NO_TEXT = "alice\udcff"


def test_it_waits_for_the_slowest_answer() -> None:
    assert max(operation.seconds for operation in OPERATIONS) < admin_client.SECONDS


def test_undecodable_bytes_are_an_error(tmp_path: Path) -> None:
    with pytest.raises(NotRunningError, match=r"'alice\\udcff' is not valid UTF-8"):
        AdminSocket(tmp_path).ask(TokenAdd(NO_TEXT, "viewer", 60.0))
