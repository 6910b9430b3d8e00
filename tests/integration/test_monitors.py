import itertools
import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from tests.support.appliance import OPEN_POLICY, Appliance
from tests.support.nodes import Client, RosSession, need_ros, numbers, without_gap
from tests.support.waiting import eventually

CLIENTS: list[Client] = ["rospy", "roscpp"]
WORDS = """
begin words() {
    int heard = 0;
    std_msgs::String report;
    event said(std::string text) /chatter std_msgs/String '{data:text}' {
        heard = heard + 1;
        if (text.find("bad") != std::string::npos) { ROS_WARN("a bad word"); return; }
        text = "checked " + text;
        if (heard % 3 == 0) { report.data = "three words"; PUBLISH(/alarm, std_msgs/String, report); }
    }
}
"""


@pytest.fixture(scope="module")
def common_appliance() -> Iterator[Appliance]:
    need_ros()
    policy, options = OPEN_POLICY + "getRVState = *\n", ("--api", "127.0.0.1:0")
    with Appliance(policy=policy, monitors={"words": WORDS}, options=options) as appliance:
        yield appliance


@pytest.fixture
def appliance(common_appliance: Appliance) -> Iterator[Appliance]:
    common_appliance.ignore_earlier_records()
    yield common_appliance
    common_appliance.rosrv("monitor", "remove", "words", check=False)
    common_appliance.rosrv("monitor", "reload", "--prune")
    common_appliance.rosrv("monitor", "enable", "words")


def monitor(appliance: Appliance, name: str) -> dict[str, object]:
    lines = appliance.rosrv("monitor", "list", "--json").stdout.splitlines()
    rows: list[dict[str, object]] = [json.loads(line) for line in lines]
    return next(row for row in rows if row["name"] == name)


@pytest.mark.real
def test_changed_and_dropped_messages_are_recorded(appliance: Appliance, ros: RosSession) -> None:
    alarms = [ros.listener(client, "/alarm") for client in CLIENTS]
    listeners = [ros.listener(client, "/chatter") for client in CLIENTS]
    for client in CLIENTS:
        ros.talker(client, "/chatter", "--text", "good", name=f"voice_{client}")
    for listener, client in itertools.product(listeners, CLIENTS):
        heard = listener.wait_for_count(3, event="received", publisher=f"/voice_{client}")
        assert all(event["data"].startswith("checked good") for event in heard)
    for alarm in alarms:
        alarmed = alarm.wait_for(event="received")
        assert (alarmed["data"], alarmed["publisher"]) == ("three words", "/rosrv")
    rude = [ros.talker(client, "/chatter", "--text", "bad", name=f"rude_{client}") for client in CLIENTS]
    for talker in rude:
        talker.wait_for_count(5, event="sent")
    for listener in listeners:
        listener.wait_for_count(len(listener.seen(event="received")) + 20, event="received")
        said = listener.seen(event="received")
        assert {event["publisher"] for event in said} == {f"/voice_{client}" for client in CLIENTS}
        assert not [event for event in said if "bad" in event["data"]]
    assert appliance.recorded(event="message dropped", resource="/chatter")
    told = appliance.recorded(event="message changed", resource="/chatter")
    changed = next(one for one in told if "before" in one["detail"])  # the others are sums for one second
    assert bytes.fromhex(changed["detail"]["before"])[4:].startswith(b"good")
    assert changed["detail"]["before_fields"]["data"].startswith("good")
    assert bytes.fromhex(changed["detail"]["after"])[4:].startswith(b"checked good")
    assert "a bad word" in {one["reason"] for one in appliance.recorded(event="monitor log")}


