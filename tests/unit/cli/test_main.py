"""Tests of `appliance.cli.main`."""

import json
import subprocess
import sys

import pytest

from appliance import __version__
from appliance.cli import main
from appliance.configuration.config_sources import ConfigError, Mistake
from appliance.network.namespaces import NetworkError
from appliance.supervisor.errors import StartError
from tests.support.command import ROSRV


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


def said_by(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str
) -> tuple[object, str]:
    """Exit status and all that was said for these arguments."""
    monkeypatch.setattr(sys, "argv", ["rosrv", *arguments])
    with pytest.raises(SystemExit) as ended:
        main.main()
    shown = capsys.readouterr()
    return ended.value.code, shown.out + shown.err


def test_the_version_is_told(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """`--version` says it in a line; `version --json` also what it stands on, as a report of a defect needs."""
    assert said_by(monkeypatch, capsys, "--version") == (0, f"rosrv {__version__}\n")
    status, text = said_by(monkeypatch, capsys, "version", "--json")
    facts = json.loads(text)
    assert (status, facts["version"]) == (0, __version__)
    versions = {part["name"]: part["version"] for part in facts["parts"] if part["kind"] == "python"}
    assert versions["fastapi"]
    assert facts["in_use"] is None


@pytest.mark.parametrize(
    "words",
    [("policy", "reload", "-h"), ("help", "policy", "reload"), ("policy", "help", "reload")],
)
def test_help_is_found_in_every_usual_way(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: tuple[str, ...]
) -> None:
    """`-h` and `help VERB` are what `VERB --help` is."""
    assert said_by(monkeypatch, capsys, *words) == said_by(monkeypatch, capsys, "policy", "reload", "--help")


@pytest.mark.parametrize(
    ("words", "meant"), [(("polcy",), "policy"), (("monitor", "lst"), "list"), (("policy", "chek"), "check")]
)
def test_a_mistyped_verb_is_told_the_nearest(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], meant: str
) -> None:
    """Exit status 2, and the verb that was probably meant."""
    status, text = said_by(monkeypatch, capsys, *words)
    assert status == 2
    assert f"Did you mean '{meant}'?" in text


def test_a_verb_near_to_none_is_told_which_there_are(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As `rostopic list` has it, where the verbs of `topic` are others."""
    status, text = said_by(monkeypatch, capsys, "topic", "list")
    assert status == 2
    assert "No such command 'list'; there are: echo, info." in text


@pytest.mark.parametrize("verb", [("config", "show"), ("policy", "check", "/dev/null"), ("--help",)])
@pytest.mark.parametrize(("output", "status"), [("> /dev/full", 2), (">&-", 0), ("<&- >&- 2>&-", 0)])
def test_an_output_that_takes_nothing(verb: tuple[str, ...], output: str, status: int) -> None:
    """A full disk is said in words; closed streams are as /dev/null. Neither is a defect."""
    command = ["/bin/sh", "-c", f'exec "$0" "$@" {output}', ROSRV, *verb]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (
        status,
        "rosrv: output: No space left on device\n" if status else "",
    )
