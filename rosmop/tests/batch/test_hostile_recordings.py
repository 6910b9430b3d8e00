import json
import math
import os
import resource
import signal
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path
from struct import pack

import pytest
from rosbags.rosbag1 import Writer

from rosmop.batch import jobs
from rosmop.batch.executor import ThisProcess
from rosmop.batch.jobs import Failure, Survey, SurveyJob, to_bytes, unpack, work
from rosmop.batch.journal import JournalError, ResumeJournal
from rosmop.batch.recording_list import recordings_of
from rosmop.batch.runner import JobRunner
from rosmop.recordings.recording import RecordingError, open_recording
from rosmop.recordings.replay import OutputBag
from rosmop.tests.acting import message
from rosmop.tests.batch.test_many_recordings import KIND, ROSMOP, SPECIFICATION, make_bag, rosmop
from roswire.definitions import Definitions
from roswire.message_text import PRIMITIVES
from roswire.standard import standard_definitions

RUN = "run limit.rv --bags bags"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("limit.rv").write_text(SPECIFICATION)
    Path("bags").mkdir()
    for seed in range(2):
        make_bag(Path("bags", f"{seed}.bag"), seed)
    return tmp_path


def rows_of(path: str) -> list[dict[str, object]]:
    return [json.loads(line) for line in Path(path).read_text(encoding="ascii").splitlines()]


@pytest.mark.nightly
@pytest.mark.parametrize("command", ["run limit.rv", "learn", "coverage limit.rv"])
def test_any_name_is_reported(command: str, folder: Path) -> None:
    for seed, name in enumerate((b"a\n\x1b[2Jb.bag", b"c\xff.bag", "d\u202e\u00e9.bag".encode())):
        make_bag(Path("bags", os.fsdecode(name)), seed + 2)
        Path("bags", os.fsdecode(b"broken-" + name)).write_bytes(b"nonsense")
    one = rosmop(f"{command} --bags bags --workers 1 --resume journal --report one")
    assert one == rosmop(f"{command} --bags bags --workers 2 --report two")
    assert Path("one").read_bytes() == Path("two").read_bytes()
    assert one[0] == 3
    assert all(letter.isprintable() or letter == "\n" for letter in one[1] + one[2])
    assert "broken-a\\n\\x1b[2Jb.bag failed" in one[1] + one[2]
    assert "broken-c\\xff.bag failed" in (one[1] + one[2]).replace("\\\\", "\\")
    failed = [str(row["bag"]) for row in rows_of("one") if "error" in row]
    assert failed == [
        "bags/broken-a\n\x1b[2Jb.bag", "bags/broken-c\\xff.bag", "bags/broken-d\u202e\u00e9.bag"
    ]  # fmt: skip
    "".join(failed).encode()  # no surrogates


@pytest.mark.nightly
def test_bytes_outside_utf8_in_specifications(folder: Path) -> None:
    definition = Path("msg/own/msg/Level.msg")
    definition.parent.mkdir(parents=True)
    definition.write_bytes(b"int32 data  # \xb0C\n")
    Path(os.fsdecode(b"limit-\xff.rv")).write_text(SPECIFICATION)
    status, out, _err = rosmop(os.fsdecode(b"run limit-\xff.rv --bags bags --workers 2"))
    assert status == 0
    assert "800 messages of 2 recordings" in out
    Path("limit.rv").write_bytes(
        b"// \xb0C\n" + SPECIFICATION.replace('"high"', '"\udcb0"').encode("utf-8", "surrogateescape")
    )
    status, _out, err = rosmop(f"{RUN} --workers 2")
    assert status == 1
    assert err.startswith("limit.rv:")


@pytest.mark.nightly
def test_other_kinds_of_files_are_rows(folder: Path) -> None:
    os.mkfifo("bags/pipe.bag")
    Path("bags/device.bag").symlink_to("/dev/zero")
    Path("bags/circle.bag").symlink_to("circle.bag")
    Path("bags/gone.bag").symlink_to("none")
    Path("bags/folder.bag").mkdir()
    assert rosmop(f"{RUN} --report report --workers 2")[0] == 3
    errors = {row["bag"]: str(row["error"]) for row in rows_of("report") if "error" in row}
    for name, reason in (
        ("pipe", "a named pipe"), ("device", "a device"), ("circle", "does not exist"), ("gone", "does not exist")
    ):  # fmt: skip
        assert reason in errors.pop(f"bags/{name}.bag"), name
    assert not errors


