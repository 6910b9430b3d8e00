import hashlib
import json
import os
import signal
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from appliance.api.routes.contract import EXAMPLES
from appliance.features.recorder.mcap import as_mcap
from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.command import rosrv
from tests.support.nodes import RosSession, need_ros
from tests.support.waiting import eventually

MONITOR = """
censor() {
    event said(std::string text) /rude std_msgs/String '{data:text}' {
        if (text.size() > 2) { return; }
    }
}
dated() {
    event said() /dated std_msgs/String '{}' { ROS_INFO("%ld", ros::Time::now().toNSec()); }
}
"""
CONFIGURATION = """
recorder:
  enabled: true
  memory: 16MiB
  before: 300
  after: 2
  disk: 512MiB
  triggers: [drop, service]
  never: [/secret/*]
audit: {reserve_bytes: 1MiB}
"""


@pytest.fixture(scope="module")
def recording() -> Iterator[Appliance]:
    need_ros()
    monitors, options = {"censor": MONITOR}, ("--api", "127.0.0.1:0")
    with Appliance(settings=CONFIGURATION, monitors=monitors, options=options) as appliance:
        yield appliance


@pytest.fixture
def appliance(recording: Appliance) -> Iterator[Appliance]:
    recording.ignore_earlier_records()
    yield recording
    for row in recording.rows("record", "list"):
        recording.rosrv("record", "remove", row["id"])


def recordings(appliance: Appliance, count: int = 1) -> list[dict[str, Any]]:
    def found() -> list[dict[str, Any]] | None:
        rows = appliance.rows("record", "list")
        return rows if len(rows) >= count else None

    return eventually(found, appliance.story)


def fetched(appliance: Appliance, recording: str, folder: Path) -> Path:
    bag = folder / f"{recording}.bag"
    appliance.rosrv("record", "fetch", recording, "--output", str(bag))
    assert stat.S_IMODE(bag.stat().st_mode) == 0o600
    return bag


def said(ros: RosSession, bag: Path, topic: str) -> list[str]:
    """Return the texts in a bag, read by Debian's rosbag in sequence and, like rqt_bag, by the index."""
    program = (
        "import rosbag, sys\n"
        "bag, topics = rosbag.Bag(sys.argv[1]), [sys.argv[2]]\n"
        "said = [message.data for _topic, message, _time in bag.read_messages(topics)]\n"
        "entries = bag._get_entries(list(bag._get_connections(topics)))\n"
        "assert [bag._read_message(entry.position).message.data for entry in entries] == said\n"
        "for text in said:\n"
        "    print(text)"
    )
    return ros.run("/usr/bin/python3", "-c", program, str(bag), topic).stdout.splitlines()


def test_a_recording_has_the_timestamps_of_the_monitors(
    appliance: Appliance, ros: RosSession, tmp_path: Path
) -> None:
    ros.talker("rospy", "/dated")
    lines = appliance.recorded(event="monitor log", count=15)
    appliance.rosrv("record", "now", "--before", "1m", "--after", "1s")
    bag = fetched(appliance, recordings(appliance)[0]["id"], tmp_path)
    (tmp_path / "dated.rv").write_text(MONITOR)
    again = rosrv("monitor", "run", str(tmp_path / "dated.rv"), "--bag", str(bag), "--json").stdout
    told = {line["text"] for record in again.splitlines() for line in json.loads(record)["log"]}
    assert {line["reason"] for line in lines if not line["detail"].get("count")} <= told


def viewers_see_no_contents(appliance: Appliance, dropped: str) -> None:
    path, every = f"/v1/audit/{dropped}?neighbours=0", "event=message+dropped"
    for role in ("viewer", "investigator", "operator"):
        made = appliance.rosrv("token", "add", f"a-{role}", "--role", role, "--json").stdout
        rest = appliance.rest(json.loads(made)["token"])
        detail = rest.get(path).json["record"]["detail"]
        assert ("before_fields" in detail) is (role != "viewer")
        assert ("before_fields" in detail.get("withheld", ())) is (role == "viewer")
        exported = rest.get(f"/v1/audit/export?{every}").body
        assert json.loads(exported.splitlines()[0])["id"] == dropped
        assert (b'"chain"' in exported) is (role != "viewer")
        for body in (exported, rest.get(f"/v1/audit?{every}").body):
            assert (b'"bad ' in body) is (role != "viewer")
        assert bool(rest.get(f"/v1/audit?{every}&text=bad").json["records"]) is (role != "viewer")


