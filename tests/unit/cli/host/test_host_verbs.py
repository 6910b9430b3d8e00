"""Tests of `rosrv host` as a person sees it; with a running appliance: tests/system/ipsec."""

import io
import json
import tarfile
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from appliance.channel.admin import (
    AdminAnswer,
    AdminRequest,
    HostEndpoint,
    HostList,
    HostRevoke,
    HostToken,
    MonitorsWanted,
)
from appliance.channel.answers.host_answers import Endpoint, EnrolmentToken, Hosts, KitParts, Revoked
from appliance.channel.answers.monitor_answers import Monitors
from appliance.cli.admin_client import AdminSocket
from appliance.cli.main import app
from tests.support.answers import example

PORTS: dict[str, Any] = {"state": "unknown", "checked": None, "open": [], "who": ""}
HOST: dict[str, Any] = {
    "name": "laptop", "address": "10.113.11.2", "state": "up", "groups": ["ocu"], "declared": True, "wanted": True,
    "divergence": "hosts.yaml keeps 10.113.11.9 for it", "serial": "1f", "enrolled": 1.0, "expires": 1795164925.0,
    "expires_soon": True, "renewing": False, "revoked": None, "remote": "192.168.1.7", "seconds": 5, "bytes_in": 10,
    "bytes_out": 20, "last_seen": 1795160000.0, "token_expires": None,
    "ports": PORTS | {"state": "closed", "checked": 1.0},
}  # fmt: skip
OVERVIEW = example(
    Hosts,
    hosts=[
        HOST,
        HOST | {"name": "other", "state": "awaited", "groups": [], "token_expires": 1795164925.0},
    ],
    machines=[{"address": "10.0.0.7", "nodes": 3, "ports": PORTS}],
    troubles=["look at this"],
)


def token(request: HostToken) -> EnrolmentToken:
    """What the appliance makes of it; it finds its own address where none is given."""
    endpoint, reason = (request.endpoint, "") if request.endpoint else FOUND
    return example(
        EnrolmentToken, name="laptop", address="10.113.11.2", token="rosrv-enrol_x", expires=1795164925.0,  # noqa: S106  of nobody
        endpoint=endpoint, endpoint_reason=reason, script="#!/bin/sh\n# join",
    )  # fmt: skip


FOUND = ("10.0.0.5", "the only address here")


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[AdminRequest[Any]]:
    """What the appliance was asked; it answers."""
    requests: list[AdminRequest[Any]] = []

    def ask(_self: AdminSocket, request: AdminRequest[Any]) -> AdminAnswer[Any]:
        requests.append(request)
        match request:
            case HostList():
                return AdminAnswer(True, OVERVIEW)
            case HostEndpoint():
                return AdminAnswer(True, Endpoint(*FOUND))
            case HostToken():
                return AdminAnswer(True, token(request))
            case HostRevoke(name):
                return AdminAnswer(True, Revoked(1, name, "10.113.11.2", "", 0))
            case _:
                raise AssertionError(request)

    monkeypatch.setattr(AdminSocket, "ask", ask)
    return requests


def run(*arguments: str) -> Any:
    """The command, to its end."""
    return CliRunner().invoke(app, ["host", *arguments], env={"COLUMNS": "400"})


def test_the_list_says_all_of_it(asked: list[AdminRequest[Any]]) -> None:
    """Tunnel, bytes, certificate that ends soon, ports, groups, divergence; machines in clear text; troubles."""
    text = run("list").stdout
    for words in (
        "laptop", "10.113.11.2", "up", "from 192.168.1.7 for 5 s, 10 B in, 20 B out", "(soon!)", "ports closed",
        "in ocu", "(hosts.yaml keeps 10.113.11.9 for it)", "other", "token until", "10.0.0.7", "3 nodes in clear text",
        "ports never checked", "! look at this",
    ):  # fmt: skip
        assert words in text, words
    assert asked == [HostList()]


