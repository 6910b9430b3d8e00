"""Monitors over REST: dry run, load, replace, switch and remove while the appliance runs."""

import json
import os
import subprocess
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from tests.support import processes
from tests.support.appliance import Appliance
from tests.support.command import ROSRV
from tests.support.nodes import RosSession, has_ros
from tests.support.requirements import needs
from tests.support.rest import Answer, Rest
from tests.support.waiting import eventually

LIMIT = """\
speed() {
    int seen;
    event said(std::string text) /chatter std_msgs/String '{data:text}' { seen = seen + 1; }
    event never() /quiet std_msgs/String '{}' { }
    ere: said* never
    @fail { ROS_WARN("said after never"); }
}
"""
WRONG = "speed() {\n    event said() /chatter std_msgs/Strong '{}' { }\n}\n"
OTHER = "count() { event said() /chatter std_msgs/String '{}' { } }\n"
DROPPING = "speed() { event said() /chatter std_msgs/String '{}' { return; } }\n"


@pytest.fixture(scope="module")
def common_appliance() -> Iterator[Appliance]:
    """Run an appliance with an empty folder of specifications."""
    appliance = Appliance()
    folder = appliance.directory / "monitors"
    folder.mkdir()
    appliance.options = ("--api", "127.0.0.1:0", "--api-tls", "off", "--monitors", str(folder))
    with appliance as running:
        yield running


@pytest.fixture
def appliance(common_appliance: Appliance) -> Iterator[Appliance]:
    """Provide the appliance without specifications, and with only this test's log."""
    common_appliance.ignore_earlier_records()
    yield common_appliance
    common_appliance.rosrv("monitor", "reload", "--prune")


@pytest.fixture(scope="module")
def without_folder() -> Iterator[Appliance]:
    """Run an appliance without a folder of specifications."""
    with Appliance(options=("--api", "127.0.0.1:0", "--api-tls", "off")) as running:
        yield running


def send(
    rest: Rest,
    method: str,
    path: str,
    body: object,
    match: str | None = None,
    *,
    timeout: float = processes.LIMIT,
) -> Answer:
    """Send a request with JSON (a string: as text/plain) and If-Match."""
    headers = {} if match is None else {"If-Match": match}
    kind = "text/plain" if isinstance(body, str) else "application/json"
    data = body.encode() if isinstance(body, str) else json.dumps(body).encode()
    return rest.request(
        method, path, None if body is None else data, headers | {"Content-Type": kind}, timeout
    )


def load(
    rest: Rest,
    files: dict[str, str],
    match: str | None = "*",
    query: str = "",
    *,
    timeout: float = processes.LIMIT,
) -> Answer:
    """POST specifications."""
    return send(rest, "POST", f"/v1/monitors{query}", {"files": files}, match, timeout=timeout)


def test_a_specification_is_tried_loaded_replaced_and_removed(appliance: Appliance) -> None:
    """Dry run, load, new text, removal: each reports its effect, and the ETag follows the revision."""
    rest = appliance.rest()
    empty = rest.get("/v1/monitors")
    assert (empty.json["monitors"], empty.json["differs_from_folder"]) == ([], False)
    tried = load(rest, {"speed.rv": LIMIT}, None, "?dry_run=1").json
    assert (tried["loaded"], tried["added"], tried["monitors"]) == (False, ["speed.rv"], ["speed"])
    assert rest.get("/v1/monitors").json["monitors"] == []
    loaded = load(rest, {"speed.rv": LIMIT, "count.rv": OTHER}, empty.etag)
    assert loaded.status == 200, loaded.body
    assert (loaded.json["added"], loaded.json["monitors"]) == (["count.rv", "speed.rv"], ["count", "speed"])
    shown = rest.get("/v1/monitors?texts=1")
    assert shown.etag == loaded.etag != empty.etag
    assert shown.json["differs_from_folder"] is True
    assert shown.json["who"] == "first"
    assert shown.json["files"] == {"count.rv": OTHER, "speed.rv": LIMIT}
    replaced = send(rest, "PUT", "/v1/monitors/speed", LIMIT.replace("seen + 1", "seen + 2"), shown.etag)
    assert replaced.json["changed"] == ["speed.rv"]
    removed = send(rest, "DELETE", "/v1/monitors/speed", None, replaced.etag)
    assert (removed.json["removed"], removed.json["monitors"]) == (["speed.rv"], ["count"])
    reloaded = send(rest, "POST", "/v1/monitors/reload", None, removed.etag)
    assert (reloaded.json["kept"], reloaded.json["monitors"]) == (["count.rv"], ["count"])
    pruned = send(rest, "POST", "/v1/monitors/reload?prune=1", None, reloaded.etag)
    assert (pruned.json["removed"], pruned.json["monitors"]) == (["count.rv"], [])
    assert rest.get("/v1/monitors").json["who"] == "disk"
    records = appliance.recorded("--event", "specifications loaded", count=5)
    assert [one["detail"]["who"] for one in records] == ["first"] * 5