@pytest.mark.real
def test_a_monitor_is_disabled_enabled_replaced_and_removed_while_nodes_talk(
    appliance: Appliance, ros: RosSession, tmp_path: Path
) -> None:
    listener = ros.listener("roscpp", "/chatter")
    ros.talker("roscpp", "/chatter", name="voice")
    listener.wait_for(lambda event: event.get("data", "").startswith("checked hello"))
    appliance.rosrv("monitor", "disable", "words")
    listener.wait_for(lambda event: event.get("data", "").startswith("hello"))
    appliance.rosrv("-enable", "words")
    spec = tmp_path / "words.rv"
    spec.write_text(WORDS.replace("checked ", "seen "))
    appliance.rosrv("monitor", "load", str(spec))
    listener.wait_for(lambda event: event.get("data", "").startswith("seen hello"))
    assert appliance.status()["monitors"]["differs_from_folder"] is True
    appliance.rosrv("monitor", "remove", "words")
    assert not appliance.rosrv("monitor", "list", "--json").stdout
    removed = listener.mark()
    listener.wait_for(lambda event: event.get("data", "").startswith("hello"), since=removed)
    plain = listener.mark()
    listener.wait_for_count(3, event="received", since=plain)
    assert without_gap(numbers(listener.seen(event="received")))
    assert all(event["data"].startswith("hello") for event in listener.events[plain : plain + 3])
    appliance.rosrv("monitor", "reload")
    assert monitor(appliance, "words")["enabled"] is True
    for event in ("monitor disabled", "monitor enabled"):
        assert appliance.recorded(event=event, resource="words")[0]["detail"]["who"] == "operator"
    loaded = [record["detail"] for record in appliance.recorded(event="specifications loaded", count=3)]
    assert ["words.rv"] in [detail["removed"] for detail in loaded]
    assert ["words.rv"] in [detail["changed"] for detail in loaded]


def test_a_monitor_in_shadow_mode_records_only_until_it_is_promoted(
    appliance: Appliance, ros: RosSession
) -> None:
    assert appliance.rosrv("monitor", "enable", "words", "--shadow").stdout == "shadow mode: words\n"
    listener = ros.listener("roscpp", "/chatter")
    ros.talker("roscpp", "/chatter", name="voice")
    rude = ros.talker("rospy", "/chatter", "--text", "bad", name="rude")
    rude.wait_for_count(5, event="sent")
    heard = listener.wait_for_count(5, event="received", publisher="/rude")
    assert all(event["data"].startswith("bad") for event in heard)

    def observed() -> bool:
        records = appliance.audit("--event", "shadow observed", resource="/chatter")
        return {"drop", "change", "log"} <= {
            record["detail"]["shadow"] and record["detail"]["would"] for record in records
        }

    eventually(observed, "records of a drop, a change and a line in shadow mode")
    row = monitor(appliance, "words")
    assert row["would_drop"]
    assert row["would_change"]
    assert (row["shadow"], row["enabled"], row["drops"], row["changes"], row["missed"]) == (
        True,
        False,
        0,
        0,
        0,
    )
    status = appliance.status()["monitors"]
    assert (status["enabled"], status["shadow"]) == (0, ["words"])
    assert "1 in shadow mode" in appliance.rosrv("status").stdout
    assert "rosrv monitor enforce" in appliance.rosrv("monitor", "enable", "words", check=False).stderr
    assert appliance.rosrv("monitor", "enforce", "words").stdout == "enabled: words\n"
    listener.wait_for(lambda event: event.get("data", "").startswith("checked hello"))
    said = [event["data"] for event in listener.seen(event="received") if event["publisher"] == "/voice"]
    changed = [text.startswith("checked ") for text in said]
    assert changed == sorted(changed)
    assert without_gap([int(text.split()[-1]) for text in said])
    assert {one["detail"]["who"] for one in appliance.recorded("--event", "monitor in shadow mode")} == {
        "operator"
    }


@pytest.mark.real
def test_an_invalid_specification_is_rejected_without_effect(
    appliance: Appliance, ros: RosSession, tmp_path: Path
) -> None:
    spec = tmp_path / "words.rv"
    spec.write_text(WORDS.replace("heard + 1", "herd + 1"))
    done = appliance.rosrv("monitor", "load", str(spec), check=False)
    assert done.returncode == 1
    assert "words.rv:6:" in done.stderr
    assert "herd" in done.stderr
    assert monitor(appliance, "words")["enabled"] is True
    assert appliance.rosrv("monitor", "disable", "nobody", check=False).returncode == 1
    listener = ros.listener("rospy", "/chatter")
    ros.talker("rospy", "/chatter")
    listener.wait_for(lambda event: event.get("data", "").startswith("checked hello"))


