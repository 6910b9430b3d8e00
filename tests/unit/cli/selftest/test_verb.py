"""Tests of `rosrv selftest` where no appliance runs: what is wrong with a machine or its files is found and told."""

import datetime
import json
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from typer.testing import CliRunner

from appliance.cli.main import app
from appliance.cli.selftest.selftest_findings import fail, ok, told
from appliance.network.namespaces import namespaces
from tests.support.requirements import need_root

RIGHT = "[Nodes]\ndefault = 10.0.0.1\n[Publishers]\ndefault = 10.0.0.1\n[Commands]\ndefault = 10.0.0.1\n"


class Place:
    """A folder with a configuration, a policy and a state directory."""

    def __init__(self, home: Path) -> None:
        self.home = home
        self.policy, self.state = home / "policy.ini", home / "state"
        self.policy.write_text(RIGHT)
        self.lines = [
            "policy: policy.ini",
            "state: state",
            "listen: 127.0.0.1:0",
            "rosmaster_port: 0",
            "api: 127.0.0.1:0",
        ]

    def run(self) -> tuple[int, dict[str, dict[str, Any]]]:
        """The exit status, and what was found by check."""
        config = self.home / "appliance.yaml"
        config.write_text("\n".join(self.lines) + "\n")
        done = CliRunner().invoke(app, ["selftest", "--config", str(config), "--json"])
        rows = [json.loads(line) for line in done.output.splitlines()]
        return done.exit_code, {row["check"]: row for row in rows}


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Place]:
    """A place where everything is right."""
    for name in [name for name in os.environ if name.startswith("ROSRV_")]:
        monkeypatch.delenv(name)
    yield Place(tmp_path)


def test_where_everything_is_right_nothing_fails(place: Place) -> None:
    """Exit status 0; every line says what was found; as root the kernel was tried and nothing is left of it."""
    need_root()
    status, found = place.run()
    assert status == 0, found
    assert {row["outcome"] for row in found.values()} <= {"ok", "warn", "skip"}
    assert all(row["text"] for row in found.values())
    assert found["firewall"]["outcome"] == "ok"
    assert "refused another user" in found["firewall"]["text"]
    assert namespaces(f"rosrv-selftest-{os.getpid()}") == []


def test_a_port_that_is_taken_is_a_failure_that_says_by_whom(place: Place) -> None:
    """The place, the program that has it, and what to do."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        place.lines[2] = f"listen: 127.0.0.1:{port}"
        status, found = place.run()
    assert status == 1
    row = found["port of RVMaster"]
    assert row["outcome"] == "fail"
    assert str(port) in row["text"]
    assert f"process {os.getpid()}" in row["text"]
    assert row["advice"]


@pytest.mark.parametrize(
    ("check", "spoil"),
    [
        ("policy", lambda place: place.policy.write_text("[Nodes]\nbogus\n")),
        ("policy", lambda place: place.policy.unlink()),
        ("policy tests", lambda place: Path(f"{place.policy}.tests.yaml").write_text(
            "cases:\n  - host: 10.0.0.9\n    node: /joy\n    allow: [publish /cmd_vel]\n")),
        ("monitors", lambda place: (place.home / "monitors").mkdir()
            or ((place.home / "monitors/a.rv").write_text("a() {") and place.lines.append("monitors: monitors"))),
        ("hosts", lambda place: (place.home / "hosts.yaml").write_text("hosts: 7\n")
            and place.lines.append("hosts: hosts.yaml")),
        ("state", lambda place: place.state.write_text("a file")),
        ("state", lambda place: place.state.mkdir() or place.state.chmod(0o777)),
        ("state", lambda place: place.state.mkdir() or (place.state / "notes.txt").write_text("somebody else's")),
        ("secrets", lambda place: (place.state / "signer").mkdir(parents=True) or (place.state / "lock").write_text("")
            or (place.state / "signer/audit.key").write_text("") or (place.state / "signer/audit.key").chmod(0o644)),
        ("configuration", lambda place: place.lines.append("polcy: x.ini")),
        ("certificate", lambda place: certificate(place.state, days=-1)),
    ],
)  # fmt: skip
def test_what_is_wrong_is_found(place: Place, check: str, spoil: Any) -> None:
    """Each kind of mistake is a failure of its own check, with advice; exit status 1."""
    spoil(place)
    status, found = place.run()
    assert status == 1, found
    assert found[check]["outcome"] == "fail", found
    assert found[check]["advice"]


def test_a_certificate_that_ends_soon_is_a_warning(place: Place) -> None:
    """Days that are left are told; the exit status is 0."""
    certificate(place.state, days=5)
    place.run()
    status, found = place.run()
    assert (status, found["certificate"]["outcome"]) == (0, "warn")
    assert "ends in" in found["certificate"]["text"]


def test_a_check_that_breaks_is_a_finding() -> None:
    """Whatever a strange machine does to one check, the others go on."""

    def broken() -> Iterator[Any]:
        yield ok("one", "fine")
        raise RuntimeError("odd")

    found = list(told("one", broken))
    assert found[0] == ok("one", "fine")
    assert found[1] == fail("one", "cannot be tried: RuntimeError: odd", "report this: a defect of rosrv")


def certificate(state: Path, days: int) -> None:
    """REST's certificate, which ends in so many days."""
    key = ec.generate_private_key(ec.SECP256R1())
    now = datetime.datetime.now(datetime.UTC)
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "rosrv")])
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now - datetime.timedelta(days=10))
        .not_valid_after(
            now + datetime.timedelta(days=days, hours=1) - datetime.timedelta(hours=2 * (days < 0))
        )
        .sign(key, hashes.SHA256())
    )
    (state / "api").mkdir(parents=True, exist_ok=True)
    (state / "lock").write_text("")
    (state / "api" / "certificate.pem").write_bytes(made.public_bytes(serialization.Encoding.PEM))
