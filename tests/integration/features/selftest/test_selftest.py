import json
import os
import signal
import subprocess
import xmlrpc.client
from collections.abc import Iterator

import pytest

from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.command import ROSRV
from tests.support.processes import LIMIT

STRICT = OPEN_POLICY.replace("*", "10.9.9.9")
Rows = dict[str, dict[str, str]]


@pytest.fixture(scope="module")
def appliance() -> Iterator[Appliance]:
    with Appliance(options=("--api", "127.0.0.1:0")) as running:
        running.rest()
        yield running


def selftest(appliance: Appliance, way: str = "state") -> tuple[int, Rows]:
    env = {key: value for key, value in os.environ.items() if not key.startswith("ROSRV_")}
    command = [ROSRV, "selftest", "--json", "--state", str(appliance.state)]
    if way == "api":
        certificate = appliance.state / "api" / "certificate.pem"
        command[3:] = ["--api", str(appliance.ready["api"]), "--api-ca", str(certificate)]
        env["ROSRV_TOKEN"] = str(appliance.ready["token"])
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=2 * LIMIT, check=False)
    assert not done.stderr, done.stderr
    return done.returncode, {row["check"]: row for row in map(json.loads, done.stdout.splitlines())}


def failures(found: Rows) -> list[dict[str, str]]:
    return [row for row in found.values() if row["outcome"] == "fail"]


def test_a_message_really_goes_through(appliance: Appliance) -> None:
    for way in ("state", "api"):
        status, found = selftest(appliance, way)
        assert status == 0, failures(found)
        for check in ("appliance", "status", "processes", "audit log", "RVMaster", "relay"):
            assert found[check]["outcome"] == "ok", found[check]
        assert "a message came through" in found["relay"]["text"]
    assert ("firewall" in found) is False
    with xmlrpc.client.ServerProxy(appliance.master_uri) as master:
        state = str(master.getSystemState("/looker"))
    assert "selftest" not in state
    records = appliance.recorded("--caller", "/rosrv_selftest_publisher", "--category", "publish")
    assert {record["resource"] for record in records} == {"/rosrv_selftest"}


def test_a_strict_policy_is_not_a_failure(appliance: Appliance) -> None:
    appliance.reload(STRICT)
    status, found = selftest(appliance)
    assert status == 0, failures(found)
    assert "denied by the policy" in found["RVMaster"]["text"]
    assert found["RVMaster"]["text"].endswith("and recorded")
    assert found["relay"]["outcome"] == "skip"
    appliance.reload(OPEN_POLICY)


def test_a_hanging_relay_is_found(appliance: Appliance) -> None:
    pids = appliance.pids("relay")
    supervisor = appliance.pids("supervisor")[0]
    for pid in (supervisor, *pids):
        os.kill(pid, signal.SIGSTOP)
    try:
        status, found = selftest(appliance, "api")
    finally:
        for pid in (*pids, supervisor):
            os.kill(pid, signal.SIGCONT)
    assert status == 1
    assert found["relay"]["outcome"] == "fail"
    assert found["relay"]["advice"]


def test_a_missing_appliance_is_a_failure(appliance: Appliance) -> None:
    appliance.stop()
    status, found = selftest(appliance)
    assert status == 1
    assert found["appliance"]["outcome"] == "fail"
    assert found["policy"]["outcome"] in ("ok", "warn")