def test_lists_of_nothing_say_what_to_do_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """Who has no host, or no monitor, is told how to get one; `--json` has no lines then."""
    nothing: dict[type, Any] = {
        HostList: example(Hosts, hosts=[]),
        MonitorsWanted: example(Monitors, monitors=[]),
    }
    monkeypatch.setattr(AdminSocket, "ask", lambda _self, request: AdminAnswer(True, nothing[type(request)]))
    for noun, words in (("host", "rosrv host add NAME"), ("monitor", "rosrv monitor load FILE")):
        assert words in CliRunner().invoke(app, [noun, "list"]).stdout
        assert CliRunner().invoke(app, [noun, "list", "--json"]).stdout == ""


def test_a_group_of_hosts(asked: list[AdminRequest[Any]]) -> None:
    """Only those of the group, and nothing else."""
    text = run("list", "--group", "ocu").stdout
    assert "laptop" in text
    assert "other" not in text
    assert "10.0.0.7" not in text
    assert asked


@pytest.mark.parametrize(("group", "known"), [("ocus", "; did you mean ocu?"), ("arms", ": ocu")])
def test_a_group_that_no_host_is_in_is_told(asked: list[AdminRequest[Any]], group: str, known: str) -> None:
    """Beside the list, which is empty: a slip is not taken for a group without a host."""
    done = run("list", "--group", group)
    assert (done.exit_code, done.stdout) == (0, "")
    assert done.stderr == f"rosrv: hosts.yaml has no group '{group}'{known}\n"
    assert asked


def test_a_token_and_its_script(asked: list[AdminRequest[Any]], tmp_path: Path) -> None:
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
    assert out.read_text() == "#!/bin/sh\n# join"
    (order,) = asked
    assert isinstance(order, HostToken)
    assert (order.token_seconds, order.new, order.open) == (7200, True, ["tcp/22"])
    again = run(*flags)
    assert again.exit_code == 2
    assert "is there already" in again.stderr
    assert len(asked) == 1, "it was not asked in vain"


def test_the_appliance_knows_its_own_address(asked: list[AdminRequest[Any]], tmp_path: Path) -> None:
    """Nobody has to give it; which one was taken, and why, is said."""
    out = tmp_path / "join.sh"
    done = run("add", "laptop", "--token", "--out", str(out))
    assert done.exit_code == 0, done.output
    assert done.stdout == "rosrv-enrol_x\n"
    assert "the appliance is at 10.0.0.5 (the only address here); another: --appliance" in done.stderr
    assert [type(one) for one in asked] == [HostToken]
    out.unlink()
    shown = json.loads(run("kit", "laptop", "--token", "--out", str(out), "--json").stdout)
    assert (shown["endpoint"], shown["endpoint_reason"]) == ("10.0.0.5", "the only address here")


