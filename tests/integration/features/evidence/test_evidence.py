import json
import subprocess
import xmlrpc.client
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.appliance import OPEN_POLICY, Appliance

CLOSED = OPEN_POLICY.replace("[Publishers]\n", "[Publishers]\n/cmd_vel = 10.9.9.9\n")
CONFIGURATION = """
audit: {checkpoint_seconds: 3600, reserve_bytes: 1MiB}
api: 127.0.0.1:0
api_tls: off
recorder: {enabled: true, memory: 16MiB, disk: 512MiB, triggers: []}
"""
MONITOR = "a() { event said() /chatter std_msgs/String '{}' { } }"


@pytest.fixture(scope="module")
def appliance(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Appliance]:
    specification = tmp_path_factory.mktemp("specification") / "a.rv"
    specification.write_text(MONITOR)
    with Appliance(settings=CONFIGURATION) as running:
        running.rosrv("monitor", "load", str(specification))
        running.reload(CLOSED)
        with xmlrpc.client.ServerProxy(running.master_uri) as master:
            assert (
                cast(master.registerPublisher("/evil", "/cmd_vel", "std_msgs/String", "http://127.0.0.1:1/"))[
                    0
                ]
                != 1
            )
        yield running


def cast(answer: Any) -> list[Any]:
    assert isinstance(answer, list)
    return answer


