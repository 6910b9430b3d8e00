"""Tests of `rosrv status`: one screen, whatever there is to show."""

import datetime
import io
import time
from typing import Any

import msgspec
import pytest
from rich.console import Console

from appliance.channel.answers.status import ProcessInfo, Status
from appliance.cli import status_verb
from appliance.cli.status_view import age, processes_table, shortened
from tests.support.answers import example

ROLES = ("supervisor", "rosmaster", "signer", *["relay"] * 4, "control", "rosout", "api", "charon", "syslog")


def rows(count: int = len(ROLES), restarts: int = 0) -> list[ProcessInfo]:
    """Processes as the status has them."""
    since = (datetime.datetime.now(datetime.UTC) - datetime.timedelta(hours=30)).isoformat()
    return [
        ProcessInfo(role, 4_194_300 - number, since, restarts, "listed calls, Landlock 7" if number else "")
        for number, role in enumerate(ROLES[:count])
    ]


def body(**more: Any) -> Status:
    """A large appliance: everything there is, names as long as they get."""
    fields: dict[str, Any] = {
        "version": "0.1.0", "since": time.time() - 100_000, "master": "http://10.113.11.1:11311", "processes": rows(),
        "isolation": "netns", "relaying": "all", "mediation": "full", "probe": "passed",
        "firewall": {"backend": "nft", "translations": ["one", "another"], "obstacles": ["a third"]},
        "policy": {"revision": 12, "file": "/etc/rosrv/policies/robot.ini", "source": "x", "who": "alice",
                   "differs_from_file": True, "warnings": 3},
        "ipsec": {"esp": "kernel", "up": 3, "enrolled": 4, "key_exchange": ["x25519"],
                  "ports": {"10.0.0.9": {"state": "open"}}},
        "monitors": {"revision": 7, "loaded": 12, "enabled": 11, "who": "bob", "differs_from_folder": True},
        "rosmaster": "reachable", "relay": "connected", "nodes": 61, "shadows": 2, "topics": 240, "services": 400,
        "connections": 512, "messages": 123_456_789, "dropped": 17,
        "audit": {"lag_records": 3, "lag_seconds": 0.1, "forwarding": {"to": "tls:10.0.0.7:6514", "behind": 12}},
    }  # fmt: skip
    return example(Status, **fields | more)


def screen(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], width: int, shown: Status
) -> list[str]:
    """The lines on a terminal of this width."""
    monkeypatch.setenv("COLUMNS", str(width))
    status_verb.show(shown, status_verb.troubles_of(shown))
    return capsys.readouterr().out.splitlines()


@pytest.mark.parametrize("width", [80, 100, 160])
def test_a_large_appliance_fits_one_screen(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], width: int
) -> None:
    """Twelve processes, tunnels, monitors, forwarding: 24 lines of 80 columns hold it, and nothing is cut off."""
    lines = screen(monkeypatch, capsys, width, body())
    assert len(lines) < 24, "\n".join(lines)
    assert all(len(line.rstrip()) <= width for line in lines)
    text = " ".join(" ".join(lines).split())
    for words in (
        "http://10.113.11.1:11311",
        "relay 3",
        "4194300",
        "61 nodes (2 lost, awaited)",
        "probe passed",
        "2 chains to translate addresses, not towards the appliance; 1 chain to drop what is forwarded",
    ):
        assert words in text


def test_many_troubles_leave_room_for_the_rest(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The most pressing come first; of more than five it is said how many there are and where to see them."""
    ends = [f"the certificate of host-{number} ends soon" for number in range(9)]
    shown = body(audit={"failed": "disk full"}, ipsec={"troubles": ends})
    lines = screen(monkeypatch, capsys, 80, shown)
    assert lines[0] == "! the audit log cannot be written: disk full"
    assert "and 6 more: rosrv status --json" in lines[4]
    assert len(lines) < 24 + 5


@pytest.mark.parametrize(("width", "across"), [(40, 1), (80, 2), (130, 3), (400, 3)])
def test_every_process_is_shown_once(width: int, across: int) -> None:
    """However many columns there are, each process is in one place, with its number where a role has several."""
    console = Console(width=width, file=io.StringIO())
    console.print(processes_table(rows(), width))
    text = console.file.getvalue()  # type: ignore[attr-defined]  # a StringIO
    assert len(text.splitlines()) == 1 + -(-len(ROLES) // across)
    for row in rows():
        assert text.count(str(row.pid)) == 1
    assert [name in text for name in ("relay 0", "relay 3", "relay 4", "control 0")] == [
        True,
        True,
        False,
        False,
    ]


def test_ages_are_two_units() -> None:
    """Seconds, minutes, hours, days; never negative."""
    now = 1_000_000.0
    found = [age(now - back, now) for back in (-5, 3, 61, 3600, 90_000)]
    assert found == ["0 s", "3 s", "1 min 1 s", "1 h 0 min", "1 d 1 h"]


def test_few_lines_stay_as_they_are() -> None:
    """Nothing is said of more where there is no more."""
    assert shortened(["a", "b"], 2) == ["a", "b"]
    assert shortened(["a", "b", "c"], 2) == ["a", "and 2 more: rosrv status --json"]


def test_that_not_everything_is_carried_is_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`--relay monitored` is no boundary, and the status says so; of the default it says nothing."""
    monitored = " ".join(screen(monkeypatch, capsys, 160, body(relaying="monitored")))
    assert "only what is monitored: NO BOUNDARY" in monitored
    assert "NO BOUNDARY" not in " ".join(screen(monkeypatch, capsys, 160, body()))


def test_what_a_kernel_lacks_of_the_walls_is_shown(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where all stand that is said in two words; else the first that is lacking is named, and how many more."""
    shown = body()
    assert any("processes walled in" in line for line in screen(monkeypatch, capsys, 80, shown))
    starting = body()
    starting.processes[-1] = msgspec.structs.replace(starting.processes[-1], walls="")
    assert "walled in" not in "\n".join(screen(monkeypatch, capsys, 100, starting)), "one has not said it yet"
    for row in shown.processes[2:4]:
        row.lacks.append("no Landlock")
    lines = "\n".join(screen(monkeypatch, capsys, 100, shown))
    assert "walled in" not in lines
    assert "signer: no Landlock and 1 more (rosrv status --json)" in lines


def test_a_policy_that_refuses_nothing_is_said_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In the line of the policy, with the sections; a policy in force says nothing of it."""
    trial = screen(monkeypatch, capsys, 160, body(policy={"audit_only": ["Nodes", "Publishers"]}))
    assert any("AUDIT-ONLY: refuses nothing by Nodes, Publishers" in line for line in trial)
    assert "AUDIT-ONLY" not in " ".join(screen(monkeypatch, capsys, 160, body()))