def test_a_new_relay_reports_that_it_begins_in_the_initial_state(
    appliance: Appliance, ros: RosSession
) -> None:
    held = WORDS.strip().replace("begin words()", "hold gate()").replace("/chatter", "/held")
    path = Path(appliance.directory) / "gate.rv"
    path.write_text(held)
    appliance.rosrv("monitor", "load", str(path))
    appliance.rosrv("monitor", "disable", "words")
    listener, plain = ros.listener("roscpp", "/held"), ros.listener("roscpp", "/chatter")
    ros.talker("roscpp", "/held")
    ros.talker("roscpp", "/chatter")
    listener.wait_for(lambda event: event.get("data", "").startswith("checked hello"))
    appliance.kill("relay")
    before = len(plain.seen(event="received"))
    alarm = appliance.recorded(event="monitors restarted")[0]
    plain.wait_for_count(before + 5, event="received")
    assert plain.seen(event="received")[-1]["data"].startswith("hello")
    assert monitor(appliance, "gate")["held"] is True
    assert (alarm["severity"], alarm["detail"]["held"]) == ("alarm", ["gate"])
    before = len(listener.seen(event="received"))
    appliance.rosrv("monitor", "resume", "gate")
    listener.wait_for_count(before + 3, event="received")


@pytest.mark.real
def test_loaded_and_switched_monitors_survive_a_restart(appliance: Appliance, tmp_path: Path) -> None:
    spec = tmp_path / "more.rv"
    spec.write_text(WORDS.replace("words()", "more()").replace("/chatter", "/other"))
    appliance.rosrv("monitor", "load", str(spec))
    appliance.rosrv("-disable", "words")
    appliance.kill("control")
    appliance.stop()
    appliance.start()
    assert monitor(appliance, "words")["enabled"] is False
    assert monitor(appliance, "more")["enabled"] is True
    with RosSession(appliance.master_uri, tmp_path) as ros:
        ask = "import rosgraph; m = rosgraph.Master('/tool'); h = m.handle; "
        said = ros.run(
            "/usr/bin/python3",
            "-c",
            ask + "print(h.getMonitors('/tool')); print(h.monitorControl('/tool', 'enable', ['words']));"
            "print(h.getRVState('/tool')[:2]); print(h.monitorControl('/tool', 'enable', ['nobody'])[0])",
        ).stdout.splitlines()
    assert said[0] == "[1, 'Monitors', [['more', True], ['words', False]]]"
    assert said[1].endswith("['words']]")
    assert said[2] == "[1, 'RV State']"
    assert said[3] == "-1"


def test_an_incompatible_stored_revision_can_be_discarded(appliance: Appliance, tmp_path: Path) -> None:
    spec = tmp_path / "more.rv"
    spec.write_text(WORDS.replace("words()", "more()").replace("/chatter", "/other"))
    appliance.rosrv("monitor", "load", str(spec))
    assert json.loads(appliance.rosrv("-rvstate", "--json").stdout)[2] == [
        ["more", "/other", 0, 0], ["words", "/chatter", 0, 0]
    ]  # fmt: skip
    appliance.stop()
    with closing(sqlite3.connect(appliance.state / "control" / "state.db")) as database, database:
        database.execute("UPDATE monitor_revision SET sources = replace(sources, 'event said', 'evnt said')")
    appliance.start()
    left_out = appliance.status()["monitors"]["left_out"]
    assert left_out["more.rv"].startswith("more.rv:5:")
    appliance.stop()
    said = appliance.rosrv("monitor", "reset").stdout
    assert "is discarded" in said
    appliance.start()
    assert monitor(appliance, "words")["enabled"] is True
    assert len(appliance.rosrv("monitor", "list", "--json").stdout.splitlines()) == 1


