"""Tests of `appliance.cli.main`."""

import sys

import pytest

from appliance.cli import main
from appliance.config_sources import ConfigError, Mistake
from appliance.network.namespaces import NetworkError
from appliance.supervisor.errors import StartError


@pytest.mark.parametrize(
    "error",
    [
        StartError("port 1 is in use"),
        NetworkError("port 1 is in use"),
        ConfigError([Mistake("a:1", "port 1 is in use")]),
    ],
)
def test_what_a_user_can_mend_is_told_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: Exception
) -> None:
    """Exit status 1 and the message; no traceback."""
    assert outcome(monkeypatch, error) == 1
    said = capsys.readouterr().err
    assert said.startswith("rosrv: ")
    assert said.endswith("port 1 is in use\n")
    assert said.count("\n") == 1


def test_a_defect_is_told_with_its_place(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Another exit status, what and where, and that it should be reported."""
    assert outcome(monkeypatch, ZeroDivisionError("odd")) == 70
    said = capsys.readouterr().err
    assert "please report it: ZeroDivisionError: odd (" in said
    assert "test_main.py:" in said
    assert "Traceback" not in said


def test_help_names_every_verb(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """A newcomer sees what there is."""
    monkeypatch.setattr(sys, "argv", ["rosrv", "--help"])
    with pytest.raises(SystemExit) as ended:
        main.main()
    assert ended.value.code == 0
    said = capsys.readouterr().out
    assert all(verb in said for verb in ("up", "policy", "config"))


def outcome(monkeypatch: pytest.MonkeyPatch, error: Exception) -> object:
    """The exit status of a command that raises `error`."""

    def fail() -> None:
        raise error

    monkeypatch.setattr(main, "app", fail)
    with pytest.raises(SystemExit) as ended:
        main.main()
    return ended.value.code