def proved(bundle: Path, key: Path) -> str:
    with zipfile.ZipFile(bundle) as archive:
        program = archive.read("verify.py")
    command = ["/usr/bin/python3", "-I", "-", str(bundle), "--key", str(key)]
    done = subprocess.run(command, input=program, env={}, capture_output=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout.decode()


def records_of(bundle: Path) -> list[dict[str, Any]]:
    with zipfile.ZipFile(bundle) as archive:
        return [json.loads(line) for line in archive.read("records.ndjson").splitlines()]


def test_over_the_command_line(appliance: Appliance, tmp_path: Path) -> None:
    bundle = tmp_path / "incident.zip"
    appliance.rosrv("evidence", "export", "--since", "1h", "-o", str(bundle))
    assert bundle.stat().st_mode & 0o777 == 0o600
    said = proved(bundle, appliance.state / "control/audit.pub")
    assert "unproven  policies" not in said
    assert "unproven  spec" not in said
    with zipfile.ZipFile(bundle) as archive:
        names = archive.namelist()
        assert archive.read("policies/2.ini").decode() == CLOSED
        assert archive.read("specifications/1/a.rv").decode() == MONITOR
        assert "[Publishers] /cmd_vel" in archive.read("index.html").decode()
    assert "policies/1.ini" in names
    assert "deny" in [record["decision"] for record in records_of(bundle)]
    [record] = appliance.recorded("--event", "evidence exported")
    assert record["detail"]["who"] == "operator"
    assert appliance.rosrv("evidence", "verify", str(bundle), state=False).stdout.endswith("sealed it\n")
    again = appliance.rosrv("evidence", "export", "--since", "1h", "-o", str(bundle), check=False)
    assert (again.returncode, again.stderr) == (2, f"rosrv: {bundle}: File exists; name a new file\n")


def test_over_rest_it_is_not_for_viewers(appliance: Appliance, tmp_path: Path) -> None:
    rest = appliance.rest()
    viewer = appliance.rest(
        json.loads(appliance.rosrv("token", "add", "eve", "--role", "viewer", "--json").stdout)["token"]
    )
    assert viewer.get("/v1/evidence?since=1h").status == 403
    assert rest.get("/v1/evidence").status == 422
    assert rest.get("/v1/evidence?since=never").status == 422
    assert rest.get("/v1/evidence?since=1970-01-01&until=1970-01-02").status == 404
    since = appliance.audit("--oldest-first")[0]["time"]
    until = appliance.recorded("--event", "decision")[0]["time"]
    answer = rest.get(f"/v1/evidence?since={since}&until={until}")
    assert (answer.status, answer.headers["content-type"]) == (200, "application/zip")
    bundle, other = tmp_path / "rest.zip", tmp_path / "socket.zip"
    bundle.write_bytes(answer.body)
    proved(bundle, appliance.state / "control/audit.pub")
    appliance.rosrv("evidence", "export", "--since", since, "--until", until, "-o", str(other))
    manifests = []
    for place in (bundle, other):
        with zipfile.ZipFile(place) as archive:
            manifests.append(archive.read("manifest.json"))
    assert manifests[0] == manifests[1]
    by = [record["detail"]["who"] for record in appliance.recorded("--event", "evidence exported", count=2)]
    assert by[:2] == ["operator", "first"]


def test_a_recording_exports_as_evidence(appliance: Appliance, tmp_path: Path) -> None:
    order = appliance.rosrv(
        "record", "now", "--before", "2s", "--after", "1s", "--note", "the arm hit the door", "--json"
    )
    recording = json.loads(order.stdout)["id"]
    appliance.recorded("--event", "recording closed")
    bundle = tmp_path / "recording.zip"
    appliance.rosrv("evidence", "export", recording, "-o", str(bundle))
    assert "unproven  recording" not in proved(bundle, appliance.state / "control/audit.pub")
    made = appliance.rosrv("token", "add", "carol", "--role", "investigator", "--json").stdout
    investigator, path = appliance.rest(json.loads(made)["token"]), f"/v1/recordings/{recording}/evidence"
    assert appliance.rest().get(path).status == 403
    answer = investigator.get(path)
    (tmp_path / "rest.zip").write_bytes(answer.body)
    proved(tmp_path / "rest.zip", appliance.state / "control/audit.pub")
    assert investigator.get(path.replace(recording, "0" * 20)).status == 404
    assert investigator.get("/v1/evidence?since=1h").status == 200
    with zipfile.ZipFile(bundle) as archive:
        assert archive.read("recording/recording.bag").startswith(b"#ROSBAG V2.0")
        assert json.loads(archive.read("recording/recording.json"))["id"] == recording
        assert "the arm hit the door" in archive.read("index.html").decode()
    fetched = appliance.recorded("--event", "recording fetched", "--oldest-first", count=2)
    assert [record["detail"]["who"] for record in fetched] == ["operator", "carol"]
    refused = appliance.rosrv("evidence", "export", "../x", "-o", str(tmp_path / "x.zip"), check=False)
    assert (refused.returncode, refused.stderr) == (
        1,
        "rosrv: id: must be 20 hexadecimal digits (0-9, a-f)\n",
    )
    absent = appliance.rosrv("evidence", "export", "0" * 20, "-o", str(tmp_path / "x.zip"), check=False)
    assert (absent.returncode, absent.stderr) == (
        1,
        f"rosrv: there is no recording {'0' * 20}: rosrv record list\n",
    )
    both = ("evidence", "export", recording, "--since", "1h", "-o", str(tmp_path / "x.zip"))
    assert appliance.rosrv(*both, check=False).returncode == 2


def test_a_time_without_records(appliance: Appliance, tmp_path: Path) -> None:
    place = tmp_path / "x.zip"
    span = ("--since", "1970-01-01", "--until", "1970-01-02")
    done = appliance.rosrv("evidence", "export", *span, "-o", str(place), check=False)
    assert (done.returncode, done.stderr) == (
        1,
        "rosrv: the log has no record in that period: give another one (rosrv audit search --since)\n",
    )
    assert not place.exists()


def test_the_verifier_of_this_version_is_the_one_in_its_bundles(appliance: Appliance, tmp_path: Path) -> None:
    bundle = tmp_path / "a.zip"
    appliance.rosrv("evidence", "export", "--since", "1h", "-o", str(bundle))
    with zipfile.ZipFile(bundle) as archive:
        assert (
            appliance.rosrv("evidence", "verifier", state=False).stdout == archive.read("verify.py").decode()
        )
