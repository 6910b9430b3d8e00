"""`rosrv monitor replay`: what would have been dropped and changed of recordings, where, and how often."""

import json
import socket
import threading
from pathlib import Path

import pytest

from appliance.channel.admin import AdminAnswer, encode
from appliance.channel.answers.monitor_answers import Monitors, MonitorState
from tests.support.answers import example
from tests.unit.cli.monitor.test_verbs import GOOD, invoke, make_bag, number, records, write

OTHER = """last() { event e(int x) /t std_msgs/Int32 '{data:x}' when (n > 1) { ROS_WARN("again"); return; } }
alone() { event e() /u std_msgs/Int32 '{}' { return; } }
"""


def recorded(folder: Path, name: str, *values: int, topic: str = "/t") -> Path:
    """A recording with a number each second, and one on another topic."""
    rows = [(topic, "std_msgs/Int32", 10.0 + at, number(value)) for at, value in enumerate(values)]
    return make_bag(folder / name, [*rows, ("/u", "std_msgs/Int32", 99.0, number(0))])


def test_every_drop_and_change_has_its_recording_time_and_number(tmp_path: Path) -> None:
    """The same number as `run` gives; each recording begins in the initial state; a table of how often."""
    path = write(tmp_path, "a.rv", GOOD)
    bags = [recorded(tmp_path, "one.bag", 1, 2, 0, 3), recorded(tmp_path, "two.bag", 2)]
    result = invoke("replay", path, "--bag", bags[0], "--bag", bags[1])
    assert result.exit_code == 0
    lines = result.output.splitlines()
    assert f"{bags[0]} 10.000 #0 /t: counter would change it: counter.e" in lines
    assert f"{bags[0]} 11.000 #1 /t: counter would drop it: counter.e" in lines
    assert f"{bags[1]} 10.000 #0 /t: counter would drop it: counter.e" in lines
    assert not [line for line in lines if "12.000 #2" in line]  # 0 * 10 is no change
    row = next(line.split() for line in lines if line.startswith("counter") and "/t" in line)
    assert row == ["counter", "/t", "2", "2", "0", "0", "0"]
    assert lines[-1] == "7 messages of 2 recordings"


def test_places_are_bounded_and_a_script_gets_all(tmp_path: Path) -> None:
    """Ticks, verdicts and warnings, too; a script has one object each."""
    path = write(tmp_path, "a.rv", GOOD)
    bag = recorded(tmp_path, "one.bag", *[2] * 30, 1)
    shown = invoke("replay", path, "--bag", bag, "--most", "3").output
    assert shown.count("would drop it") == 3
    assert " 30 " in shown
    found = records(invoke("replay", path, "--bag", bag, "--json"))
    drops = [one for one in found if one["kind"] == "drop"]
    assert [one["index"] for one in drops] == list(range(30))
    assert drops[7]["time"] == 17.0
    assert {one["kind"] for one in found} == {"drop", "change", "verdict", "warning"}
    assert {one["timer"] for one in found if one["kind"] == "verdict"} == {"counter.tick"}


def test_only_the_topics_that_are_named(tmp_path: Path) -> None:
    """Others are as if they were not recorded, what is wrong with them included."""
    path = write(tmp_path, "a.rv", GOOD)
    bag = recorded(tmp_path, "one.bag", 2, 2)
    result = invoke("replay", path, "--bag", bag, "--topic", "/u*")
    assert result.output.splitlines()[0].startswith("nothing: ")
    assert result.output.splitlines()[-1] == "1 message of 1 recording"
    other = make_bag(tmp_path / "other.bag", [("/t", "std_msgs/String", 1.0, b"\0\0\0\0")])
    refused = invoke("replay", path, "--bag", other)
    assert (refused.exit_code, "/t carries std_msgs/String" in refused.output) == (2, True)
    assert invoke("replay", path, "--bag", other, "--topic", "/u").exit_code == 0