def test_a_reload_keeps_monitors_loaded_over_rest(appliance: Appliance) -> None:
    """The folder is read again; a monitor that is not in it stays until an admin removes it."""
    rest, file = appliance.rest(), appliance.directory / "monitors" / "count.rv"
    file.write_text(OTHER)
    assert "added count.rv" in appliance.rosrv("monitor", "reload").stdout
    assert load(rest, {"speed.rv": LIMIT}).status == 200
    assert "reload" not in appliance.rosrv("status", check=False).stdout
    file.unlink()
    said = appliance.rosrv("monitor", "reload").stdout
    assert "in force but not in the folder: count.rv, speed.rv" in said
    assert [one["name"] for one in rest.get("/v1/monitors").json["monitors"]] == ["count", "speed"]
    made = appliance.rosrv("token", "add", "op", "--role", "operator", "--json").stdout
    operator = rest.with_token(json.loads(made)["token"])
    assert send(operator, "POST", "/v1/monitors/reload?prune=1", None, "*").status == 403
    assert "removed count.rv, speed.rv" in appliance.rosrv("monitor", "reload", "--prune").stdout


def test_a_rollback_and_a_confirmed_load(appliance: Appliance) -> None:
    """REST and the command behave alike: the revision in force, its changes, the rollback, and the time limit."""
    rest = appliance.rest()
    loaded = load(rest, {"speed.rv": LIMIT})
    gone = send(rest, "DELETE", "/v1/monitors/speed?confirm_within=600", None, loaded.etag)
    assert gone.json["confirm_by"] > 0
    assert "rosrv monitor confirm" in appliance.rosrv("status", check=False).stdout
    assert send(rest, "POST", "/v1/monitors/confirm", None, gone.etag).json["confirmed"] is True
    assert appliance.rosrv("monitor", "confirm", check=False).returncode == 1
    rows = rest.get("/v1/monitors/revisions").json["revisions"]
    kept, present = loaded.json["revision"], gone.json["revision"]
    named = {row["revision"]: (row["names"], row["in_force"]) for row in rows}
    assert (named[kept], named[present]) == ((["speed.rv"], False), ([], True))
    assert rest.get(f"/v1/monitors/revisions/{kept}").json["files"] == {"speed.rv": LIMIT}
    assert rest.get("/v1/monitors/revisions/999").status == 404
    diff = appliance.rosrv("monitor", "diff", check=False)
    assert diff.returncode == 1
    assert [f"-{line}" for line in LIMIT.splitlines()] == diff.stdout.splitlines()[3:]
    made = appliance.rosrv("token", "add", "watch", "--role", "operator", "--json").stdout
    operator = rest.with_token(json.loads(made)["token"])
    assert send(operator, "POST", "/v1/monitors/rollback", {"revision": kept}, "*").status == 403
    back = send(rest, "POST", "/v1/monitors/rollback", {"revision": kept}, "*")
    assert (back.json["added"], back.json["monitors"]) == (["speed.rv"], ["speed"])
    assert "removed speed.rv" in appliance.rosrv("monitor", "rollback", str(present)).stdout
    assert appliance.rosrv("monitor", "show", str(kept)).stdout.splitlines()[1:] == LIMIT.splitlines()