@pytest.mark.real
def test_a_drop_makes_a_recording_that_stock_tools_read(
    appliance: Appliance, ros: RosSession, tmp_path: Path
) -> None:
    assert "no recordings; make one: rosrv record now" in appliance.rosrv("record", "list").stdout
    listener = ros.listener("roscpp", "/chatter", name="ear")
    for topic in ("/rude", "/secret/key"):
        ros.listener("rospy", topic)
    ros.talker("rospy", "/chatter", name="voice")
    ros.talker("roscpp", "/secret/key")
    listener.wait_for_count(20, event="received")
    lout = ros.talker("roscpp", "/rude", "--text", "bad", name="lout")
    dropped = appliance.recorded(event="message dropped")[-1]
    lout.interrupt()
    viewers_see_no_contents(appliance, dropped["id"])
    [row] = recordings(appliance)
    heard = [event["data"] for event in listener.seen(event="received")]
    assert (row["complete"], row["why_not"]) == (True, "")
    assert row["triggers"][0]["what"] == "drop"
    assert (dropped["detail"]["recording"], dropped["detail"]["charged_to"]) == (row["id"], "robot")
    bag = fetched(appliance, row["id"], tmp_path)
    chatter = said(ros, bag, "/chatter")
    assert chatter[:20] == heard[:20]
    assert any(text.startswith("bad") for text in said(ros, bag, "/rude"))
    assert said(ros, bag, "/secret/key") == []
    decided = [json.loads(line) for line in said(ros, bag, "/rosrv/records")]
    assert row["triggers"][0]["record"] in {record["id"] for record in decided}
    info = ros.run("/usr/bin/rosbag", "info", str(bag)).stdout
    assert "/rosrv/log" in info
    assert "rosgraph_msgs/Log" in info
    assert ros.run("/usr/bin/rosbag", "check", str(bag), check=False).returncode == 0
    [closed] = appliance.recorded(event="recording closed")
    assert closed["detail"]["recording"] == row["id"]
    assert closed["detail"]["sha256"] == row["sha256"] == hashlib.sha256(bag.read_bytes()).hexdigest()
    assert appliance.recorded(event="recording fetched")[0]["detail"]["who"] == "operator"
    shown = json.loads(appliance.rosrv("record", "timeline", row["id"], "--columns", "20", "--json").stdout)
    flows = {flow["topic"]: flow for flow in shown["topics"]}
    assert sum(flows["/chatter"]["counts"]) == len(chatter)
    assert [sender["node"] for sender in flows["/rude"]["senders"]] == ["/lout"]
    assert row["triggers"][0]["record"] in {one["record"] for one in shown["events"] if one["kind"] == "drop"}
    assert "/rude" in appliance.rosrv("record", "timeline", row["id"]).stdout
    lines = appliance.rosrv("record", "messages", row["id"], "--topic", "/rude", "--json").stdout.splitlines()
    assert json.loads(lines[0])["fields"]["data"].startswith("bad")
    assert "data: bad" in appliance.rosrv("record", "messages", row["id"], "--topic", "/rude").stdout
    assert appliance.recorded(event="recording read")[0]["detail"]["topics"] == ["/rude"]
    about = appliance.rosrv("record", "messages", row["id"], "--at", dropped["id"]).stdout
    [marked] = [line for line in about.splitlines() if line.startswith("->")]
    assert {"/rude", "/lout"} <= set(marked.split())
    folder = appliance.state / "recordings" / row["id"]
    if os.geteuid() == 0:
        assert (folder.stat().st_uid, folder.stat().st_gid) == (61019, 61014)
        assert stat.S_IMODE((folder / "recording.bag").stat().st_mode) == 0o640
    replayed = appliance.rosrv("monitor", "replay", "censor", "--since", "1h", "--json").stdout
    found = [json.loads(line) for line in replayed.splitlines()]
    drops = [one for one in found if one["kind"] == "drop"]
    assert len([drop for drop in drops if drop["bag"] == row["id"]]) == len(said(ros, bag, "/rude"))
    assert found[0]["kind"] == "gap"
    assert found[0]["until"] == pytest.approx(row["began"] / 10**9, abs=1e-6)  # a gap has microseconds
    table = appliance.rosrv("monitor", "replay", "censor", "--since", "1h").stdout.splitlines()
    assert table[0].startswith("not recorded: ")
    assert table[-1].endswith(" of 2 recordings")
    closest = ("monitor", "replay", "censor", "--since", "1h", "--margins", "--json")
    margins = [json.loads(line) for line in appliance.rosrv(*closest).stdout.splitlines()]
    [offline] = [margin for margin in margins if margin["kind"] == "margin"]
    assert (offline["line"], offline["holds"], offline["threshold_at"]) == (
        4,
        True,
        min(map(len, said(ros, bag, "/rude"))),
    )
    secret = tmp_path / "secret.rv"
    secret.write_text(MONITOR.replace("/rude", "/secret/key"))
    refused = appliance.rosrv("monitor", "replay", str(secret), "--since", "1h", check=False)
    assert (refused.returncode, "recorder.never has /secret/*" in refused.stderr) == (2, True)
    long_ago = ("--since", "2020-01-01", "--until", "2020-01-02")
    nothing = appliance.rosrv("monitor", "replay", "censor", *long_ago, check=False)
    assert (nothing.returncode, "there are no recordings of 2020-01-01" in nothing.stderr) == (1, True)
    mcap = tmp_path / "a.mcap"
    appliance.rosrv("record", "fetch", row["id"], "--mcap", "--output", str(mcap))
    assert mcap.read_bytes() == b"".join(as_mcap(bag))
    appliance.rosrv("record", "remove", row["id"])
    assert not folder.exists()
    assert appliance.recorded(event="recording removed")[0]["detail"]["who"] == "operator"
    assert appliance.rosrv("record", "fetch", row["id"], check=False).returncode == 1


