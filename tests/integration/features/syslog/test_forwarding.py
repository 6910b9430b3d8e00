import json
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.appliance import Appliance
from tests.support.rosmaster import master_at
from tests.support.syslog import StreamCollector
from tests.support.waiting import allowed, eventually


@pytest.fixture(scope="module")
def collector() -> Iterator[StreamCollector]:
    with StreamCollector() as collector:
        yield collector


@pytest.fixture(scope="module")
def appliance(collector: StreamCollector) -> Iterator[Appliance]:
    audit = {"syslog": {"to": f"tcp://127.0.0.1:{collector.port}"}, "checkpoint_seconds": 1}
    with Appliance(settings=json.dumps({"audit": audit})) as appliance:
        yield appliance


def work(appliance: Appliance, count: int) -> None:
    with master_at(appliance.master_uri) as master:
        for number in range(count):
            assert master.setParam("/worker", f"/value{number}", number)[0] == 1


def all_sequences(appliance: Appliance) -> set[int]:
    lines = appliance.rosrv("audit", "export").stdout.splitlines()
    return {int(json.loads(line)["sequence"]) for line in lines}


def forwarding_status(appliance: Appliance) -> dict[str, Any]:
    return dict(appliance.status()["audit"]["forwarding"])


def test_every_record_arrives_and_verifies(
    collector: StreamCollector, appliance: Appliance, tmp_path: Path
) -> None:
    work(appliance, 50)
    wanted = all_sequences(appliance)
    collector.wait_for(lambda _messages: wanted <= set(collector.sequences()))
    came = collector.sequences()
    assert came == sorted(set(came))
    collector.wait_for(lambda messages: any(message.event == "checkpoint-signed" for message in messages))
    kept = tmp_path / "receiver.ndjson"
    checkpoints = [message for message in collector.messages if message.event == "checkpoint-signed"]
    kept.write_text("".join(json.dumps(checkpoint.fields) + "\n" for checkpoint in checkpoints))
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