@pytest.mark.nightly
def test_circles_of_folders_are_not_followed(folder: Path) -> None:
    for name in ("x", "y", "z"):
        Path("bags", name).symlink_to(".")
    begin = time.perf_counter()
    assert len(recordings_of([], ["bags"])) == 2
    assert len(recordings_of([], ["bags/**/*.bag", str(folder / "bags" / "**" / "?.bag")])) == 2
    assert time.perf_counter() - begin < 5
    with pytest.raises(RecordingError, match=r"'\*\*' can only be an entire path component"):
        recordings_of([], ["bags**/x.bag"])


def test_a_folder_that_cannot_be_read_is_an_error(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for _level in range(20):  # longer than a path may be
        deep = Path("x" * 250)
        (Path("bags") if not _level else Path()).joinpath(deep).mkdir()
        monkeypatch.chdir(Path("bags", deep) if not _level else deep)
    monkeypatch.chdir(folder)
    with pytest.raises(RecordingError, match=r"cannot read the folder bags/x.*: File name too long"):
        recordings_of([], ["bags"])


def test_a_recording_that_changes_fails(folder: Path) -> None:
    (first, second) = recordings_of([], ["bags"])
    with Path("bags/1.bag").open("ab") as file:
        file.write(b"\0")
    Path("bags/0.bag").touch()
    for recording in (first, second):
        result = unpack(work(to_bytes(SurveyJob(recording, ["*"]))))
        assert isinstance(result, Failure)
        assert result.text == f"{recording.uri} changed after the command began"


# The limit may end a callback of the garbage collector, where Python only reports it; the next signal ends the work.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_recording_cannot_take_for_ever(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("limit.rv").write_text(
        "m() { event t() every 1ms { } event e(int n) /n std_msgs/Int32 '{data:n}' { } }"
    )
    make_bag(Path("bags/slow.bag"), 0, 400, step=10**12)
    make_bag(Path("bags/2.bag"), 0, 2)
    monkeypatch.setattr(jobs, "_SECONDS", 0.5)
    monkeypatch.setattr(jobs, "_SECONDS_PER_MB", 0)
    before = signal.getsignal(signal.SIGPROF)
    assert rosmop("run limit.rv --bag bags/slow.bag --bag bags/2.bag --workers 1 --report report")[0] == 3
    assert [row.get("error") for row in rows_of("report") if row["kind"] == "recording"] == [
        "it takes more than 0 s of processor time", None
    ]  # fmt: skip
    assert signal.getsignal(signal.SIGPROF) is before
    assert signal.getitimer(signal.ITIMER_PROF) == (0, 0)


def test_a_worker_that_answers_something_else_fails_alone(folder: Path) -> None:
    jobs_ = [SurveyJob(recording, ["*"]) for recording in recordings_of([], ["bags"])]
    for answer in (b"", b"\x80\x04K\x01.", b"\xc0", b"\x81\xa4type\xa5Other"):

        def answering(_job: bytes, answer: bytes = answer) -> bytes:
            return answer

        results = list(JobRunner(ThisProcess(answering), None).in_order(jobs_))
        assert all(
            isinstance(result, Failure) and "answered something else" in result.text for result in results
        )
        assert len(results) == 2