@pytest.mark.parametrize("victims", [("relay",), ("relay", "control")])
def test_messages_of_a_killed_relay_are_in_the_recording(
    appliance: Appliance, ros: RosSession, tmp_path: Path, victims: tuple[str, ...]
) -> None:
    topic = f"/chatter_{len(victims)}"
    listener = ros.listener("roscpp", topic, name="ear")
    ros.talker("roscpp", topic, name="voice")
    listener.wait_for_count(10, event="received")
    for row in appliance.status()["processes"]:
        if row["role"] in victims:
            os.kill(row["pid"], signal.SIGKILL)
    through = len(listener.seen(event="received")) + 5
    listener.wait_for_count(through, event="received")
    begun = json.loads(appliance.rosrv("record", "now", "--after", "1s", "--note", "kill", "--json").stdout)
    [row] = recordings(appliance)
    assert (row["id"], row["triggers"][0]["text"]) == (begun["id"], "operator: kill")
    assert (row["complete"], row["why_not"]) == (True, "")
    chatter = said(ros, fetched(appliance, row["id"], tmp_path), topic)
    assert len({event["data"] for event in listener.seen(event="received")[:through]} - set(chatter)) <= 1
    assert len(chatter) == len(set(chatter))
    assert appliance.recorded(event="recording closed")[0]["detail"]["recording"] == row["id"]


def test_a_killed_recorder_resumes(appliance: Appliance, ros: RosSession, tmp_path: Path) -> None:
    listener = ros.listener("roscpp", "/speech", name="ear")
    ros.talker("roscpp", "/speech", name="voice")
    heard = [event["data"] for event in listener.wait_for_count(10, event="received")]
    begun = json.loads(appliance.rosrv("record", "now", "--after", "3s", "--json").stdout)
    appliance.kill("recorder")
    [row] = recordings(appliance)
    assert (row["id"], row["complete"], row["why_not"]) == (begun["id"], True, "")
    chatter = said(ros, fetched(appliance, row["id"], tmp_path), "/speech")
    assert set(heard) <= set(chatter)
    assert len(chatter) == len(set(chatter))


def test_nodes_can_order_a_recording_if_the_policy_allows(appliance: Appliance, ros: RosSession) -> None:
    service = "/rosrv/record_now"
    ros.talker("roscpp", "/chatter", name="voice")
    eventually(lambda: appliance.status()["recorder"]["running"], appliance.story)
    assert ros.run("rosservice", "type", service).stdout == "std_srvs/Trigger\n"
    assert "/rosrv" in ros.run("rosservice", "node", service).stdout
    answers = []
    for client in ("roscpp", "rospy"):
        node = ros.service_client(client, service, "--trigger", name=f"{client}_arm")
        node.send("now")
        answers.append(node.wait_for(event="answered"))
    assert [answer["success"] for answer in answers] == [True, True]
    called = ros.run("rosservice", "call", service).stdout
    made = {answer["message"] for answer in answers}
    made.add(called.removeprefix('success: True\nmessage: "').rstrip('"\n'))
    row, *later = recordings(appliance, len(made))
    assert {one["id"] for one in (row, *later)} == made
    assert row["triggers"][0]["what"] == "service"
    assert row["triggers"][0]["text"] == f"/roscpp_arm of 127.0.0.1 called {service}"
    ordered = appliance.recorded(event="recording ordered")[-1]
    assert (ordered["caller_id"], ordered["host"], ordered["resource"]) == (
        "/roscpp_arm",
        "127.0.0.1",
        service,
    )
    assert ordered["id"] == row["triggers"][0]["record"]
    ros.service_server("rospy", service, name="namesake")
    [denied] = appliance.recorded(event="decision", decision="deny", caller_id="/namesake")
    assert denied["reason"] == f"the service {service} belongs to the appliance"
    appliance.reload(OPEN_POLICY + f"[Clients]\n{service} = 10.9.9.9\ndefault = *\n")
    unknown = ros.service_client("roscpp", service, "--trigger", name="unknown")
    unknown.send("now")
    unknown.wait_for(event="failed")
    appliance.reload(OPEN_POLICY)
    [denied] = appliance.recorded(event="decision", decision="deny", caller_id="/unknown")
    assert (denied["category"], denied["resource"]) == ("call", service)