def test_a_file_with_an_error_does_not_keep_the_robot_without_a_master(tmp_path: Path) -> None:
    broken = "broken() { event e() /held std_msgs/String '{}' { if (lost) { return; } } }"
    with Appliance(monitors={"words": WORDS, "broken": broken}, options=("--api", "off")) as running:
        for _ in range(2):
            why = eventually(lambda: monitor(running, "broken")["why_held"], running.story)
            assert "unknown variable `lost`" in str(why)
            assert monitor(running, "words")["held"] is False
            assert "rosrv monitor load broken.rv" in running.rosrv("status", check=False).stdout
            assert running.recorded(event="monitor not built")[-1]["resource"] == "broken"
            assert running.stop() == 0
            running.start()
        fixed = tmp_path / "broken.rv"
        fixed.write_text(broken.replace("lost", "false"))
        running.rosrv("monitor", "load", str(fixed))
        assert monitor(running, "broken")["held"] is False


def test_a_first_start_leaves_out_a_file_that_it_cannot_parse() -> None:
    with Appliance(
        monitors={"words": WORDS, "broken": "broken() { event }"}, options=("--api", "off")
    ) as running:
        assert "broken.rv:1:" in running.status()["monitors"]["left_out"]["broken.rv"]
        assert running.rosrv("status", check=False).returncode == 1
        assert monitor(running, "words")["held"] is False


GATE = """
gate() {
    bool open = false;
    event wish(bool data) service /mode std_srvs/SetBool request '{data:data}' {
        if (data && open) { ROS_WARN("it is open already"); return; }
        open = data;
    }
    event answer(std::string text) service /mode std_srvs/SetBool response '{message:text}' {
        text = "checked";
    }
}
"""


@pytest.mark.real
def test_requests_are_refused_and_responses_changed(
    appliance: Appliance, ros: RosSession, tmp_path: Path
) -> None:
    for to in CLIENTS:
        spec = tmp_path / f"gate_{to}.rv"
        spec.write_text(GATE.replace("gate()", f"gate_{to}()").replace("/mode", f"/mode_{to}"))
        appliance.rosrv("monitor", "load", str(spec))
        server = ros.service_server(to, f"/mode_{to}")
        for by in CLIENTS:
            client = ros.service_client(by, f"/mode_{to}")
            client.send("true")
            assert client.wait_for(event="answered")["message"] == "checked"
            client.send("true")
            client.wait_for(event="failed")
            client.send("false")
            client.wait_for_count(2, event="answered")
        called = [event["data"] for event in server.wait_for_count(4, event="called")]
        assert called == [True, False] * 2
        refused = appliance.recorded(event="message dropped", resource=f"/mode_{to}")[0]
        assert refused["detail"]["monitor"] == f"gate_{to}"


def test_settings_of_the_monitors_publisher(tmp_path: Path) -> None:
    need_ros()
    divide = 'if (text.find("9") != std::string::npos) { int zero = 0; zero = 1 / zero; }\n        text = '
    monitors = {"words": WORDS.replace("text = ", divide, 1)}
    settings = "publish_as: /guard\nhide_publisher: true\non_fault: pass\n"
    with (
        Appliance(settings=settings, monitors=monitors, options=("--api", "off")) as appliance,
        RosSession(appliance.master_uri, tmp_path) as ros,
    ):
        alarm = ros.listener("rospy", "/alarm")
        listener = ros.listener("rospy", "/chatter")
        ros.talker("rospy", "/chatter")
        assert alarm.wait_for(event="received")["publisher"] == "/guard"
        passed = listener.wait_for(lambda event: event.get("data", "").endswith("9"))
        assert passed["data"].startswith("hello")
        listener.wait_for_count(3, event="received", since=listener.mark())
        heard = [event["data"] for event in listener.seen(event="received")]
        assert all(text.startswith("hello" if "9" in text else "checked") for text in heard)
        assert appliance.recorded(event="monitor fault")[-1]["detail"]["values"] == {"zero": 0}
        assert "/guard" not in ros.run("rostopic", "info", "/alarm").stdout
