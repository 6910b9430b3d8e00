"""Tests of `rosrv host` as a person sees it; with a running appliance: tests/system/ipsec."""

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from appliance.channel.admin import AdminAnswer, AdminRequest, HostList, HostRevoke, HostToken
from appliance.cli.admin_socket import AdminSocket
from appliance.cli.main import app

PORTS: dict[str, Any] = {"state": "unknown", "checked": None, "open": [], "who": ""}
HOST: dict[str, Any] = {
    "name": "laptop", "address": "10.113.11.2", "state": "up", "groups": ["ocu"], "declared": True, "wanted": True,
    "divergence": "hosts.yaml keeps 10.113.11.9 for it", "serial": "1f", "enrolled": 1.0, "expires": 1795164925.0,
    "expires_soon": True, "renewing": False, "revoked": None, "remote": "192.168.1.7", "seconds": 5, "bytes_in": 10,
    "bytes_out": 20, "last_seen": 1795160000.0, "token_expires": None,
    "ports": PORTS | {"state": "closed", "checked": 1.0},
}  # fmt: skip
OVERVIEW = {
    "hosts": [
        HOST,
        HOST | {"name": "other", "state": "awaited", "groups": [], "token_expires": 1795164925.0},
    ],
    "machines": [{"address": "10.0.0.7", "nodes": 3, "ports": PORTS}],
    "troubles": ["look at this"],
}
TOKEN = {
    "name": "laptop", "address": "10.113.11.2", "token": "rosrv-enrol_x", "token_expires": 1795164925.0,
    "rest_port": 8443, "rest_trouble": "", "pin": "sha256//p=", "authority_fingerprint": "ab" * 32,
}  # fmt: skip


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[AdminRequest]:
    """What the appliance was asked; it answers."""
    requests: list[AdminRequest] = []

    def ask(_self: AdminSocket, request: AdminRequest) -> AdminAnswer:
        requests.append(request)
        match request:
            case HostList():
                return AdminAnswer(True, OVERVIEW)
            case HostToken():
                return AdminAnswer(True, TOKEN)
            case HostRevoke(name):
                return AdminAnswer(
                    True, {"name": name, "address": "10.113.11.2", "serial": "", "taken_back": 0}
                )
            case _:
                raise AssertionError(request)

    monkeypatch.setattr(AdminSocket, "ask", ask)
    return requests


def run(*arguments: str) -> Any:
    """The command, to its end."""
    return CliRunner().invoke(app, ["host", *arguments], env={"COLUMNS": "400"})


def test_the_list_says_all_of_it(asked: list[AdminRequest]) -> None:
    """Tunnel, bytes, certificate that ends soon, ports, groups, divergence; machines in clear text; troubles."""
    text = run("list").stdout
    for words in (
        "laptop", "10.113.11.2", "up", "from 192.168.1.7 for 5 s, 10 B in, 20 B out", "(soon!)", "ports closed",
        "in ocu", "(hosts.yaml keeps 10.113.11.9 for it)", "other", "token until", "10.0.0.7", "3 nodes in clear text",
        "ports never checked", "! look at this",
    ):  # fmt: skip
        assert words in text, words
    assert asked == [HostList()]


def test_a_group_of_hosts(asked: list[AdminRequest]) -> None:
    """Only those of the group, and nothing else."""
    text = run("list", "--group", "ocu").stdout
    assert "laptop" in text
    assert "other" not in text
    assert "10.0.0.7" not in text
    assert asked


def test_a_token_and_its_script(asked: list[AdminRequest], tmp_path: Path) -> None:
    """The token alone is on standard output; the script is its owner's, has no token in it, and replaces nothing."""
    out = tmp_path / "join.sh"
    flags = (
        "add",
        "laptop",
        "--appliance",
        "fd00::1",
        "--token",
        "--within",
        "2h",
        "--open",
        "tcp/22",
        "--out",
        str(out),
    )
    done = run(*flags)
    assert done.exit_code == 0, done.output
    assert done.stdout == "rosrv-enrol_x\n"
    assert "good once" in done.stderr
    assert out.stat().st_mode & 0o777 == 0o600
    text = out.read_text()
    assert 'url="https://[fd00::1]:8443"' in text
    assert "rosrv-enrol_x" not in text
    (order,) = asked
    assert isinstance(order, HostToken)
    assert (order.seconds, order.new, order.kit["open"]) == (7200, True, "tcp/22")
    again = run(*flags)
    assert again.exit_code == 2
    assert "is there already" in again.stderr
    assert len(asked) == 1, "it was not asked in vain"


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (("--appliance", "a b"), "neither an address nor a name"),
        (("--appliance", "10.0.0.1", "--token", "--within", "soon"), "no time such as 30m"),
        (("--appliance", "10.0.0.1", "--token", "--csr", "x"), "two ways"),
        (("--appliance", "10.0.0.1", "--ports", "99999"), "is no range of ports"),
        (("--appliance", "10.0.0.1", "--open", "ssh"), "is no service"),
    ],
)
def test_what_makes_no_sense_is_said_before_anything_is_asked(
    asked: list[AdminRequest], flags: tuple[str, ...], said: str
) -> None:
    """Exit status 2, in words."""
    done = run("add", "laptop", *flags)
    assert done.exit_code == 2
    assert said in done.stderr
    assert asked == []


def test_one_who_was_awaited_is_awaited_no_longer(asked: list[AdminRequest]) -> None:
    """Revoked before it came, in other words than a host that was there."""
    assert "its one-time token opens nothing" in run("revoke", "laptop").stdout
    assert asked