def test_without_a_folder_a_reload_is_an_error(without_folder: Appliance) -> None:
    """No monitor is removed, by command or over REST, and the error says how to configure a folder."""
    rest = without_folder.rest()
    assert load(rest, {"speed.rv": LIMIT}).status == 200
    done = without_folder.rosrv("monitor", "reload", check=False)
    assert (done.returncode, "no folder of specifications is configured" in done.stderr) == (1, True)
    assert send(rest, "POST", "/v1/monitors/reload", None, "*").status == 422
    body = rest.get("/v1/monitors").json
    assert [one["name"] for one in body["monitors"]] == ["speed"]
    assert body["differs_from_folder"] is False


def test_one_monitor_is_shown_in_detail(appliance: Appliance) -> None:
    """The answer has text, events, properties, lint, counters and a picture of the automaton; an unknown one is 404."""
    rest = appliance.rest()
    load(rest, {"speed.rv": LIMIT, "count.rv": OTHER})
    shown = rest.get("/v1/monitors/speed").json
    assert shown["text"] == LIMIT
    assert [(one["name"], one["line"], one["topic"], one["type"]) for one in shown["alphabet"]] == [
        ("said", 3, "/chatter", "std_msgs/String"), ("never", 4, "/quiet", "std_msgs/String"),
    ]  # fmt: skip
    (one,) = shown["properties"]
    assert (one["logic"], one["formula"], one["handled"], one["drawn"]) == (
        "ere", "said* never", ["fail"], True,
    )  # fmt: skip
    assert (shown["enabled"], shown["held"], shown["failing"], shown["verdicts"]) == (True, False, False, 0)
    picture = rest.get("/v1/monitors/speed/picture")
    assert picture.headers["content-type"].startswith("image/svg+xml")
    assert picture.body.startswith(b"<svg ")
    assert rest.get("/v1/monitors/count/picture").status == 404
    unknown = rest.get("/v1/monitors/nobody")
    assert unknown.status == 404
    assert "there are: count, speed" in unknown.json["detail"]


def test_an_invalid_specification_is_rejected_with_its_place(appliance: Appliance) -> None:
    """An error in a dry run or load is 422 with file, line and column; the revision in force stays."""
    rest = appliance.rest()
    before = load(rest, {"speed.rv": LIMIT}).json["revision"]
    for query, match in (("?dry_run=1", None), ("", "*")):
        refused = load(rest, {"speed.rv": WRONG, "count.rv": OTHER}, match, query)
        assert refused.status == 422
        assert refused.json["type"] == "urn:rosrv:problem:specifications-refused"
        (finding,) = refused.json["findings"]
        assert (finding["file"], finding["line"], finding["severity"]) == ("speed.rv", 2, "error")
        assert refused.json["column"] == finding["column"] > 1
        assert "std_msgs/String" in finding["text"]
    assert send(rest, "PUT", "/v1/monitors/speed", WRONG, "*").status == 422
    assert rest.get("/v1/monitors").json["revision"] == before
    assert rest.get("/v1/monitors/speed").json["text"] == LIMIT


