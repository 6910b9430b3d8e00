"""Tests of `rosrv protect` as a verb of the command."""

import json
from typing import Any

import msgspec
import pytest
from typer.testing import CliRunner

from appliance.channel.admin import AdminAnswer, AdminRequest, HostPorts
from appliance.channel.answers.host_answers import PortsTold
from appliance.channel.answers.status import Status
from appliance.cli.admin_client import AdminSocket, NotRunningError
from appliance.cli.main import app
from appliance.network.scan import ScanResult
from tests.support.answers import example


def test_the_file_is_printed() -> None:
    """`rosrv protect` prints a file that nft reads, with the appliance's address and the range."""
    result = CliRunner().invoke(app, ["protect", "--appliance", "192.168.1.20", "--ports", "40000-40099"])
    assert result.exit_code == 0
    assert result.stdout.startswith("#!/usr/sbin/nft -f\n")
    assert "ip saddr { 192.168.1.20 } accept" in result.stdout


def test_the_help_has_examples_and_says_how_to_keep_it() -> None:
    """The help shows the commands to use, and what to do so that the rules outlive a boot."""
    text = CliRunner().invoke(app, ["protect", "--help"]).stdout
    for words in ("--apply", "--check 192.168.1.10", "systemctl enable --now nftables"):
        assert words in text


def answering(monkeypatch: pytest.MonkeyPatch, body: msgspec.Struct | None) -> list[AdminRequest[Any]]:
    """An appliance that answers with this, or (None) none at all; what it was asked."""
    asked: list[AdminRequest[Any]] = []

    def ask(_self: AdminSocket, request: AdminRequest[Any]) -> AdminAnswer[Any]:
        asked.append(request)
        if body is None:
            raise NotRunningError("/var/lib/rosrv: no appliance runs with this state directory")
        return AdminAnswer(True, body)

    monkeypatch.setattr(AdminSocket, "ask", ask)
    return asked


def test_the_appliance_is_the_running_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without --appliance it is asked how the robot sees it; with it nothing is asked."""
    asked = answering(monkeypatch, example(Status, isolation="netns", master="http://10.200.0.2:11311"))
    result = CliRunner().invoke(app, ["protect", "--ports", "40000-40099", "--state", "/var/lib/rosrv"])
    assert result.exit_code == 0, result.output
    assert "ip saddr { 10.200.0.2 } accept" in result.stdout
    assert len(asked) == 1
    CliRunner().invoke(app, ["protect", "--appliance", "192.168.1.20", "--ports", "40000"])
    assert len(asked) == 1


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (None, "no appliance runs"),
        (example(Status, isolation="none", master="http://127.0.0.1:11311"), "without isolation"),
    ],
)
def test_an_appliance_that_cannot_be_known_is_to_be_named(
    monkeypatch: pytest.MonkeyPatch, body: Status | None, said: str
) -> None:
    """The error says why, and how to name it."""
    answering(monkeypatch, body)
    result = CliRunner().invoke(app, ["protect", "--ports", "40000-40099"])
    assert result.exit_code == 2
    assert said in result.stderr
    assert "--appliance 192.168.1.20" in result.stderr


def test_what_a_check_saw_is_told_where_an_appliance_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Under the name of the host, with the ports that were open; nobody is told when no appliance was named."""
    asked = answering(monkeypatch, example(PortsTold, name="ocu"))
    monkeypatch.setattr(
        "appliance.cli.protect_verb.scan", lambda address, _ports, _s: ScanResult(address, (40001,), 99, 0)
    )
    check = ["protect", "--check", "192.0.2.7", "--ports", "40000-40099"]
    assert CliRunner().invoke(app, check).exit_code == 1
    assert asked == []
    result = CliRunner().invoke(app, [*check, "--as", "ocu", "--state", "/var/lib/rosrv"])
    assert result.exit_code == 1
    (told,) = asked
    assert isinstance(told, HostPorts)
    assert (told.name, told.state, told.open) == ("ocu", "open", [40001])
    assert "the ports of ocu are open" in result.stderr


@pytest.mark.parametrize(
    ("result", "status", "state", "words"),
    [
        (ScanResult("192.0.2.7", (), 98, 0, 2, "Operation not permitted"), 2, "unknown", "2 ports of"),
        (ScanResult("192.0.2.7", (40001,), 0, 0, 99, "Network is unreachable"), 1, "open", "OPEN: TCP 40001"),
        (ScanResult("192.0.2.7", (), 100, 0), 0, "closed", "closed: no port"),
    ],
)
def test_ports_that_could_not_be_tried_are_not_closed(
    monkeypatch: pytest.MonkeyPatch, result: ScanResult, status: int, state: str, words: str
) -> None:
    """One port that no packet was sent to, and the machine's state is unknown; one that is open, and it is open."""
    monkeypatch.setattr("appliance.cli.protect_verb.scan", lambda *_arguments: result)
    check = ["protect", "--check", "192.0.2.7", "--ports", "40000-40099"]
    done = CliRunner().invoke(app, check)
    assert done.exit_code == status
    assert words in done.stdout
    said = json.loads(CliRunner().invoke(app, [*check, "--json"]).stdout)
    assert (said["state"], said["addresses"][0]["untried"]) == (state, result.untried)