def test_over_rest_messages_are_for_investigators(
    appliance: Appliance, ros: RosSession, tmp_path: Path
) -> None:
    def token(role: str) -> str:
        made = appliance.rosrv("token", "add", f"the-{role}", "--role", role, "--json").stdout
        return str(json.loads(made)["token"])

    admin = appliance.rest()
    viewer, operator = admin.with_token(token("viewer")), admin.with_token(token("operator"))
    secret = token("investigator")
    investigator = admin.with_token(secret)
    listener = ros.listener("roscpp", "/talk", name="ear")
    ros.talker("roscpp", "/talk", name="voice")
    heard = [event["data"] for event in listener.wait_for_count(5, event="received")]
    order = {"after": 0.5, "note": "over REST"}
    for other in (viewer, investigator):
        assert other.post("/v1/recordings", order).status == 403
    made = operator.post("/v1/recordings", order)
    assert made.status == 201, made.body
    path = f"/v1/recordings/{made.json['id']}"
    eventually(lambda: viewer.get(path).status == 200, appliance.story)
    [row] = viewer.get("/v1/recordings").json["recordings"]
    assert row == viewer.get(path).json
    assert row["triggers"][0]["text"] == "the-operator: over REST"
    for other in (viewer, operator, admin):
        assert other.get(f"{path}/bag").status == 403
    bag = investigator.get(f"{path}/bag")
    assert hashlib.sha256(bag.body).hexdigest() == row["sha256"]
    (tmp_path / "bag").write_bytes(bag.body)
    mcap = investigator.get(f"{path}/bag?format=mcap")
    assert (mcap.status, mcap.body) == (200, b"".join(as_mcap(tmp_path / "bag")))
    around = f"{path}/messages?at=1970-01-01T00:00:00Z&topic=/talk"
    for other in (viewer, operator, admin):
        assert other.get(around).status == 403
        assert other.get(f"{path}/timeline").status == 200
    read = investigator.get(around).json
    assert (read["chosen"], read["messages"][0]["sender"]["node"]) == (0, "/voice")
    assert read["messages"][0].keys() == EXAMPLES["RecordedMessages"]["messages"][0].keys()
    assert viewer.get(f"{path}/timeline").json.keys() == EXAMPLES["Timeline"].keys()
    following = investigator.get(f"{path}/messages?at={read['messages'][-1]['place']}").json
    assert following["messages"][following["chosen"]] == read["messages"][-1]
    assert investigator.get(f"{path}/messages?at=nonsense").status == 422
    assert viewer.get(f"{path}/timeline?since=2100-01-01").status == 422
    assert appliance.recorded(event="recording read")[0]["detail"]["who"] == "the-investigator"
    taken = tmp_path / "taken.bag"
    done = {}
    for group, *verb in (
        ("record", "fetch", row["id"], "--output", str(taken)), ("record", "timeline", row["id"]),
        ("record", "messages", row["id"]), ("monitor", "replay", "censor", "--since", "1h"),
    ):  # fmt: skip
        certificate = appliance.state / "api" / "certificate.pem"
        place = ("--api", str(appliance.ready["api"]), "--api-ca", str(certificate))
        over_rest = rosrv(group, *verb, *place, ROSRV_TOKEN=secret)
        assert over_rest.returncode == 0, over_rest.stderr
        done[verb[0]] = over_rest.stdout
    assert "/talk" in done["timeline"]
    assert "data: " in done["messages"]
    assert taken.read_bytes() == bag.body
    for other in (viewer, operator, admin):
        assert other.post("/v1/recordings/memory", {}).status == 403
    memory = investigator.post("/v1/recordings/memory", {"since": row["ended"] + 1}).json
    assert (memory["began"] > row["ended"], memory["complete"]) == (True, True)
    lent = investigator.get(f"/v1/recordings/{memory['id']}/bag").body
    assert hashlib.sha256(lent).hexdigest() == memory["sha256"]
    assert memory["id"] not in {one["id"] for one in viewer.get("/v1/recordings").json["recordings"]}
    assert "of 2 recordings" in done["replay"]
    assert set(heard) <= set(said(ros, taken, "/talk"))
    fetches = appliance.recorded(event="recording fetched", count=5)
    assert {record["detail"]["who"] for record in fetches} == {"the-investigator"}
    assert operator.request("DELETE", path).status == 403
    assert admin.request("DELETE", path).status == 200
    assert viewer.get(path).status == 404
    assert investigator.get(f"{path}/bag").status == 404
    assert appliance.status()["recorder"] == {"running": True, "recordings": 0, "bytes": 0, "in_progress": 0}