def test_a_stale_etag_cannot_undo_a_switch(appliance: Appliance) -> None:
    """A stale ETag gets 412 with the current ETag and has no effect, after a switch, a load and a restart."""
    rest = appliance.rest()
    empty = rest.get("/v1/monitors").etag
    loaded = load(rest, {"speed.rv": LIMIT})
    seen = loaded.etag
    assert rest.get("/v1/monitors").etag == rest.get("/v1/monitors/speed").etag == seen
    off = send(rest, "PATCH", "/v1/monitors/speed", {"enabled": False}, seen)
    now = off.etag
    assert (off.status, off.json["names"]) == (200, ["speed"])
    assert (
        rest.get("/v1/monitors").etag == rest.get("/v1/monitors/speed").etag == now == f'"{off.json["tag"]}"'
    )
    changes = (
        ("PATCH", "/speed", {"enabled": True}), ("PATCH", "", {"names": ["speed"], "held": False}),
        ("PUT", "/speed", OTHER), ("POST", "", {"files": {"count.rv": OTHER}}), ("POST", "/reload", None),
        ("POST", "?dry_run=1", {"files": {"count.rv": OTHER}}), ("DELETE", "/speed", None),
        ("DELETE", "?name=speed", None),
    )  # fmt: skip
    # Two earlier ETags, and one of a version whose ETags were numbers.
    for stale in (empty, seen, f'"{loaded.json["revision"]}"'):
        for method, path, body in changes:
            refused = send(rest, method, f"/v1/monitors{path}", body, stale)
            assert (refused.status, refused.headers.get("etag")) == (412, now), (method, path, refused.body)
    state = rest.get("/v1/monitors").json
    before = loaded.json["revision"]
    assert (state["revision"], [one["enabled"] for one in state["monitors"]]) == (before, [False])
    same = send(rest, "PATCH", "/v1/monitors/speed", {"enabled": False}, now)
    assert (same.etag, same.json["names"]) == (now, [])
    appliance.stop()
    appliance.start()
    rest = appliance.rest(rest.token)
    assert rest.get("/v1/monitors").etag == now
    assert send(rest, "PATCH", "/v1/monitors/speed", {"enabled": True}, seen).status == 412
    assert send(rest, "PATCH", "/v1/monitors/speed", {"enabled": True}, now).status == 200


def test_monitors_are_switched_together_or_not_at_all(appliance: Appliance) -> None:
    """PATCH returns the monitors that it changed; with an unknown name it changes none."""
    rest = appliance.rest()
    load(rest, {"speed.rv": LIMIT, "count.rv": OTHER})
    assert send(rest, "PATCH", "/v1/monitors/speed", {"enabled": False}, "*").json["names"] == ["speed"]
    both = {"names": ["speed", "count"], "enabled": False}
    assert send(rest, "PATCH", "/v1/monitors", both, "*").json["names"] == ["count"]
    unknown = {"names": ["speed", "nobody"], "enabled": True}
    assert send(rest, "PATCH", "/v1/monitors", unknown, "*").status == 404
    assert not any(one["enabled"] for one in rest.get("/v1/monitors").json["monitors"])
    assert send(rest, "PATCH", "/v1/monitors/speed", {"held": False}, "*").json["names"] == []


def test_a_monitor_is_tried_and_promoted(appliance: Appliance) -> None:
    """Operators can do both; shadow mode survives a restart, and enabling the monitor does not end shadow mode."""
    rest = appliance.rest()
    load(rest, {"speed.rv": LIMIT})
    made = appliance.rosrv("token", "add", "olga", "--role", "operator", "--json").stdout
    operator = rest.with_token(json.loads(made)["token"])
    tried = send(operator, "PATCH", "/v1/monitors/speed", {"shadow": True}, rest.get("/v1/monitors").etag)
    assert (tried.status, tried.json["names"], tried.json["began"]) == (200, ["speed"], [])
    assert (
        send(operator, "PATCH", "/v1/monitors/speed", {"shadow": False, "enabled": True}, "*").status == 422
    )
    appliance.stop()
    appliance.start()
    rest = appliance.rest(rest.token)
    row = rest.get("/v1/monitors/speed").json
    assert (row["shadow"], row["enabled"], row["would_drop"], row["missed"]) == (True, False, 0, 0)
    refused = send(rest, "PATCH", "/v1/monitors/speed", {"enabled": True}, "*")
    assert refused.status == 422
    assert "rosrv monitor promote" in str(refused.json)
    assert rest.get("/v1/status").json["monitors"]["shadow"] == ["speed"]
    assert send(rest, "PATCH", "/v1/monitors", {"names": ["speed"], "shadow": False}, "*").status == 200
    assert rest.get("/v1/monitors/speed").json["enabled"]
    for event in ("monitor in shadow mode", "monitor enabled"):
        assert appliance.recorded("--event", event, resource="speed")


