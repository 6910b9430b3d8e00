"""The audit log of a real appliance is forwarded to a syslog receiver that is sometimes unavailable."""

import json
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from tests.support.appliance import Appliance
from tests.support.forgery import write_anew
from tests.support.rosmaster import master_at
from tests.support.syslog import Message, StreamCollector
from tests.support.waiting import allowed, eventually


@contextmanager
def forwarding(port: int, **syslog: Any) -> Iterator[Appliance]:
    """Return an appliance that forwards to this port on loopback, and seals its log every second."""
    settings = {"syslog": {"to": f"tcp://127.0.0.1:{port}", **syslog}, "checkpoint_seconds": 1}
    with Appliance(settings=json.dumps({"audit": settings})) as appliance:
        yield appliance


@pytest.fixture(scope="module")
def collector() -> Iterator[StreamCollector]:
    """Run a receiver for several tests."""
    with StreamCollector() as collector:
        yield collector


@pytest.fixture(scope="module")
def appliance(collector: StreamCollector) -> Iterator[Appliance]:
    """Run an appliance that forwards all records to the receiver; after each test all processes run."""
    with forwarding(collector.port) as appliance:
        yield appliance


def work(appliance: Appliance, count: int) -> None:
    """Make calls of a node, each of which is a record."""
    with master_at(appliance.master_uri) as master:
        for number in range(count):
            assert master.setParam("/worker", f"/value{number}", number)[0] == 1


def another_life(appliance: Appliance, role: str, before: list[int]) -> None:
    """Wait until the process was restarted."""
    eventually(lambda: appliance.pids(role) not in ([], before), f"another {role} runs")


def all_sequences(appliance: Appliance) -> set[int]:
    """Return the sequence numbers in the log."""
    lines = appliance.rosrv("audit", "export").stdout.splitlines()
    return {int(json.loads(line)["sequence"]) for line in lines}


def forwarding_status(appliance: Appliance) -> dict[str, Any]:
    """Return the state of forwarding in `rosrv status`."""
    return dict(appliance.status()["audit"]["forwarding"])


def test_every_record_arrives_and_verifies(
    collector: StreamCollector, appliance: Appliance, tmp_path: Path
) -> None:
    work(appliance, 50)
    wanted = all_sequences(appliance)
    collector.wait_for(lambda _messages: wanted <= set(collector.sequences()))
    came = collector.sequences()
    assert came == sorted(set(came))
    collector.wait_for(lambda messages: any(one.event == "checkpoint-signed" for one in messages))
    kept = tmp_path / "receiver.ndjson"
    checkpoints = [one for one in collector.messages if one.event == "checkpoint-signed"]
    kept.write_text("".join(json.dumps(one.fields) + "\n" for one in checkpoints))
    assert "kept elsewhere agree" in appliance.rosrv("audit", "verify", "--checkpoints", str(kept)).stdout
    status = forwarding_status(appliance)
    assert status["trouble"] == ""
    assert status["to"] == f"tcp://127.0.0.1:{collector.port}"
    samples = appliance.rest().get("/metrics").body.decode()
    assert "rosrv_syslog_up 1.0" in samples
    if os.geteuid() == 0:
        (pid,) = appliance.pids("syslog")
        owner = Path(f"/proc/{pid}").stat()
        assert (owner.st_uid, owner.st_gid) == (61017, 61014)


def test_an_unavailable_receiver(collector: StreamCollector, appliance: Appliance) -> None:
    appliance.ignore_earlier_records()
    collector.wait_for(lambda messages: messages)
    collector.close()
    start = time.monotonic()
    work(appliance, 200)
    assert time.monotonic() - start < allowed(10)
    eventually(lambda: forwarding_status(appliance)["trouble"], "the status reports the problem")
    told = appliance.rosrv("status", check=False)
    assert told.returncode == 1
    assert "the audit log is not forwarded to tcp://" in told.stdout
    eventually(lambda: appliance.audit(event="forwarding failed"), "it is recorded")
    collector.open()
    eventually(lambda: not forwarding_status(appliance)["trouble"], "the problem is over")
    eventually(lambda: appliance.audit(event="forwarding resumed"), "the recovery is recorded")
    wanted = all_sequences(appliance)
    collector.wait_for(lambda _messages: wanted <= set(collector.sequences()))


def test_deaths(collector: StreamCollector, appliance: Appliance) -> None:
    for role in ("syslog", "control", "syslog"):
        work(appliance, 60)
        before = appliance.pids(role)
        os.kill(before[0], signal.SIGKILL)
        another_life(appliance, role, before)
    work(appliance, 60)
    assert appliance.stop() == 0
    appliance.start()
    work(appliance, 10)
    wanted = all_sequences(appliance)
    collector.wait_for(lambda _messages: wanted <= set(collector.sequences()))
    assert collector.problems == []


def test_only_denials() -> None:
    def decided(messages: list[Message]) -> bool:
        return any(one.event == "decision" for one in messages)

    with (
        StreamCollector() as collector,
        forwarding(collector.port, send="denials", facility=10) as appliance,
    ):
        work(appliance, 20)
        with master_at(appliance.master_uri) as master:
            assert master.noSuchCall("/rogue\u202e]\n")[0] == 0
        denial = next(one for one in collector.wait_for(decided) if one.event == "decision")
        assert (denial.fields["decision"], denial.fields["host"]) == ("deny", "127.0.0.1")
        assert denial.facility == 10
        assert denial.fields["caller_id"] == "/rogue\\u202e]\\n"
        assert all(one.fields.get("decision") != "allow" for one in collector.messages)


def test_a_log_rewritten_by_root(tmp_path: Path) -> None:
    with StreamCollector() as collector, forwarding(collector.port) as appliance:
        with master_at(appliance.master_uri) as master:
            assert master.noSuchCall("/thief")[0] == 0
        work(appliance, 20)
        (theft,) = appliance.recorded("--caller", "/thief")
        collector.wait_for(
            lambda messages: any(int(one.fields["sequence"]) >= theft["sequence"] for one in sealed(messages))
        )
        assert appliance.stop() == 0
        kept = tmp_path / "receiver.ndjson"
        kept.write_text("".join(json.dumps(one.fields) + "\n" for one in sealed(collector.messages)))
        key = load_pem_private_key((appliance.state / "signer" / "audit.key").read_bytes(), None)
        assert isinstance(key, Ed25519PrivateKey)
        log = appliance.state / "control" / "audit.db"
        change = "UPDATE record SET decision = 'allow', caller_id = '/friend' WHERE caller_id = '/thief'"
        write_anew(log, key, appliance.state / "signer", change)
        assert "The log is " in appliance.rosrv("audit", "verify").stdout
        assert appliance.audit("--caller", "/thief") == []
        done = appliance.rosrv("audit", "verify", "--checkpoints", str(kept), check=False)
        assert done.returncode == 1
        assert "REWRITTEN" in done.stdout


def sealed(messages: list[Message]) -> list[Message]:
    """Return the checkpoints in these messages."""
    return [one for one in messages if one.event == "checkpoint-signed"]
