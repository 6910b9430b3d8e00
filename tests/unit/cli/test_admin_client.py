"""Tests of `appliance.cli.admin_client`: how long it waits, and words that cannot be sent."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from appliance.api.host_routes import SLOW_SECONDS
from appliance.channel.admin import TokenAdd
from appliance.cli import admin_client
from appliance.cli.admin_client import AdminSocket, NotRunningError
from appliance.cli.main import app

NO_TEXT = "alice\udcff"


def test_it_waits_for_the_slowest_answer() -> None:
    """Longer than REST waits for control's slowest, a new host that waits for the tunnels' process."""
    assert admin_client.SECONDS > SLOW_SECONDS


def test_bytes_that_are_no_text_are_told(tmp_path: Path) -> None:
    """The word is shown, and what is wrong with it; nothing is sent."""
    with pytest.raises(NotRunningError, match=r"'alice\\udcff' is not UTF-8"):
        AdminSocket(tmp_path).ask(TokenAdd(NO_TEXT, "viewer", 60.0))


@pytest.mark.parametrize(
    "arguments",
    [
        ("token", "add", NO_TEXT), ("monitor", "enable", NO_TEXT), ("monitor", "remove", "a", NO_TEXT),
        ("audit", "search", "--host", NO_TEXT), ("audit", "export", "--text", NO_TEXT),
        ("audit", "show", NO_TEXT),
    ],
)  # fmt: skip
@pytest.mark.parametrize("way", [("--state", "/nowhere"), ("--api", "http://127.0.0.1:9")])
def test_no_verb_ends_in_a_defect_for_them(way: tuple[str, str], arguments: tuple[str, ...]) -> None:
    """Exit status 1 or 2 and a sentence, over the socket and over REST."""
    token = "rosrv_5c0f3d2b9a11_" + "x" * 43
    done = CliRunner().invoke(app, [*arguments, *way], env={"ROSRV_TOKEN": token})
    assert isinstance(done.exception, SystemExit), done.exception
    assert done.exit_code in (1, 2)
    assert "rosrv: " in done.output
