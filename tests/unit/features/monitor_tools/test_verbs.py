from pathlib import Path

import pytest
from rosbags.rosbag1 import Reader, Writer

from rosmop.tests.acting import message
from roswire.standard import standard_definitions
from tests.support.bags import make_bag, number
from tests.support.command import rosrv


def test_proving_needs_the_prover(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.rv").write_text("a() { event e() /t std_msgs/Empty '{}' { } }")
    monkeypatch.setattr("rosmop.tool.check_command.find_spec", lambda name: None)
    result = rosrv("monitor", "check", str(tmp_path / "a.rv"), "--prove")
    assert (result.returncode, result.stdout) == (2, "")
    assert "--prove needs the package z3-solver: pip install z3-solver" in result.stderr


@pytest.mark.parametrize(
    "verb", ["set speed vMax=1 vMax=2", "load FILE --set speed.vMax=1 --set speed.vMax=2"]
)
def test_a_value_that_is_given_twice_is_refused(tmp_path: Path, verb: str) -> None:
    file = tmp_path / "speed.rv"
    file.write_text("speed() { event e() /t std_msgs/Empty '{}' { } }")
    words = [word.replace("FILE", str(file)) for word in verb.split()]
    result = rosrv("monitor", *words, "--state", str(tmp_path))
    assert result.returncode == 2
    assert "vMax has two values: give one" in result.stderr


def test_output_has_what_subscribers_would_receive(tmp_path: Path) -> None:
    (tmp_path / "a.rv").write_text("""a() { std_msgs::String s; event e(int x) /t std_msgs/Int32 '{data:x}' {
        if (x == 2) return; x = x * 10; s.data = "n"; PUBLISH(/out, std_msgs/String, s); } }""")
    bag = make_bag(tmp_path / "in.bag", [
        ("/t", "std_msgs/Int32", 1, number(1)), ("/t", "std_msgs/Int32", 2, number(2)),
        ("/u", "std_msgs/Int32", 3, number(3)),
    ])  # fmt: skip
    out = tmp_path / "out.bag"
    command = ("monitor", "run", str(tmp_path / "a.rv"), "--bag", str(bag), "--json", "--output", str(out))
    first = rosrv(*command).stdout.splitlines()[0]
    assert '"published": [{"topic": "/out", "type": "std_msgs/String"}]' in first
    with Reader(out) as reader:
        found = [
            (connection.topic, connection.digest, time, data) for connection, time, data in reader.messages()
        ]
        types = {connection.topic: connection.msgtype for connection in reader.connections}
    digests = {kind: standard_definitions().md5sum(kind) for kind in ("std_msgs/Int32", "std_msgs/String")}
    assert found == [
        ("/t", digests["std_msgs/Int32"], 10**9, number(10)),
        ("/out", digests["std_msgs/String"], 10**9 + 1, message("std_msgs/String", data="n")),
        ("/u", digests["std_msgs/Int32"], 3 * 10**9, number(3)),
    ]
    assert types["/out"] == "std_msgs/msg/String"
    assert rosrv(*command).returncode == 2


def test_output_is_in_the_order_of_the_robot_for_every_tool(tmp_path: Path) -> None:
    (tmp_path / "a.rv").write_text("""a() { std_msgs::Int32 n;
        init() { n.data = 100; PUBLISH(/out, std_msgs/Int32, n); }
        event e(int x) /t std_msgs/Int32 '{data:x}' { n.data = x; PUBLISH(/out, std_msgs/Int32, n); } }""")
    (tmp_path / "b.rv").write_text(
        "b() { event e(int x) /out std_msgs/Int32 '{data:x}' { if (x > 9) x = 9; } }"
    )
    sent = [("/u", 2), ("/t", 1), ("/t", 3)]  # all at the same time
    bag = make_bag(tmp_path / "in.bag", [(topic, "std_msgs/Int32", 1, number(x)) for topic, x in sent])
    files, out = [str(tmp_path / "a.rv"), str(tmp_path / "b.rv")], tmp_path / "out.bag"
    rosrv("monitor", "run", *files, "--bag", str(bag), "--output", str(out))
    with Reader(out) as reader:
        found = sorted((time, one.id, one.topic, data[0]) for one, time, data in reader.messages())
    assert [(topic, x) for _time, _id, topic, x in found] == [
        ("/u", 2), ("/out", 9), ("/t", 1), ("/out", 1), ("/t", 3), ("/out", 3)
    ]  # fmt: skip


def test_the_types_of_the_recording_are_known(tmp_path: Path) -> None:
    path, file = tmp_path / "in.bag", tmp_path / "own.rv"
    with Writer(path) as writer:
        connection = writer.add_connection(
            "/t", "own_msgs/msg/Own", msgdef="int32 level\n", md5sum="00000000000000000000000000000000"
        )
        writer.write(connection, 1, b"\5\0\0\0")
    file.write_text("""own() { event e(int x) /t own_msgs/Own '{level:x}' { ROS_INFO("%d", x); } }""")
    result = rosrv("monitor", "run", str(file), "--bag", str(path), "--json")
    assert result.returncode == 0
    assert "different definition" in result.stderr