def test_effects_of_a_monitor_are_counted_and_kept(appliance: Appliance, tmp_path: Path) -> None:
    """A monitor drops every message of a real talker: its counters rise, and its history has the drops."""
    needs(has_ros(), "ROS 1 and g++ (run `make setup`)")
    rest = appliance.rest()
    load(rest, {"speed.rv": DROPPING, "tally.rv": OTHER.replace("count", "tally")})
    with RosSession(appliance.master_uri, tmp_path) as ros:
        ros.talker("rospy", "/chatter", name="talker")
        events = rest.events("/v1/audit/stream?event=message%20dropped&after=0")
        next(events)
        dropped = json.loads(next(one for one in events if one.get("event") == "record")["data"])
        events.close()
    assert dropped["detail"]["monitor"] == "speed"
    happened = rest.get("/v1/monitors/speed/history").json["happened"]
    assert "message dropped" in {one["event"] for one in happened}
    assert {one["resource"] for one in happened if one["event"] == "message dropped"} == {"/chatter"}
    assert rest.get("/v1/monitors/tally/history").json["happened"] == []

    def counted() -> dict[str, Any] | None:
        row: dict[str, Any] = next(
            one for one in rest.get("/v1/monitors").json["monitors"] if one["name"] == "speed"
        )
        return row if row["drops"] else None

    row = eventually(counted, "the relay reports its counters")
    assert row["events"] >= row["drops"]


def nested_repetitions(count: int) -> dict[str, str]:
    """Return specifications whose automata take the compiler about a second each."""
    formula = "(a | b)* a"
    for _ in range(12):
        formula = f"({formula} (a|b))"
    events = " ".join(f"event {name}() /{name} std_msgs/Bool '{{}}' {{ }}" for name in "ab")
    text = "\n".join(f"n{number}() {{ {events} ere: {formula} @match {{ }} }}" for number in range(count))
    return {"nested.rv": text}


def _compiler(appliance: Appliance) -> tuple[int, float]:
    """Return the process id of the compiler and its processor time in seconds; zeros if none runs."""
    pid = int(appliance.processes().get("compiler", {"pid": 0})["pid"])
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return 0, 0.0
    return pid, (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _compiling(appliance: Appliance, before: tuple[int, float]) -> bool:
    """Whether the compiler is working: since `before`, it used more processor time than a start takes."""
    pid, seconds = _compiler(appliance)
    return seconds > 2.5 + (before[1] if pid == before[0] else 0)


def test_a_load_ends_the_dry_run_of_an_operator(appliance: Appliance) -> None:
    """An operator's costly dry run is cancelled with an answer, and the administrator's load comes into force."""
    made = appliance.rosrv("token", "add", "trying", "--role", "operator", "--json").stdout
    operator = appliance.rest().with_token(json.loads(made)["token"])
    compiler = _compiler(appliance)
    with ThreadPoolExecutor(1) as pool:
        trying = pool.submit(
            load, operator, nested_repetitions(118), None, "?dry_run=1", timeout=4 * processes.LIMIT
        )
        eventually(lambda: _compiling(appliance, compiler), "the dry run is compiled")
        loaded = load(appliance.rest(), {"count.rv": OTHER})
        assert (loaded.status, loaded.json["monitors"]) == (200, ["count"])
        tried = trying.result()
    assert tried.status == 422
    assert "because a change needed the compiler" in tried.json["detail"]
    assert appliance.rest().get("/v1/monitors").json["revision"] == loaded.json["revision"]


@pytest.mark.parametrize("way", ["state", "api"])
def test_the_load_of_a_tool_that_was_killed_never_comes_into_force(
    appliance: Appliance, tmp_path: Path, way: str
) -> None:
    """A load whose client is killed during the compilation is withdrawn, and the next one does not wait for it."""
    (tmp_path / "nested.rv").write_text(nested_repetitions(118)["nested.rv"])
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
