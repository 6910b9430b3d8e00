import datetime
import json
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from appliance.cli.main import app
from appliance.features.selftest.selftest_findings import fail, ok, run_check
from appliance.network.namespaces import namespaces
from tests.support.certificates import self_signed
from tests.support.requirements import need_root

RIGHT = "[Nodes]\ndefault = 10.0.0.1\n[Publishers]\ndefault = 10.0.0.1\n[Commands]\ndefault = 10.0.0.1\n"


class Place:
    def __init__(self, home: Path) -> None:
        self.home = home
        self.policy, self.state = home / "policy.ini", home / "state"
        self.policy.write_text(RIGHT)
        self.lines = [
            "policy: policy.ini", "state: state", "listen: 127.0.0.1:0", "rosmaster_port: 0", "api: 127.0.0.1:0",
        ]  # fmt: skip

    def run(self) -> tuple[int, dict[str, dict[str, Any]]]:
        config = self.home / "appliance.yaml"
        config.write_text("\n".join(self.lines) + "\n")
        done = CliRunner().invoke(app, ["selftest", "--config", str(config), "--json"])
        rows = [json.loads(line) for line in done.output.splitlines()]
        return done.exit_code, {row["check"]: row for row in rows}


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Place]:
    for name in [name for name in os.environ if name.startswith("ROSRV_")]:
        monkeypatch.delenv(name)
    yield Place(tmp_path)


@pytest.mark.nightly
def test_a_valid_setup_passes(place: Place) -> None:
    need_root()
    status, found = place.run()
    assert status == 0, found
    assert {row["outcome"] for row in found.values()} <= {"ok", "warn", "skip"}
    assert all(row["text"] for row in found.values())
    assert found["firewall"]["outcome"] == "ok"
    assert "rejected another user" in found["firewall"]["text"]
    assert namespaces(f"rosrv-selftest-{os.getpid()}") == []


@pytest.mark.nightly
def test_a_used_port_names_its_program(place: Place) -> None:
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


@pytest.mark.nightly
def test_a_certificate_that_has_ended_fails(place: Place) -> None:
    certificate(place.state, days=-1)
    status, found = place.run()
    assert (status, found["certificate"]["outcome"]) == (1, "fail")
    assert found["certificate"]["advice"]


@pytest.mark.nightly
def test_a_certificate_near_its_end_is_a_warning(place: Place) -> None:
    certificate(place.state, days=5)
    place.run()
    status, found = place.run()
    assert (status, found["certificate"]["outcome"]) == (0, "warn")
    assert "expires in" in found["certificate"]["text"]


def test_a_crashing_check_is_a_finding() -> None:
    def broken() -> Iterator[Any]:
        yield ok("one", "fine")
        raise RuntimeError("odd")

    findings = list(run_check("one", broken))
    assert findings[0] == ok("one", "fine")
    assert findings[1] == fail(
        "one", "the check failed: RuntimeError: odd", "please report this defect in rosrv"
    )


def certificate(state: Path, days: int) -> None:
    now = datetime.datetime.now(datetime.UTC)
    (state / "api").mkdir(parents=True, exist_ok=True)
    (state / "lock").write_text("")
    end = now + datetime.timedelta(days=days, hours=1)
    self_signed(state / "api" / "certificate.pem", "127.0.0.1", now - datetime.timedelta(days=10), end)