def test_a_damaged_journal_gives_no_other_result(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    with ResumeJournal(path) as journal:
        journal.add(b"one", b"1")
        journal.add(b"two", b"22")
    whole = path.read_bytes()
    variants = [whole[:length] for length in range(len(whole))]
    variants += [
        whole[:place] + bytes([byte]) + whole[place + 1 :]
        for place in range(len(whole))
        for byte in (whole[place] ^ 1, 10, 32, 255)
    ]
    found = set()
    for variant in variants:
        path.write_bytes(variant)
        try:
            with ResumeJournal(path) as journal:
                assert journal.result(b"one") in (b"1", None)
                assert journal.result(b"two") in (b"22", None)
                journal.add(b"three", b"3")
            with ResumeJournal(path) as journal:
                assert journal.result(b"three") == b"3"
                found.add((journal.result(b"one"), journal.result(b"two")))
        except JournalError as error:
            assert "is not a journal" in str(error)
            assert path.read_bytes() == variant
    assert len(found) == 4


def test_only_a_journal_is_written(tmp_path: Path) -> None:
    for text in ("one line", '{"job": 1}', "two\nlines"):
        (tmp_path / "file").write_text(text)
        with pytest.raises(JournalError, match="is not a journal"):
            ResumeJournal(tmp_path / "file")
        assert (tmp_path / "file").read_text() == text
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/null")):
        with pytest.raises(JournalError, match="not a regular file"):
            ResumeJournal(path)
    with pytest.raises(JournalError, match="Is a directory"):
        ResumeJournal(tmp_path)


@pytest.mark.nightly
@pytest.mark.parametrize("option", ["--resume", "--report"])
def test_a_full_disk_is_reported(option: str, folder: Path) -> None:
    words = [*ROSMOP, *RUN.split(), "--workers", "2", option, "file"]

    def fill() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))

    done = subprocess.run(words, preexec_fn=fill, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "File too large" in done.stderr
    assert "Traceback" not in done.stderr
    assert Path("file").exists() is (option == "--resume")
    subprocess.run(words, check=True, capture_output=True)
    assert Path("file").stat().st_size > 1000


@pytest.mark.parametrize("field", ["topic", "type", "md5sum", "message_definition", "callerid", "latching"])
def test_bytes_outside_utf8_in_a_connection_leave_its_recording(field: str, tmp_path: Path) -> None:
    path = make_bag(tmp_path / "any.bag", 1, 5)
    other = {"topic": "/odd", "type": "odd/Odd", "md5sum": "odd", "message_definition": "int32 x # odd",
             "callerid": "/odd", "latching": "odd"}  # fmt: skip
    with Writer(tmp_path / "odd.bag") as writer, closing(open_recording(path)) as reader:
        (known,) = reader.connections
        row = writer.add_connection("/n", known.msgtype, msgdef=known.msgdef.data, md5sum=known.digest)
        odd = writer.add_connection(
            other["topic"], "odd/msg/Odd", msgdef=other["message_definition"], md5sum=other["md5sum"],
            callerid=other["callerid"], latching=other["latching"],  # type: ignore[arg-type]
        )  # fmt: skip
        for _connection, time_ns, data in reader.in_order():
            writer.write(row, time_ns, data)
            writer.write(odd, time_ns, data)
    before = (tmp_path / "odd.bag").read_bytes()
    value = f"{field}={other[field]}".encode()
    after = before.replace(value, value[:-3] + b"o\xff\xb0")
    assert after != before
    (tmp_path / "odd.bag").write_bytes(after)
    (tmp_path / "limit.rv").write_text(SPECIFICATION)
    specification = tmp_path / "limit.rv"
    status, out, err = rosmop(f"run {specification} --bag {tmp_path}/odd.bag --output {tmp_path}/out.bag")
    assert (status, out.splitlines()[-1].partition(":")[0], err) == (0, "10 messages", "")
    (recording,) = recordings_of([], [f"{tmp_path}/odd.bag"])
    survey = unpack(work(to_bytes(SurveyJob(recording, ["*"]))))
    assert isinstance(survey, Survey) and survey.topics["/n"] == KIND


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("room", [0, 4000, 1_200_000, -1])  # -1: all but the last byte
def test_an_output_without_room_is_reported(room: int, tmp_path: Path) -> None:
    with closing(open_recording(make_bag(tmp_path / "one.bag", 1, 1))) as reader:
        ((connection, time_ns, _data),) = reader.in_order()

    def write(name: str) -> int:
        with OutputBag(tmp_path / name, standard_definitions()) as output:
            for number in range(4):
                output.relay(connection, time_ns + number, bytes(600_000))
        return (tmp_path / name).stat().st_size

    size, limits = write("whole.bag"), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room % size, limits[1]))
    try:
        with pytest.raises(RecordingError, match=r"cannot write the bag .*/cut\.bag: .*File too large"):
            write("cut.bag")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_a_report_without_a_folder_is_refused_first(folder: Path) -> None:
    status, out, err = rosmop(f"{RUN} --report none/report")
    assert (status, out) == (2, "")
    assert err == "rosmop: cannot write none/report: its folder is missing or not writable\n"


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def command_line(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except (FileNotFoundError, ProcessLookupError):
        return b""


@pytest.mark.nightly
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL])
def test_workers_end_while_they_start(end: signal.Signals, folder: Path) -> None:
    assert rosmop(f"{RUN} --report expected")[0] == 0
    words = [*ROSMOP, *RUN.split(), "--workers", "2", "--report", "report"]
    with subprocess.Popen(
        words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        # The first one is multiprocessing's own.
        while len(found := children(process.pid)) < 2 or b"spawn_main" not in command_line(found[1]):
            assert process.poll() is None
        status = Path(f"/proc/{found[1]}/status").read_text()
        blocked = int(status.partition("\nSigBlk:")[2].split()[0], 16)
        assert blocked & 1 << signal.SIGINT - 1, "a worker that starts must not see Ctrl-C"
        if end is signal.SIGINT:
            os.killpg(process.pid, end)
        else:
            os.kill(found[1], end)
        _out, err = process.communicate(timeout=120)
    if end is signal.SIGINT:
        assert err == "rosmop: interrupted; add --resume FILE to keep what is finished\n"
        assert process.returncode == 130
        assert not [pid for pid in found if command_line(pid)]
    else:
        assert (process.returncode, err) == (0, "")
        assert Path("report").read_bytes() == Path("expected").read_bytes()


def extremes_of(code: str, size: int) -> list[float]:
    """Return the smallest, the largest, zero, and what else is no ordinary number."""
    if code in "fd":
        return [-(most := 1e38 if code == "f" else sys.float_info.max), most, 0.0, math.nan, math.inf]
    if code.islower():
        return [-1 << 8 * size - 1, (1 << 8 * size - 1) - 1, 0, 0, 0]
    return [0, 1 if code == "?" else (1 << 8 * size) - 1, 0, 0, 0]


@pytest.mark.parametrize(
    ("shape", "head", "count"), [("", b"", 1), ("[1]", b"", 1), ("[]", pack("<I", 7), 7)]
)
def test_each_value_of_each_primitive_can_be_learnt(
    shape: str, head: bytes, count: int, tmp_path: Path
) -> None:
    primitives = sorted(PRIMITIVES.keys() - {"time", "duration"})
    for seed in range(2):
        with Writer(tmp_path / f"{seed}.bag") as writer:
            for part, names in enumerate((primitives[::2], primitives[1::2])):  # one topic has limits
                known = Definitions.from_files({"test/All.msg": "\n".join(f"{n}{shape} {n}_" for n in names)})
                text, digest = known.full_text("test/All"), known.md5sum("test/All")
                for place in range(6):
                    connection = writer.add_connection(
                        f"/part{part}_{place}", f"test/msg/All{part}", msgdef=text, md5sum=digest
                    )
                    for second in range(20):
                        data = b""
                        for code, size in map(PRIMITIVES.__getitem__, names):
                            value = extremes_of(code, size)[second % 5 if place == 5 else place]
                            data += head + pack(f"<{count}{code}", *[value] * count)
                        writer.write(connection, (seed * 1000 + second + 1) * 10**9, data)
    status, out, err = rosmop(f"learn --workers 1 --bags {tmp_path}")
    assert (status, out.count("uint64_ is") + out.count("uint64_ has") > 5) == (0, True), err


@pytest.mark.nightly
def test_a_topic_cannot_add_to_the_learnt_text(folder: Path) -> None:
    name = "/n\n} evil() { event e() /n std_msgs/Int32 '{}' { DROP; } }\x1b[2J"
    definitions = standard_definitions()
    for seed in range(2, 4):
        with Writer(Path("bags", f"{seed}.bag")) as writer:
            connection = writer.add_connection(
                name,
                "std_msgs/msg/Int32",
                msgdef=definitions.full_text(KIND),
                md5sum=definitions.md5sum(KIND),
            )
            writer.write(connection, 10**12, message(KIND, data=1))
    status, out, _err = rosmop("learn --bags bags")
    assert status == 0
    assert [line[:20] for line in out.splitlines() if "evil" in line] == ["// Not looked at: /n"]
    assert "\x1b" not in out
    Path("learnt.rv").write_text(out)
    assert rosmop("check learnt.rv")[0] == 0
