"""`rosrv monitor check` and `run`: what a safety engineer sees, and what a script reads."""

import json
from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag1 import Reader, Writer
from typer.testing import CliRunner, Result

from appliance.cli.main import app
from rosmop.tests.acting import message
from roswire.standard import standard_definitions

GOOD = """counter() {
    int n;
    event e(int x) /t std_msgs/Int32 '{data:x}' { n++; if (x == 2) return; x = x * 10; ROS_INFO("%d", n); }
    event tick() every 1s { }
    ere: (e | tick)* e tick @match { ROS_WARN("tick"); }
}
"""
BAD = "a() {\n  event e(int x) /t std_msgs/Int32 '{dat:x}' {\n    y = 1;\n  }\n}\n"


def invoke(*arguments: object) -> Result:
    """Run the command."""
    return CliRunner().invoke(app, ["monitor", *map(str, arguments)])


def write(folder: Path, name: str, text: str) -> Path:
    """Write a file, with its folders."""
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def make_bag(path: Path, messages: list[tuple[str, str, float, bytes]], md5sum: str | None = None) -> Path:
    """A recording of (topic, type, seconds, bytes)."""
    definitions = standard_definitions()
    with Writer(path) as writer:
        connections = {}
        for topic, kind, seconds, data in messages:
            if topic not in connections:
                package, _, name = kind.partition("/")
                connections[topic] = writer.add_connection(
                    topic,
                    f"{package}/msg/{name}",
                    msgdef=definitions.full_text(kind),
                    md5sum=md5sum or definitions.md5sum(kind),
                    callerid="/talker",
                )
            writer.write(connections[topic], int(seconds * 10**9), data)
    return path


def number(value: int) -> bytes:
    """A `std_msgs/Int32`."""
    return message("std_msgs/Int32", data=value)


def records(result: Result) -> list[dict[str, Any]]:
    """The objects of an output, one per line."""
    return [json.loads(line) for line in result.stdout.splitlines()]


# check


def test_a_right_file(tmp_path: Path) -> None:
    """A right specification is said to be right; exit status 0."""
    result = invoke("check", write(tmp_path, "a.rv", GOOD))
    said, proof, enforcement = result.stdout.splitlines()
    assert (result.exit_code, said) == (0, "1 specification right")
    assert enforcement.startswith("counter: ere: ")
    assert proof == "counter: ere: proved: its automaton is what is written (3 cases followed)"


def test_errors_have_their_place(tmp_path: Path) -> None:
    """`file:line:col: error: text` for each, all of them; exit status 1."""
    path = write(tmp_path, "a.rv", BAD)
    result = invoke("check", path)
    assert result.exit_code == 1
    assert result.stdout.splitlines() == [
        f"{path}:2:38: error: std_msgs/Int32 has no field `dat`; did you mean `data`?",
        f"{path}:3:5: error: there is no variable `y`",
        "2 errors: refused",
    ]


def test_findings_for_scripts(tmp_path: Path) -> None:
    """`--json`: one object per finding with file, line, column, severity and text."""
    path = write(tmp_path, "a.rv", BAD)
    result = invoke("check", path, "--json")
    assert result.exit_code == 1
    assert records(result)[1] == {
        "file": str(path), "line": 3, "column": 5, "severity": "error", "text": "there is no variable `y`",
    }  # fmt: skip


def test_warnings_alone_are_no_failure(tmp_path: Path) -> None:
    """Exit status 0 with warnings only."""
    text = GOOD.replace("(e | tick)* e tick", "e*")
    result = invoke("check", write(tmp_path, "a.rv", text), "--json")
    assert result.exit_code == 0
    assert {record["severity"] for record in records(result)} == {"warning"}


PROVED = """s() { int n = 0; double d = 0;
    event e(float level) /battery sensor_msgs/BatteryState '{voltage:level}' when (level < 11.5) { n++; }
    event f(double x) /odom nav_msgs/Odometry '{pose.pose.position.x:x}' { d = sin(x); }
}"""


