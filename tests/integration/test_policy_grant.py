import re
from collections.abc import Iterator
from pathlib import Path
from xmlrpc.client import ServerProxy

import pytest

from tests.support.appliance import Appliance
from tests.support.small_disk import small_disk

POLICY = """
[Groups]
ocu = 10.9.9.9
[Nodes]
default = ocu 127.0.0.1
[Publishers]
/cmd* = ocu   # only they
default = 127.0.0.1
[Subscribers]
default = ocu
[Commands]
default = ocu, 127.0.0.1
"""
HERE = "http://127.0.0.1:4000/"


@pytest.fixture(scope="module")
def common_appliance() -> Iterator[Appliance]:
    with Appliance(policy=POLICY, options=("--api", "127.0.0.1:0")) as appliance:
        yield appliance


@pytest.fixture
def appliance(common_appliance: Appliance) -> Iterator[Appliance]:
    yield common_appliance
    common_appliance.reload(POLICY)
    with ServerProxy(common_appliance.master_uri) as master:
        master.unregisterPublisher("/base", "/cmd_vel", HERE)


def refused(appliance: Appliance, method: str, *arguments: object) -> str:
    with ServerProxy(appliance.master_uri) as master:
        code, text, _value = getattr(master, method)(*arguments)
    assert code == 0
    record = str(text).rpartition("[")[2].rstrip("]")
    appliance.recorded("--event", "decision", id=record)
    return record


def test_a_full_disk_leaves_the_policy_as_it_was(appliance: Appliance, tmp_path: Path) -> None:
    record = refused(appliance, "registerPublisher", "/base", "/cmd_vel", "std_msgs/String", HERE)
    with small_disk(tmp_path, "8k"):
        policy = tmp_path / "policy.ini"
        policy.write_text(POLICY)
        policy.chmod(0o640)
        (tmp_path / "filler").write_bytes(bytes(4096))
        done = appliance.rosrv("policy", "grant", record, "--output", str(policy), check=False)
        assert (done.returncode, "No space left" in done.stderr) == (2, True), done.stderr
        assert policy.read_text() == POLICY
        (tmp_path / "filler").unlink()
        appliance.rosrv("policy", "grant", record, "--output", str(policy))
        assert "/cmd_vel = ocu robot" in policy.read_text()
        assert policy.stat().st_mode & 0o777 == 0o640


def test_a_denied_call_is_granted_with_commit_confirm(appliance: Appliance, tmp_path: Path) -> None:
    call = ("registerPublisher", "/base", "/cmd_vel", "std_msgs/String", HERE)
    record = refused(appliance, *call)
    shown = appliance.rosrv("policy", "grant", record).stdout
    assert "+/cmd_vel = ocu robot" in shown.splitlines()
    rest = appliance.rest().get(f"/v1/audit/{record}/grant").json
    assert rest["added"] == ["/cmd_vel = ocu robot"]
    assert rest["findings"] == []
    why = appliance.rosrv("audit", "why", record).stdout.splitlines()
    assert why[-1] == "would be allowed by: /cmd_vel = ocu robot"
    assert any(line.startswith("rule: [Publishers] /cmd*") for line in why)
    assert appliance.rest().get(f"/v1/audit/{record}/why").json["lines"] == why
    new, dos = tmp_path / "new.ini", tmp_path / "dos.ini"
    dos.write_bytes(b"[Groups]\r\n")
    for file, ends in ((new, b"\n"), (dos, b"\r\n")):  # the file's line endings stay the same
        appliance.rosrv("policy", "grant", record, "--output", str(file))
        assert set(re.findall(rb"\r?\n", file.read_bytes())) == {ends}
    done = appliance.rosrv("policy", "grant", record, "--load", "--confirm-within", "5m")
    assert "unless you run: rosrv policy confirm" in done.stdout
    with ServerProxy(appliance.master_uri) as master:
        answer = getattr(master, call[0])(*call[1:])
    assert answer[0] == 1
    again = appliance.rosrv("policy", "grant", record, check=False)
    assert (again.returncode, "the policy in force grants it" in again.stdout) == (1, True)


def test_calls_that_no_policy_can_grant(appliance: Appliance) -> None:
    record = refused(appliance, "bogus", "/base")
    done = appliance.rosrv("policy", "grant", record, check=False)
    assert (done.returncode, "is not a call that the appliance knows" in done.stderr) == (1, True)
    rest = appliance.rest()
    assert rest.get(f"/v1/audit/{record}/grant").status == 409
    assert rest.get("/v1/audit/ffffffffffffffffffff/grant").status == 404
    assert rest.get("/v1/audit/ffffffffffffffffffff/why").status == 404
    assert rest.get(f"/v1/audit/{record}/why").json["refusal"]
    started = appliance.recorded("--event", "appliance started")[0]["id"]
    assert "not a record of a decision" in appliance.rosrv("policy", "grant", started, check=False).stderr
