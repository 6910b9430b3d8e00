import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer
from typer.testing import CliRunner

from rosmop.batch.executor import ThisProcess
from rosmop.batch.journal import JournalError, ResumeJournal
from rosmop.tests.acting import message
from rosmop.tests.batch.works import counted_work
from rosmop.tool.command import app
from roswire.standard import standard_definitions

KIND = "std_msgs/Int32"
SPECIFICATION = """
limit() { event e(int n) /n std_msgs/Int32 '{data:n}' { if (n > 96) { ROS_WARN("high"); return; } } }
"""
ROSMOP = [sys.executable, "-P", "-c", "from rosmop.tool.command import app; app()"]


def make_bag(path: Path, seed: int, count: int = 400, step: int = 10**8, kind: str = KIND) -> Path:
    definitions = standard_definitions()
    with Writer(path) as writer:
        connection = writer.add_connection(
            "/n",
            kind.replace("/", "/msg/"),
            msgdef=definitions.full_text(kind),
            md5sum=definitions.md5sum(kind),
        )
        for number in range(count):
            writer.write(
                connection,
                (seed * 1000 + 1) * 10**9 + number * step,
                message(kind, data=(number * 7 + seed) % 100),
            )
    return path


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("limit.rv").write_text(SPECIFICATION)
    Path("bags/inner").mkdir(parents=True)
    for seed in range(6):
        make_bag(Path("bags", "inner" if seed == 5 else "", f"{seed}.bag"), seed)
    return tmp_path


def rosmop(command: str) -> tuple[int, str, str]:
    done = CliRunner().invoke(app, command.split())
    assert not isinstance(done.exception, Exception), done.exception
    return done.exit_code, done.stdout, done.stderr


@pytest.mark.nightly
@pytest.mark.parametrize("command", ["run limit.rv", "learn", "coverage limit.rv"])
def test_processes_give_the_same_report(command: str, folder: Path) -> None:
    Path("bags/broken.bag").write_text("nonsense")
    one = rosmop(f"{command} --bags bags --workers 1 --report one.ndjson")
    two = rosmop(f"{command} --bags bags --workers 2 --report two.ndjson")
    assert one == two
    assert one[0] == 3
    assert "broken.bag failed: cannot read the bag bags/broken.bag" in one[1] + one[2]
    assert Path("one.ndjson").read_bytes() == Path("two.ndjson").read_bytes()
    rows = [json.loads(line) for line in Path("one.ndjson").read_text().splitlines()]
    assert [row["bag"] for row in rows if "error" in row] == ["bags/broken.bag"]


@pytest.mark.nightly
def test_violations_are_listed_by_specification_recording_and_time(folder: Path) -> None:
    status, out, _err = rosmop("run limit.rv --bags bags --json")
    assert status == 0
    rows = [json.loads(line) for line in out.splitlines()]
    drops = [row for row in rows if row["kind"] == "drop"]
    assert len(drops) == 6 * 12
    counts = [row for row in rows if row["kind"] == "count" and row["effect"] == "drop"]
    assert {(row["bag"], row["monitor"], row["count"]) for row in counts} == {
        (f"bags/{name}", "limit", 12) for name in ("0.bag", "1.bag", "2.bag", "3.bag", "4.bag", "inner/5.bag")
    }
    for row in counts:
        own = [drop["time"] for drop in drops if drop["bag"] == row["bag"]]
        assert (row["first"], row["last"]) == (min(own), max(own))
    assert {row["messages"] for row in rows if row["kind"] == "recording"} == {400}


@pytest.mark.nightly
def test_sets_are_folders_and_patterns(folder: Path) -> None:
    assert "2400 messages of 6 recordings" in rosmop("run limit.rv --bags bags --bags bags/*.bag")[1]
    assert "800 messages of 2 recordings" in rosmop("run limit.rv --bags bags/[01].bag")[1]
    status, _out, err = rosmop("run limit.rv --bags none")
    assert (status, err) == (2, "rosmop: there are no recordings (.bag, .mcap) in none\n")
    assert rosmop("coverage limit.rv")[2].startswith("rosmop: give recordings: --bag FILE")


