"""The report of a running appliance, of orders that were given a moment ago."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.command import rosrv

SPEED = """speed() given { double vMax = 1.5 m/s in 0..2; } {
    event said() /chatter std_msgs/String '{}' when (vMax > 9) { } }"""


@pytest.fixture(scope="module")
def appliance(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Appliance]:
    file = tmp_path_factory.mktemp("texts") / "speed.rv"
    file.write_text(SPEED)
    appliance = Appliance(policy=OPEN_POLICY)
    (appliance.directory / "monitors").mkdir()
    appliance.options = ("--api", "127.0.0.1:0", "--monitors", str(appliance.directory / "monitors"))
    with appliance as running:
        running.rest()
        for words in (
            ("monitor", "load", str(file)), ("monitor", "set", "speed", "vMax=0.5"), ("monitor", "disable", "speed"),
            ("token", "add", "auditor", "--role", "viewer"), ("host", "block", "10.9.9.9"),
            ("monitor", "remove", "speed"),
        ):  # fmt: skip
            done = running.rosrv(*words)
            assert done.returncode == 0, done.stderr
        yield running


def report(appliance: Appliance, *place: str) -> dict[str, Any]:
    done = rosrv("report", "interventions", "--json", *place, ROSRV_TOKEN=appliance.token)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def test_each_order_has_the_state_before_and_after(appliance: Appliance) -> None:
    found = report(appliance, "--state", str(appliance.state))
    rows = {row["event"]: row for row in found["interventions"]}
    assert (rows["monitor set"]["before"], rows["monitor set"]["after"]) == ("vMax = 1.5", "vMax = 0.5")
    assert (rows["monitor disabled"]["before"], rows["monitor disabled"]["after"]) == ("enabled", "disabled")
    assert rows["specifications loaded"]["diff"][-2].startswith("-speed()")
    assert rows["specifications loaded"]["sha256_before"] != rows["specifications loaded"]["sha256_after"]
    assert (rows["host blocked"]["before"], rows["host blocked"]["what"]) == ("not blocked", "10.9.9.9")
    (off,) = (one for one in found["switched_off"] if one["what"] == "speed")
    assert (
        off["until_utc"] == rows["specifications loaded"]["time_utc"]
    )  # the monitor was removed while it was off


def test_the_report_knows_the_interfaces_and_rights_of_now(appliance: Appliance, tmp_path: Path) -> None:
    found = report(appliance, "--state", str(appliance.state))
    assert not found["live_reason"]
    assert {"ROS Master API", "REST and console", "admin socket"} <= {
        row["name"] for row in found["interfaces"]
    }
    assert any("stop the robot remotely" in row["what"] for row in found["rights"])
    page = tmp_path / "report.html"
    done = rosrv("report", "interventions", "--state", str(appliance.state), "--output", str(page))
    assert done.returncode == 0 and "vMax = 0.5" in page.read_text()


def test_the_interventions_are_the_same_over_rest(appliance: Appliance) -> None:
    certificate = str(appliance.state / "api" / "certificate.pem")
    over_rest = report(appliance, "--api", str(appliance.ready["api"]), "--api-ca", certificate)
    here = report(appliance, "--state", str(appliance.state))
    assert "run it with --state" in over_rest["live_reason"]
    for name in ("interventions", "switched_off", "blocks", "software"):
        assert over_rest[name] == here[name], name