def test_an_address_that_cannot_be_told_enrols_nobody(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Exit status 1, the reason in words or as JSON; nothing else is asked, and nothing is written."""

    def ask(_self: AdminSocket, request: AdminRequest[Any]) -> AdminAnswer[Any]:
        assert request == HostEndpoint()
        return AdminAnswer(False, error="there are several; give it: --appliance ADDRESS", trouble="refused")

    monkeypatch.setattr(AdminSocket, "ask", ask)
    for verb in ("add", "kit"):
        done = run(verb, "laptop", "--out", str(tmp_path / "kit"))
        assert (done.exit_code, done.stdout) == (1, "")
        assert done.stderr == "rosrv: there are several; give it: --appliance ADDRESS\n"
        as_json = run(verb, "laptop", "--out", str(tmp_path / "kit"), "--json")
        assert as_json.exit_code == 1
        assert json.loads(as_json.stdout)["error"].startswith("there are several")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (("--appliance", "a b"), "neither an address nor a name"),
        (("--appliance", "10.0.0.1", "--token", "--within", "soon"), "not a time: write 30m"),
        (("--appliance", "10.0.0.1", "--token", "--csr", "x"), "two ways"),
        (("--appliance", "10.0.0.1", "--ports", "99999"), "is no range of ports"),
        (("--appliance", "10.0.0.1", "--open", "ssh"), "is no service"),
    ],
)
def test_what_makes_no_sense_is_said_before_anything_is_asked(
    asked: list[AdminRequest[Any]], flags: tuple[str, ...], said: str
) -> None:
    """Exit status 2, in words."""
    done = run("add", "laptop", *flags)
    assert done.exit_code == 2
    assert said in done.stderr
    assert asked == []


def test_one_who_was_awaited_is_awaited_no_longer(asked: list[AdminRequest[Any]]) -> None:
    """Revoked before it came, in other words than a host that was there."""
    assert "its one-time token opens nothing" in run("revoke", "laptop").stdout
    assert asked


KIT = example(
    KitParts, name="laptop", address="10.113.11.2", appliance="10.113.11.1", master="http://10.113.11.1:11311",
    certificate="C", authority="A", serial="1f", expires=1795164925.0, pin="p", rest_url="https://10.113.11.1:8443",
)  # fmt: skip


@pytest.mark.parametrize("verb", ["add", "kit"])
@pytest.mark.parametrize("token", [(), ("--token",)])
def test_what_cannot_be_written_is_not_ordered(
    asked: list[AdminRequest[Any]], tmp_path: Path, verb: str, token: tuple[str, ...]
) -> None:
    """A new kit closes a tunnel and a token is shown once: neither happens when there is no place for what it gives."""
    for out, said in (
        (
            tmp_path / "nowhere" / "kit",
            "No such file or directory; name another: --out FILE, or --out - > FILE",
        ),
        (Path("/proc/kit"), "name another"),
        (tmp_path, "is there already"),
    ):
        done = run(verb, "laptop", "--appliance", "10.0.0.1", *token, "--out", str(out))
        assert done.exit_code == 2
        assert said in done.stderr
    assert asked == []


def test_an_order_that_is_refused_leaves_no_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Nor does one that was interrupted; and the place is known to be good while the appliance is asked."""
    out, interrupted = tmp_path / "kit", [False]

    def refuse(_self: AdminSocket, _request: AdminRequest[Any]) -> AdminAnswer[Any]:
        assert out.stat().st_mode & 0o777 == 0o600
        assert out.stat().st_size >= 64 << 10
        if interrupted[0]:
            raise KeyboardInterrupt
        return AdminAnswer(False, error="no", trouble="refused")

    monkeypatch.setattr(AdminSocket, "ask", refuse)
    for interrupted[0] in (False, True):
        for flags in ((), ("--token",), ("--csr", str(tmp_path / "missing"))):
            done = run("kit", "laptop", "--appliance", "10.0.0.1", "--out", str(out), *flags)
            assert done.exit_code != 0
            assert list(tmp_path.iterdir()) == []


def test_a_kit_on_standard_output(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """`--out -`: the archive alone is on standard output, what is said beside it; the same bytes as in a file."""
    monkeypatch.setattr(AdminSocket, "ask", lambda *_: AdminAnswer(True, KIT))
    monkeypatch.chdir(tmp_path)
    done = run("add", "laptop", "--appliance", "10.0.0.1", "--out", "-")
    assert done.exit_code == 0, done.output
    with tarfile.open(fileobj=io.BytesIO(done.stdout_bytes)) as archive:
        assert any(name.endswith("join.sh") for name in archive.getnames())
    assert "its kit: standard output" in done.stderr
    assert list(tmp_path.iterdir()) == []
    done = run("add", "laptop", "--appliance", "10.0.0.1")
    assert "its kit: rosrv-laptop.tar.gz" in done.stdout
    with tarfile.open(tmp_path / "rosrv-laptop.tar.gz") as archive:
        assert any(name.endswith("join.sh") for name in archive.getnames())
    assert (tmp_path / "rosrv-laptop.tar.gz").read_bytes()[-4:] != bytes(4), "it has its own size"


def test_a_script_on_standard_output(asked: list[AdminRequest[Any]]) -> None:
    """The token then stands among what is said; `--json` would want standard output, too."""
    done = run("add", "laptop", "--appliance", "10.0.0.1", "--token", "--out", "-")
    assert done.exit_code == 0, done.output
    assert done.stdout.startswith("#!")
    assert "rosrv-enrol_x" not in done.stdout
    assert "rosrv-enrol_x" in done.stderr
    assert "sudo sh rosrv-laptop-join.sh" in done.stderr
    asked.clear()
    refused = run("add", "laptop", "--appliance", "10.0.0.1", "--token", "--out", "-", "--json")
    assert refused.exit_code == 2
    assert "both want standard output" in refused.stderr
    assert asked == []
