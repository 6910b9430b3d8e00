import io
import tarfile
from ipaddress import ip_address, ip_interface
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from appliance.channel.admin import AdminAnswer, AdminRequest
from appliance.cli.connection.admin_client import AdminSocket
from appliance.cli.main import app
from appliance.features.tunnels import protect_verb
from appliance.features.tunnels.tunnel_answers import KitParts
from appliance.network.close_ports import LINK, protection
from appliance.network.firewall.firewall_rules import PortRange
from appliance.network.isolation import IsolationSettings
from appliance.network.namespaces import Namespace
from tests.support.answers import example


def run(*arguments: str) -> Any:
    return CliRunner().invoke(app, ["host", *arguments], env={"COLUMNS": "400"})


KIT = example(
    KitParts, name="laptop", address="10.113.11.2", appliance="10.113.11.1", master="http://10.113.11.1:11311",
    certificate="C", authority="A", serial="1f", expires=1795164925.0, pin="p", rest_url="https://10.113.11.1:8443",
)  # fmt: skip


def test_a_refused_request_leaves_no_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
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
            done = run("kit", "laptop", "--appliance", "10.0.0.1", "--output", str(out), *flags)
            assert done.exit_code != 0
            assert list(tmp_path.iterdir()) == []


def test_a_kit_on_standard_output(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(AdminSocket, "ask", lambda *_: AdminAnswer(True, KIT))
    monkeypatch.chdir(tmp_path)
    done = run("add", "laptop", "--appliance", "10.0.0.1", "--output", "-")
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


@pytest.mark.parametrize("link", [["10.111.0.1/30", "fd52:4f53:5256::1/64"], ["10.111.0.5/30"], []])
@pytest.mark.parametrize(
    "appliance", ["10.111.0.2", "10.111.0.6", "fd52:4f53:5256::2", "10.111.5.20", "192.168.1.2"]
)
def test_the_rules_for_an_appliance_of_this_machine_have_no_address(
    monkeypatch: pytest.MonkeyPatch, link: list[str], appliance: str
) -> None:
    """Each start chooses it. Another machine may have an address of the same private network."""
    assert IsolationSettings(ports=(PortRange(1, 2),)).link == LINK
    monkeypatch.setattr(
        protect_verb, "addresses_by_interface", lambda _: {"eth0": ["10.111.5.1/24"], LINK: link}
    )
    text = protection(protect_verb._named([appliance, "10.9.9.9"]), PortRange(32768, 60999), ())
    near = any(ip_address(appliance) in ip_interface(one).network for one in link)
    assert (appliance in text, 'iifname "veth-rosrv" accept' in text) == (not near, near)
    dropped = " flags & (syn | ack) == syn iif != 0 fib saddr type local counter drop"
    assert (f'oifname "veth-rosrv" tcp{dropped}' in text) is near
    assert "10.9.9.9" in text


@pytest.mark.parametrize(
    "option", ["--appliance 10.9.9.9", "--open tcp/40022", "--open udp/40123-40130", "--strict --user root"]
)
@pytest.mark.parametrize("form", [[], ["--json"]])
def test_each_option_that_opens_something_is_in_what_protect_prints(
    monkeypatch: pytest.MonkeyPatch, option: str, form: list[str]
) -> None:
    files: list[str] = []
    monkeypatch.setattr("appliance.network.close_ports.apply", files.append)
    monkeypatch.setattr(protect_verb, "addresses_by_interface", lambda _: {})
    monkeypatch.setattr(Namespace, "lacks_syn_cookies", lambda _own: False)
    words = [
        "protect", "--appliance", "10.8.8.8", "--ports", "40000-40200", "--apply", *option.split(), *form,
    ]  # fmt: skip
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    comment = "".join(line for line in files[0].splitlines() if line.startswith("# "))
    for text in (comment, done.output):
        assert option.rsplit(maxsplit=1)[-1] in text or ("strict" in option and '"strict": true' in text)