def test_what_is_proved_is_said_of_every_event(tmp_path: Path) -> None:
    """With `--prove`; what is not proved has its reason, and is no error."""
    file = write(tmp_path, "a.rv", PROVED)
    result = invoke("check", file, "--prove")
    assert (result.exit_code, result.stdout.splitlines()) == (
        0,
        [
            "1 specification right",
            "s.e on /battery: equal",
            "s.f on /odom: no module: messages of this topic are judged in Python",
        ],
    )
    assert records(invoke("check", file, "--prove", "--json"))[0] == {
        "topic": "/battery", "event": "s.e", "proof": "equal", "differs": False,
    }  # fmt: skip


def test_proving_without_the_prover(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Exit status 2, with what to install, before anything is judged."""
    monkeypatch.setattr("rosmop.tool.check_command.find_spec", lambda name: None)
    result = invoke("check", write(tmp_path, "a.rv", PROVED), "--prove")
    assert (result.exit_code, result.stdout) == (2, "")
    assert "--prove needs the package z3-solver: pip install 'rosrv-appliance[prove]'" in result.stderr


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    """A missing file is a mistake of the command line: exit status 2."""
    result = invoke("check", tmp_path / "none.rv")
    assert result.exit_code == 2
    assert "cannot read" in result.stderr


def test_a_file_that_is_not_utf8(tmp_path: Path) -> None:
    """Bytes that are no text are refused with their place."""
    path = tmp_path / "a.rv"
    path.write_bytes(b"a() {\n \xff }")
    result = invoke("check", path)
    assert (result.exit_code, result.stdout.splitlines()[0]) == (
        1, f"{path}:2:2: error: these bytes are no UTF-8; save the file as UTF-8",
    )  # fmt: skip


def test_everything_wrong_with_several_files_is_told_at_once(tmp_path: Path) -> None:
    """Errors of syntax, bytes that are no text, and errors of meaning, each in its file, in one run."""
    one = write(tmp_path, "a.rv", "a() { int z\n event e() /t std_msgs/Empty '{}' { } }")
    two = write(tmp_path, "b.rv", "b() { int 3; }")
    three = write(
        tmp_path, "c.rv", "c() { event e() /t std_msgs/Empty '{}' { z = 1; std::vector<int> v; v.sice(); } }"
    )
    (tmp_path / "d.rv").write_bytes(b"d() {\n \xff }")
    result = invoke("check", one, two, three, tmp_path / "d.rv")
    assert result.exit_code == 1
    assert [line.split(" error: ")[0] for line in result.stdout.splitlines()] == [
        f"{one}:1:12:", f"{two}:1:11:", f"{three}:1:69:", f"{tmp_path / 'd.rv'}:2:2:", "4 errors: refused",
    ]  # fmt: skip


OWN = "own() { event e(int x) /t own_msgs/Own '{level:x}' { } }"


@pytest.mark.parametrize("name", ["own_msgs/Own.msg", "own_msgs/msg/Own.msg"])
def test_definitions_from_a_folder(tmp_path: Path, name: str) -> None:
    """`--msg DIR` finds definitions in both layouts; without it the type is unknown."""
    spec = write(tmp_path / "specs", "own.rv", OWN)
    write(tmp_path / "defs", name, "int32 level\n")
    assert invoke("check", spec).exit_code == 1
    assert invoke("check", spec, "--msg", tmp_path / "defs").exit_code == 0


def test_definitions_beside_the_file(tmp_path: Path) -> None:
    """`msg/` beside the specification is always looked into."""
    write(tmp_path, "msg/own_msgs/Own.msg", "int32 level\n")
    assert invoke("check", write(tmp_path, "own.rv", OWN)).exit_code == 0


def test_services_from_a_folder(tmp_path: Path) -> None:
    """Service definitions are found, too."""
    write(tmp_path, "defs/own_msgs/srv/Ask.srv", "int32 q\n---\nint32 a\n")
    text = "s() { event e(int q) service /ask own_msgs/Ask request '{q:q}' { } }"
    assert invoke("check", write(tmp_path, "s.rv", text), "--msg", tmp_path / "defs").exit_code == 0


def test_a_wrong_definition_has_its_place(tmp_path: Path) -> None:
    """A definition that cannot be read is an error in its own file and line."""
    spec = write(tmp_path, "own.rv", OWN)
    path = write(tmp_path, "msg/own_msgs/Own.msg", "int32 level\nwhat is this\n")
    result = invoke("check", spec)
    assert result.exit_code == 1
    assert result.stdout.startswith(f"{path}:2:1: error: ")


def test_automata_as_pictures(tmp_path: Path) -> None:
    """`--dot` and `--svg` draw every property that is a finite automaton; no other program is needed."""
    spec = write(tmp_path, "a.rv", GOOD)
    dot, svg = tmp_path / "a.dot", tmp_path / "a.svg"
    assert invoke("check", spec, "--dot", dot, "--svg", svg).exit_code == 0
    assert dot.read_text().startswith('digraph "ere"')
    drawn = svg.read_text()
    assert drawn.startswith("<svg ")
    assert "tick" in drawn


def test_what_has_no_automaton_is_right_all_the_same(tmp_path: Path) -> None:
    """The exit status is about the specification; that there is nothing to draw is said, and no file written."""
    raw = write(tmp_path, "raw.rv", "a() { event e() /t std_msgs/Empty '{}' { } }")
    for option in ("--svg", "--dot"):
        result = invoke("check", raw, option, tmp_path / "a.picture")
        assert result.exit_code == 0
        assert "nothing to draw" in result.stderr
        assert not (tmp_path / "a.picture").exists()
    assert invoke("check", write(tmp_path, "bad.rv", BAD), "--dot", tmp_path / "a.picture").exit_code == 1


# run


def test_a_recording_goes_through_the_monitors(tmp_path: Path) -> None:
    """One record per message in the order of the bag, ticks and deadlines between them by the bag's clock."""
    bag = make_bag(tmp_path / "in.bag", [
        ("/t", "std_msgs/Int32", 100.25, number(1)),
        ("/t", "std_msgs/Int32", 100.5, number(2)),
        ("/other", "std_msgs/Int32", 100.75, number(3)),
        ("/t", "std_msgs/Int32", 101.5, number(4)),
    ])  # fmt: skip
    result = invoke("run", write(tmp_path, "a.rv", GOOD), "--bag", bag, "--json")
    assert result.exit_code == 0, result.stderr
    empty: dict[str, object] = {"verdicts": [], "published": [], "log": [], "faults": []}
    events = [
        {"event": "e", "index": 0, "time": "1970-01-01T00:01:40.250000+00:00"},
        {"event": "tick", "time": "1970-01-01T00:01:41.250000+00:00"},
    ]
    why = {"events": events, "fewest": True}
    assert records(result) == [
        {"index": 0, "topic": "/t", "time": 100.25, "outcome": "changed", "events": ["counter.e"], **empty,
         "log": [{"level": "INFO", "text": "1", "monitor": "counter"}]},
        {"index": 1, "topic": "/t", "time": 100.5, "outcome": "dropped", "events": ["counter.e"], **empty},
        {"index": 2, "topic": "/other", "time": 100.75, "outcome": "passed", "events": [], **empty},
        {"timer": "counter.tick", "time": 101.25, "outcome": "passed", "events": ["counter.tick"], **empty,
         "verdicts": [{"monitor": "counter", "property": 0, "logic": "ere", "category": "match", "why": why}],
         "log": [{"level": "WARN", "text": "tick", "monitor": "counter"}]},
        {"index": 3, "topic": "/t", "time": 101.5, "outcome": "changed", "events": ["counter.e"], **empty,
         "log": [{"level": "INFO", "text": "3", "monitor": "counter"}]},
    ]  # fmt: skip


def test_what_subscribers_would_have_received(tmp_path: Path) -> None:
    """`--output` writes changed and passed messages and what was published, with types and definitions."""
    text = """a() { std_msgs::String s; event e(int x) /t std_msgs/Int32 '{data:x}' {
        if (x == 2) return; x = x * 10; s.data = "n"; PUBLISH(/out, std_msgs/String, s); } }"""
    bag = make_bag(tmp_path / "in.bag", [
        ("/t", "std_msgs/Int32", 1, number(1)), ("/t", "std_msgs/Int32", 2, number(2)),
        ("/u", "std_msgs/Int32", 3, number(3)),
    ])  # fmt: skip
    out = tmp_path / "out.bag"
    result = invoke("run", write(tmp_path, "a.rv", text), "--bag", bag, "--json", "--output", out)
    assert records(result)[0]["published"] == [{"topic": "/out", "type": "std_msgs/String"}]
    with Reader(out) as reader:
        found = [
            (connection.topic, connection.digest, time, data) for connection, time, data in reader.messages()
        ]
        types = {connection.topic: connection.msgtype for connection in reader.connections}
    digests = {kind: standard_definitions().md5sum(kind) for kind in ("std_msgs/Int32", "std_msgs/String")}
    assert found == [
        ("/t", digests["std_msgs/Int32"], 10**9, number(10)),
        ("/out", digests["std_msgs/String"], 10**9, message("std_msgs/String", data="n")),
        ("/u", digests["std_msgs/Int32"], 3 * 10**9, number(3)),
    ]
    assert types["/out"] == "std_msgs/msg/String"
    assert invoke("run", tmp_path / "a.rv", "--bag", bag, "--output", out).exit_code == 2


def test_faults_are_told_with_place_and_values(tmp_path: Path) -> None:
    """A fault has file, line, column, text and values; the exit status is 0 all the same."""
    path = write(
        tmp_path, "a.rv", "a() {\n event e(int n) /t std_msgs/Int32 '{data:n}' {\n  n = 1 / n;\n }\n}"
    )
    bag = make_bag(tmp_path / "in.bag", [("/t", "std_msgs/Int32", 1, number(0))])
    result = invoke("run", path, "--bag", bag, "--json")
    assert result.exit_code == 0
    [found] = records(result)
    assert (found["outcome"], found["faults"]) == (
        "dropped", [{"file": str(path), "line": 3, "column": 7, "text": "division by zero", "values": {"n": 0}}],
    )  # fmt: skip


def test_a_recording_for_people(tmp_path: Path) -> None:
    """Without `--json`, only what is worth telling, and a sum at the end."""
    bag = make_bag(
        tmp_path / "in.bag", [("/t", "std_msgs/Int32", 1, number(1)), ("/u", "std_msgs/Int32", 2, number(1))]
    )
    result = invoke("run", write(tmp_path, "a.rv", GOOD), "--bag", bag)
    assert result.stdout.splitlines()[-1].startswith("2 messages: 1 passed, 1 changed, 0 dropped")
    assert "1.000 #0 /t: changed" in result.stdout
    assert "/u" not in result.stdout


def test_specifications_run_in_the_order_of_their_names(tmp_path: Path) -> None:
    """File-name order, whatever the order on the command line."""
    one = write(tmp_path, "1.rv", "one() { event e() /t std_msgs/Int32 '{}' { } }")
    two = write(tmp_path, "2.rv", "two() { event e() /t std_msgs/Int32 '{}' { } }")
    bag = make_bag(tmp_path / "in.bag", [("/t", "std_msgs/Int32", 1, number(1))])
    assert records(invoke("run", two, one, "--bag", bag, "--json"))[0]["events"] == ["one.e", "two.e"]


def test_messages_with_equal_times_come_as_they_stand_in_the_file(tmp_path: Path) -> None:
    """Whichever connection they are of; a message that was recorded later with an earlier time comes by its time."""
    topics = ["/b", "/a", "/a", "/c", "/b", "/a"]
    messages = [(topic, "std_msgs/Int32", 2, number(value)) for value, topic in enumerate(topics)]
    bag = make_bag(tmp_path / "in.bag", [*messages, ("/c", "std_msgs/Int32", 1, number(9))])
    events = " ".join(
        f"event {name}(int x) /{name} std_msgs/Int32 '{{data:x}}' {{ printf(\"%d\", x); }}" for name in "abc"
    )
    found = records(invoke("run", write(tmp_path, "a.rv", f"s() {{ {events} }}"), "--bag", bag, "--json"))
    assert [record["topic"] for record in found] == ["/c", *topics]
    assert [record["log"][0]["text"] for record in found] == ["9", "0", "1", "2", "3", "4", "5"]


def test_the_types_of_the_recording_are_known(tmp_path: Path) -> None:
    """A type that only the recorded publisher defines is taken from its connection header."""
    path = tmp_path / "in.bag"
    with Writer(path) as writer:
        connection = writer.add_connection(
            "/t", "own_msgs/msg/Own", msgdef="int32 level\n", md5sum="00000000000000000000000000000000"
        )
        writer.write(connection, 1, b"\5\0\0\0")
    spec = write(tmp_path, "own.rv", OWN.replace("{ } }", '{ ROS_INFO("%d", x); } }'))
    result = invoke("run", spec, "--bag", path, "--json")
    assert result.exit_code == 0
    assert "another definition" in result.stderr


def test_a_publisher_with_another_definition_is_refused(tmp_path: Path) -> None:
    """md5sums are compared; the messages of that topic are dropped and the reason is told."""
    bag = make_bag(tmp_path / "in.bag", [("/t", "std_msgs/Int32", 1, number(1))], md5sum="0" * 32)
    result = invoke("run", write(tmp_path, "a.rv", GOOD), "--bag", bag, "--json")
    assert records(result)[0]["outcome"] == "dropped"
    assert "the publisher of /t has another definition of std_msgs/Int32" in result.stderr


def test_a_wrong_specification_is_not_run(tmp_path: Path) -> None:
    """Its errors are told; exit status 1."""
    bag = make_bag(tmp_path / "in.bag", [("/t", "std_msgs/Int32", 1, number(1))])
    result = invoke("run", write(tmp_path, "a.rv", BAD), "--bag", bag, "--json")
    assert (result.exit_code, result.stdout) == (1, "")
    assert "has no field `dat`" in result.stderr


def test_what_is_no_bag(tmp_path: Path) -> None:
    """A file that is no recording, or none at all, is a mistake of the command line."""
    spec = write(tmp_path, "a.rv", GOOD)
    for bag, mended in ((spec, True), (tmp_path / "none.bag", False)):
        done = invoke("run", spec, "--bag", bag)
        assert done.exit_code == 2
        assert ("rosbag reindex" in done.stderr) == mended


def test_an_empty_recording(tmp_path: Path) -> None:
    """No message, no record, no error."""
    bag = make_bag(tmp_path / "in.bag", [])
    result = invoke("run", write(tmp_path, "a.rv", GOOD), "--bag", bag, "--json")
    assert (result.exit_code, result.stdout) == (0, "")


def test_what_init_prints_comes_with_the_first_message(tmp_path: Path) -> None:
    """Nothing is lost: the output of `init` is in the first record."""
    text = "a() { init() { ROS_INFO(\"begin\"); } event e() /t std_msgs/Int32 '{}' { } }"
    bag = make_bag(tmp_path / "in.bag", [("/u", "std_msgs/Int32", 1, number(1))])
    assert [
        line["text"]
        for line in records(invoke("run", write(tmp_path, "a.rv", text), "--bag", bag, "--json"))[0]["log"]
    ] == ["begin"]


def test_run_says_why_a_monitor_that_could_not_begin_drops(tmp_path: Path) -> None:
    """After a fault in `init` every message is dropped, and each line for people has the reason."""
    text = "m() { int z = 0; init() { z = 1 / z; } event e(int x) /t std_msgs/Int32 '{data:x}' { } }"
    one = message("std_msgs/Int32", data=1)
    bag = make_bag(tmp_path / "in.bag", [("/t", "std_msgs/Int32", time, one) for time in (1.0, 2.0)])
    said = invoke("run", write(tmp_path, "m.rv", text), "--bag", bag).stdout
    assert said.count("dropped (m could not begin: its first values or `init` faulted)") == 2


def test_parameters_are_explained() -> None:
    """What binds each, and what a slice begins with."""
    shipped = Path(__file__).parents[4] / "monitors" / "goals.rv"
    result = CliRunner().invoke(app, ["monitor", "check", str(shipped)])
    assert result.exit_code == 0
    assert result.output.splitlines()[1:3] == [
        "goals: parameter id (std::string), bound by goal, cancel, result",
        "goals: a slice for each id, begun by goal; at most 100000 at a time",
    ]
