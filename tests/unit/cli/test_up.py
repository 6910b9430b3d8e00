import errno
import io
import json
import stat
import sys
from pathlib import Path

import msgspec
import pytest
from structlog.testing import capture_logs

from appliance.cli import up
from appliance.cli.up import _announce
from appliance.configuration.settings import Settings
from appliance.supervisor.errors import StartError
from appliance.supervisor.supervisor import ControlReady

READY = ControlReady("http://127.0.0.1:11311", 1, "http://127.0.0.1:2", 3, 4, "secret")


def a_terminal(monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    """Let standard error be a terminal, and return it."""
    shown = io.StringIO()
    monkeypatch.setattr(shown, "isatty", lambda: True)
    monkeypatch.setattr(sys, "stderr", shown)
    return shown


def test_the_first_token_is_in_its_file_before_the_line_is_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    terminal = a_terminal(monkeypatch)
    _announce(READY, Settings(state=tmp_path, api="127.0.0.1:8443"), as_json=False)
    kept = tmp_path / "first-token"
    assert (kept.read_text(), stat.S_IMODE(kept.stat().st_mode)) == ("secret\n", 0o600)
    assert capsys.readouterr().out.count("\n") == 1
    assert terminal.getvalue().endswith(
        f"Console: https://127.0.0.1:8443/console/\nREST: https://127.0.0.1:8443\n"
        f"The first access token (admin) is in {kept}\n"
    )


def test_a_container_prints_the_address_that_a_browser_reaches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(up, "own_address", lambda _settings: "172.29.76.2")
    with capture_logs() as said:
        _announce(READY, Settings(state=tmp_path, api="0.0.0.0:8443", api_published=False), as_json=False)
    assert "Console: https://127.0.0.1:8443/console/" in [str(one["event"]) for one in said]


def test_without_a_terminal_all_lines_are_of_the_log(tmp_path: Path) -> None:
    with capture_logs() as said:
        _announce(READY, Settings(state=tmp_path, api="127.0.0.1:8443"), as_json=False)
    assert [str(one["event"]).partition(":")[0] for one in said] == [
        "Nodes may connect",
        "Nodes on other machines",
        "Console",
        "REST",
        f"The first access token (admin) is in {tmp_path / 'first-token'}",
    ]


def test_the_policys_warnings_are_printed_at_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    terminal = a_terminal(monkeypatch)
    said = msgspec.structs.replace(
        READY, token=None, warnings=tuple(f"p.ini:{n}:1: warning" for n in range(12))
    )
    settings = Settings(state=tmp_path, api="off", policy=Path("p.ini"))
    _announce(said, settings, as_json=False)
    assert capsys.readouterr().out.count("\n") == 1
    assert "p.ini:9:1: warning\nand 2 more warnings: rosrv policy check p.ini\n" in terminal.getvalue()
    _announce(said, settings, as_json=True)
    event = json.loads(capsys.readouterr().out)
    assert event["warnings"] == [*said.warnings]


def test_an_unwritable_first_token_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(StartError, match=r"gone/first-token: No such file.*next start creates another"):
        _announce(READY, Settings(state=tmp_path / "gone", api="off"), as_json=False)
    assert capsys.readouterr().out == ""


def test_a_partial_token_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_descriptor: int, _data: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("appliance.cli.up.os.write", full)
    with pytest.raises(StartError, match="No space left on device"):
        _announce(READY, Settings(state=tmp_path, api="off"), as_json=False)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("as_json", [False, True])
def test_a_closed_standard_output_does_not_end_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, as_json: bool
) -> None:
    def full() -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    closed = io.StringIO()
    monkeypatch.setattr(closed, "flush", full)
    a_terminal(monkeypatch)
    monkeypatch.setattr(sys, "stdout", closed)
    with capture_logs() as said:
        _announce(READY, Settings(state=tmp_path, api="off"), as_json=as_json)
    assert (tmp_path / "first-token").read_text() == "secret\n"
    assert said[0]["first_token"] == str(tmp_path / "first-token")