def test_what_is_wrong_is_said(tmp_path: Path) -> None:
    """A specification with errors, a bag that is none, a file that is not there."""
    bag = recorded(tmp_path, "one.bag", 1)
    wrong = invoke("replay", write(tmp_path, "wrong.rv", "a() {"), "--bag", bag)
    assert (wrong.exit_code, "wrong.rv:1:" in wrong.output) == (1, True)
    assert invoke("replay", tmp_path / "none.rv", "--bag", bag).exit_code == 2
    assert invoke("replay", write(tmp_path, "a.rv", GOOD), "--bag", tmp_path / "none.bag").exit_code == 2
    nobody = invoke("replay", "counter", "--bag", bag, "--state", tmp_path)
    assert nobody.exit_code == 2


def test_how_close_conditions_came(tmp_path: Path) -> None:
    """Of each comparison of numbers, on both sides of it, over all recordings; not of loops and of what `when` says."""
    text = """near() {
        bool high(int n) { return n > 7; }
        event e(int x) /t std_msgs/Int32 '{data:x}' when (x >= 3) {
            for (int i = 0; i < 3; i++) { }
            if (high(x) || x < 5) { ROS_WARN("x"); }
        }
    }
    """
    path = write(tmp_path, "near.rv", text)
    bags = [recorded(tmp_path, "one.bag", 1, 9, 5), recorded(tmp_path, "two.bag", 6, 20)]
    plain = invoke("replay", path, "--bag", bags[0], "--bag", bags[1])
    shown = invoke("replay", path, "--bag", bags[0], "--bag", bags[1], "--margins")
    assert shown.output.startswith(plain.output.rsplit("\n", 2)[0])
    assert (
        f"{path}:2:35: bool high(int n) {{ return n > 7; }}: true by 2 at the closest, 9 against 7 ("
        in shown.output
    )
    found = [
        (one["line"], one["holds"], one["distance"], one["threshold_at"], Path(one["bag"]).name, one["index"])
        for one in records(invoke("replay", path, "--bag", bags[0], "--bag", bags[1], "--margins", "--json"))
        if one["kind"] == "margin"
    ]
    assert sorted(found) == [
        (2, False, 1.0, 6.0, "two.bag", 0),
        (2, True, 2.0, 9.0, "one.bag", 1),
        (5, False, 0.0, 5.0, "one.bag", 2),
    ]


def test_margins_of_what_is_no_number_are_left_out(tmp_path: Path) -> None:
    """Texts and times are compared, too; what the monitor does is the same with margins."""
    text = """s() { ros::Time t; std::string a; event e(int x) /t std_msgs/Int32 '{data:x}' {
        if (t < ros::Time::now() && a < "b") { return; } } }"""
    path = write(tmp_path, "s.rv", text)
    bag = recorded(tmp_path, "one.bag", 1)
    found = records(invoke("replay", path, "--bag", bag, "--margins", "--json"))
    assert [one["kind"] for one in found] == ["drop"]


@pytest.fixture
def state(tmp_path: Path) -> Path:
    """A state directory at which an appliance with monitors answers once."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    listener.bind(str(tmp_path / "admin.sock"))
    listener.listen()
    rows = [example(MonitorState, name=name, file="a.rv") for name in ("counter", "last", "alone")]
    body = example(Monitors, monitors=rows, files={"a.rv": GOOD + OTHER}, definitions={})

    def serve() -> None:
        with listener, listener.accept()[0] as peer, peer.makefile("rb") as lines:
            assert json.loads(lines.readline())["texts"]
            peer.sendall(encode(AdminAnswer(True, body)) + b"\n")

    threading.Thread(target=serve, daemon=True).start()
    return tmp_path


def test_a_monitor_of_the_running_appliance_with_those_it_shares_variables_with(
    tmp_path: Path, state: Path
) -> None:
    """And no other of its file."""
    bag = recorded(tmp_path, "one.bag", 1, 3, 3)
    result = invoke("replay", "last", "--bag", bag, "--state", state)
    assert result.exit_code == 0, result.output
    assert "11.000 #1 /t: last would drop it: again" in result.output
    assert "counter would change it" in result.output
    assert "alone" not in result.output


def test_a_monitor_that_is_not_there_has_those_that_are(tmp_path: Path, state: Path) -> None:
    """Exit status 2."""
    result = invoke("replay", "safeZone", "--bag", recorded(tmp_path, "one.bag", 1), "--state", state)
    assert result.exit_code == 2
    assert "there are: counter, last, alone" in result.output
