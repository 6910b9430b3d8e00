import json
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.appliance import Appliance
from tests.support.command import ROSRV
from tests.support.nodes import RosSession, need_ros
from tests.support.rest import Answer, Rest
from tests.support.waiting import eventually

OTHER = "count() { event said() /chatter std_msgs/String '{}' { } }\n"
DROPPING = "speed() { event said() /chatter std_msgs/String '{}' { return; } }\n"


@pytest.fixture(scope="module")
def common_appliance() -> Iterator[Appliance]:
    appliance = Appliance()
    folder = appliance.directory / "monitors"
    folder.mkdir()
    appliance.options = ("--api", "127.0.0.1:0", "--api-tls", "off", "--monitors", str(folder))
    with appliance as running:
        yield running


@pytest.fixture
def appliance(common_appliance: Appliance) -> Iterator[Appliance]:
    common_appliance.ignore_earlier_records()
    yield common_appliance
    common_appliance.rosrv("monitor", "reload", "--prune")


def load(rest: Rest, files: dict[str, str], match: str = "*") -> Answer:
    return rest.post("/v1/monitors", {"files": files}, match=match)


def test_effects_of_a_monitor_are_counted_and_kept(appliance: Appliance, tmp_path: Path) -> None:
    need_ros()
    rest = appliance.rest()
    load(rest, {"speed.rv": DROPPING, "tally.rv": OTHER.replace("count", "tally")})
    with RosSession(appliance.master_uri, tmp_path) as ros:
        ros.talker("rospy", "/chatter", name="talker")
        events = rest.events("/v1/audit/stream?event=message%20dropped&after=0")
        next(events)
        dropped = json.loads(next(event for event in events if event.get("event") == "record")["data"])
        events.close()
    assert dropped["detail"]["monitor"] == "speed"
    happened = rest.get("/v1/monitors/speed/history").json["happened"]
    assert "message dropped" in {one["event"] for one in happened}
    assert {one["resource"] for one in happened if one["event"] == "message dropped"} == {"/chatter"}
    assert rest.get("/v1/monitors/tally/history").json["happened"] == []

    def counted() -> dict[str, Any] | None:
        row: dict[str, Any] = next(
            monitor for monitor in rest.get("/v1/monitors").json["monitors"] if monitor["name"] == "speed"
        )
        return row if row["drops"] else None

    row = eventually(counted, "the relay reports its counters")
    assert row["events"] >= row["drops"]


def nested_repetitions() -> str:
    formula = "(a | b)* a"
    for _ in range(12):
        formula = f"({formula} (a|b))"
    events = " ".join(f"event {name}() /{name} std_msgs/Bool '{{}}' {{ }}" for name in "ab")
    return "\n".join(f"n{number}() {{ {events} ere: {formula} @match {{ }} }}" for number in range(118))


def _compiler(appliance: Appliance) -> tuple[int, float]:
    pid = int(appliance.processes().get("compiler", {"pid": 0})["pid"])
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return 0, 0.0
    return pid, (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _compiling(appliance: Appliance, before: tuple[int, float]) -> bool:
    pid, seconds = _compiler(appliance)
    return seconds > 2.5 + (before[1] if pid == before[0] else 0)


@pytest.mark.parametrize("way", ["state", "api"])
def test_the_load_of_a_tool_that_was_killed_never_comes_into_force(
    appliance: Appliance, tmp_path: Path, way: str
) -> None:
    (tmp_path / "nested.rv").write_text(nested_repetitions())
    before = appliance.rest().get("/v1/monitors").json["tag"]
    place = ["--state", str(appliance.state)] if way == "state" else ["--api", str(appliance.ready["api"])]
    compiler = _compiler(appliance)
    tool = subprocess.Popen(
        [ROSRV, "monitor", "load", str(tmp_path / "nested.rv"), *place],
        env={**os.environ, "ROSRV_TOKEN": appliance.token},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    eventually(lambda: _compiling(appliance, compiler), "the load is compiled")
    tool.kill()
    tool.wait()
    loaded = load(appliance.rest(), {"count.rv": OTHER}, f'"{before}"')
    assert (loaded.status, loaded.json["monitors"]) == (200, ["count"])