@pytest.mark.nightly
def test_errors_of_a_specification_are_reported_once(folder: Path) -> None:
    Path("limit.rv").write_text(SPECIFICATION.replace("data:n", "date:n"))
    status, _out, err = rosmop("run limit.rv --bags bags --workers 2")
    assert status == 1
    assert err.count("date") == 1


@pytest.mark.nightly
def test_mcap_files_are_recordings(folder: Path) -> None:
    expected = rosmop("run limit.rv --bag bags/0.bag --json")[1]
    definitions = standard_definitions()
    for compression in CompressionType:
        with Path("0.mcap").open("wb") as file:
            writer = McapWriter(file, chunk_size=1000, compression=compression)
            writer.start(profile="ros1")
            schema = writer.register_schema(KIND, "ros1msg", definitions.full_text(KIND).encode())
            channel = writer.register_channel("/n", "ros1", schema)
            for number in range(400):
                time = 10**9 + number * 10**8
                writer.add_message(channel, time, message(KIND, data=number * 7 % 100), time)
            writer.finish()  # type: ignore[no-untyped-call]  # mcap has no type for it
        assert rosmop("run limit.rv --bag 0.mcap --json")[1] == expected


def lines_of(path: Path) -> list[str]:
    return path.read_text().rpartition("\n")[0].splitlines() if path.exists() else []


@pytest.mark.nightly
@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGINT])
def test_an_interrupted_command_continues(end: signal.Signals, folder: Path) -> None:
    for seed in range(6):  # long ones, so that the command does not end before it is interrupted
        make_bag(Path("bags", f"{seed}-long.bag"), seed, 3000)
    words = "run limit.rv --bags bags --workers 2 --resume journal --report report.ndjson"
    command = [*ROSMOP, *words.split()]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        while len(lines_of(Path("journal"))) < 4:  # a head, and three results
            assert process.poll() is None
        os.kill(process.pid, end)
        _out, err = process.communicate()
    finished = lines_of(Path("journal"))
    assert 4 <= len(finished) < 13
    assert not Path("report.ndjson").exists()
    if end is signal.SIGINT:
        assert process.returncode == 130
        assert err == "rosmop: interrupted; journal has what is finished; the same command continues\n"
    subprocess.run(command, check=True, capture_output=True)
    assert lines_of(Path("journal"))[: len(finished)] == finished
    assert len(lines_of(Path("journal"))) == 13
    assert rosmop("run limit.rv --bags bags --report again.ndjson")[0] == 0
    assert Path("report.ndjson").read_bytes() == Path("again.ndjson").read_bytes()


def test_a_journal_is_bound_to_specifications_and_recordings(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COUNTED", "counted")
    monkeypatch.setattr("rosmop.batch.runner.ThisProcess", lambda _work: ThisProcess(counted_work))

    def executed(command: str) -> int:
        Path("counted").write_text("")
        rosmop(command)
        return len(Path("counted").read_text().splitlines())

    command = "run limit.rv --bags bags --workers 1 --resume journal"
    Path("bags/broken.bag").write_text("nonsense")
    assert [executed(command), executed(command)] == [7, 1]
    Path("bags/3.bag").unlink()
    make_bag(Path("bags/3.bag"), 33)
    assert executed(command) == 2
    Path("limit.rv").write_text(SPECIFICATION.replace("96", "97"))
    assert executed(command) == 7


def test_a_journal_that_was_cut_off_is_continued(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    with ResumeJournal(path) as journal:
        journal.add(b"one", b"1")
        journal.add(b"two", b"2" * 1000)
        with pytest.raises(JournalError, match="in use"):
            ResumeJournal(path)
    os.truncate(path, path.stat().st_size - 100)
    with ResumeJournal(path) as journal:
        assert (journal.result(b"one"), journal.result(b"two")) == (b"1", None)
        journal.add(b"three", b"3")
    with ResumeJournal(path) as journal:
        assert (journal.result(b"one"), journal.result(b"three")) == (b"1", b"3")
    shutil.copy(__file__, path)
    with pytest.raises(JournalError, match="not a journal"):
        ResumeJournal(path)


def test_the_cluster_is_checked_first(folder: Path) -> None:
    status, _out, err = rosmop("run limit.rv --bags bags --on somewhere")
    assert status == 2
    assert "give ray://HEAD:PORT" in err
