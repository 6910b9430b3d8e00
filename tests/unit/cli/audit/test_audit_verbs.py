"""Tests of `rosrv audit` as a user runs it: a command with output and an exit status."""

import contextlib
import json
import os
import pty
import re
import signal
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

import appliance
from appliance.api.unrecorded import CATEGORIES
from appliance.audit.log import AuditLog
from appliance.master.graph.registry import Kind
from appliance.policy.model import Category
from appliance.specifications.allocation import SERVICE, TOPIC
from tests.support.audit import decision, settle
from tests.support.command import rosrv as run
from tests.support.requirements import need_root

_EVIL = "/evil\x1b[31m\u202e\r\n[bold]x[/bold]"
_LIMIT_SECONDS = 60


@pytest.fixture
def state(tmp_path: Path) -> Path:
    """The state directory of a stopped appliance with a short log."""
    (tmp_path / "control").mkdir()
    log = AuditLog(tmp_path / "control" / "audit.db")
    for number in range(20):
        log.record(decision(log, number))
    log.record(
        decision(
            log, decision="deny", caller_id=_EVIL, host="10.66.0.1", resource="/arm", reason="no rule lets it"
        )
    )
    log.close()
    return tmp_path


def rosrv(*arguments: str, state: Path | None = None) -> subprocess.CompletedProcess[str]:
    """What `rosrv audit` says."""
    return run("audit", *arguments, **({} if state is None else {"ROSRV_STATE": str(state)}))


def lines(done: subprocess.CompletedProcess[str]) -> list[dict[str, object]]:
    """The objects of NDJSON output."""
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_a_time_that_ends_before_it_begins_is_refused(state: Path) -> None:
    """It would find nothing, and nobody would know why; `1h` is an hour ago."""
    done = rosrv("search", "--since", "1h", "--until", "2h", state=state)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "rosrv: --since 1h is later than --until 2h: nothing is between them\n"


def test_an_event_that_this_version_does_not_record_is_told(state: Path) -> None:
    """Beside what is found, for the log may be of another version: the nearest, in searches and exports."""
    for verb in ("search", "export"):
        done = run("audit", verb, "--event", "desicion", "--state", str(state))
        assert (done.returncode, done.stdout) == (0, "")
        assert done.stderr == "rosrv: this version records no event 'desicion'; did you mean decision?\n"
        for known in ("decision", "desi*"):
            assert "this version" not in run("audit", verb, "--event", known, "--state", str(state)).stderr


def test_a_category_that_this_version_does_not_record_is_told(state: Path) -> None:
    """As an event is; those that it records are known, wherever they are written."""
    done = run("audit", "search", "--category", "publsh", "--state", str(state))
    assert (done.returncode, done.stdout) == (0, "")
    assert done.stderr == "rosrv: this version records no category 'publsh'; did you mean publish?\n"
    sources = Path(appliance.__file__).parent.rglob("*.py")
    written = {word for path in sources for word in re.findall(r'category="(\w+)"', path.read_text())}
    assert written | {TOPIC, SERVICE, *Category, *Kind} == set(CATEGORIES)


def test_search_json(state: Path) -> None:
    """`search --json` prints the records that match as NDJSON, newest first."""
    found = lines(
        rosrv(
            "search",
            "--state",
            str(state),
            "--topic",
            "/cmd_*",
            "--allow",
            "--since",
            "1h",
            "--limit",
            "5",
            "--json",
        )
    )
    assert [one["resource"] for one in found] == ["/cmd_19", "/cmd_18", "/cmd_17", "/cmd_16", "/cmd_15"]
    assert found[0]["rule"] == {"section": "Publishers", "key": "/cmd_*", "file": "robot.ini", "line": 12}
    (denied,) = lines(
        rosrv(
            "search",
            "--deny",
            "--host",
            "10.66.*",
            "--caller",
            "/evil*",
            "--text",
            "NO RULE",
            "--json",
            state=state,
        )
    )
    assert denied["caller_id"] == _EVIL


def test_search_in_a_pipe_is_plain_lines(state: Path) -> None:
    """In a pipe each record is one line without escape codes, strangers' text escaped."""
    done = rosrv("search", "--deny", state=state)
    (line,) = done.stdout.splitlines()
    assert "DENY" in line
    assert "10.66.0.1 /evil\\x1b[31m\\u202e\\r\\n[bold]x[/bold] publish /arm: no rule lets it" in line
    assert "[Publishers] /cmd_* robot.ini:12" in line
    assert line.isprintable()


def test_repetitions_say_how_many(tmp_path: Path) -> None:
    """Repetitions of a denial say how many they were; a rule that the reason names is not named again."""
    (tmp_path / "control").mkdir()
    log = AuditLog(tmp_path / "control" / "audit.db")
    for _ in range(4):
        log.record(
            decision(log, decision="deny", reason="only ocu may, by [Publishers] /cmd_* (robot.ini:12)")
        )
    log.close()
    folded, first = rosrv("search", "--deny", state=tmp_path).stdout.splitlines()
    assert folded.endswith(": 3 more: only ocu may, by [Publishers] /cmd_* (robot.ini:12)")
    assert first.endswith(": only ocu may, by [Publishers] /cmd_* (robot.ini:12)")


def test_search_on_a_terminal_is_a_table(state: Path) -> None:
    """On a terminal there is a table, and nothing of a stranger's text is interpreted."""
    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "appliance.cli.main", "audit", "search", "--deny", "--state", str(state)]
    environment = os.environ | {"COLUMNS": "200", "TERM": "xterm"}
    with subprocess.Popen(command, stdout=theirs, stderr=theirs, env=environment) as process:
        os.close(theirs)
        shown = b""
        with contextlib.suppress(OSError):  # the terminal is gone when the command is
            while part := os.read(ours, 65_536):
                shown += part
        assert process.wait(_LIMIT_SECONDS) == 0
    os.close(ours)
    assert b"decision" in shown
    assert b"/evil\\x1b[31m\\u202e\\r\\n[bold]x[/bold]" in shown
    assert b"\x1b[31mx" not in shown
    assert "\u202e".encode() not in shown


def test_show(state: Path) -> None:
    """`show` prints one record in full with its neighbours, as text and as JSON."""
    (denied,) = lines(rosrv("search", "--deny", "--json", state=state))
    shown = json.loads(rosrv("show", str(denied["id"]), "--json", state=state).stdout)
    assert {name: value for name, value in shown.items() if name != "neighbours"} == denied
    text = rosrv("show", str(denied["sequence"]), state=state).stdout
    assert "reason" in text
    assert "no rule lets it" in text
    missing = rosrv("show", "f" * 20, state=state)
    assert missing.returncode == 1
    assert "no record with the id" in missing.stderr


def test_export(state: Path, tmp_path: Path) -> None:
    """`export` writes all records as NDJSON, oldest first, and never over a file that is there."""
    exported = lines(rosrv("export", state=state))
    assert [one["sequence"] for one in exported] == list(range(1, len(exported) + 1))
    target = tmp_path / "out.ndjson"
    assert rosrv("export", "--output", str(target), state=state).returncode == 0
    assert [json.loads(line) for line in target.read_text().splitlines()] == exported
    again = rosrv("export", "--output", str(target), state=state)
    assert again.returncode == 2
    assert str(target) in again.stderr


@pytest.mark.parametrize("what", [[], ["--deny"]], ids=["amid it", "when its only piece is written"])
def test_an_export_that_does_not_fit_leaves_no_file(state: Path, tmp_path: Path, what: list[str]) -> None:
    """A part of it would look like all there was, and stand in the way of the next."""
    need_root()
    disk = tmp_path / "disk"
    disk.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=4k", "rosrv-export-test", disk], check=True)
    try:
        (disk / "full").write_bytes(bytes(4096))
        done = rosrv("export", *what, "--output", str(disk / "out.ndjson"), state=state)
        assert (done.returncode != 0, "out.ndjson: No space left" in done.stderr) == (True, True), done.stderr
        assert [one.name for one in disk.iterdir()] == ["full"]
    finally:
        subprocess.run(["umount", "--lazy", disk], check=True)


def test_verify(state: Path) -> None:
    """`verify` exits with 0 and says so if the log is whole; with 1 and the record if it is not."""
    whole = rosrv("verify", state=state)
    assert whole.returncode == 0
    assert "complete and unchanged" in whole.stdout
    with closing(sqlite3.connect(state / "control" / "audit.db")) as attacker:
        attacker.execute("UPDATE record SET decision = 'allow' WHERE decision = 'deny'")
        attacker.execute("DELETE FROM record WHERE sequence = 5")
        attacker.commit()
    broken = rosrv("verify", state=state)
    assert broken.returncode == 1
    assert "MISSING: record 5:" in broken.stdout
    assert "CHANGED: record 22:" in broken.stdout
    found = json.loads(rosrv("verify", "--json", state=state).stdout)
    assert found["ok"] is False
    assert {(one["kind"], one["first"]) for one in found["findings"]} == {("missing", 5), ("changed", 22)}


@pytest.mark.parametrize("verb", [("search",), ("tail",), ("show", "1"), ("verify",), ("export",)])
def test_no_log(tmp_path: Path, verb: tuple[str, ...]) -> None:
    """Without a log every verb says what is missing and which option gives the place, and exits with 2."""
    for place in (tmp_path, tmp_path / "nowhere"):
        done = rosrv(*verb, "--state", str(place))
        assert done.returncode == 2
        assert str(place) in done.stderr
        assert "--state" in done.stderr
        assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ("--since", "yesterday"),
        ("--topic", "*" * 20),
        ("--cursor", "x"),
        ("--limit", "0"),
        ("--severity", "bad"),
    ],
)
def test_wrong_arguments(state: Path, arguments: tuple[str, ...]) -> None:
    """A wrong argument is an error in words with exit status 2."""
    done = rosrv("search", *arguments, state=state)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert done.stderr


def test_verify_with_a_wrong_key_file(state: Path, tmp_path: Path) -> None:
    """A key file that is no key is an error with its name, not a verdict on the log."""
    (tmp_path / "key.pem").write_text("rubbish")
    done = rosrv("verify", "--key", str(tmp_path / "key.pem"), state=state)
    assert done.returncode == 2
    assert "key.pem" in done.stderr


def test_tail_follows(state: Path) -> None:
    """`tail` shows the last records, then those that are recorded, and ends quietly when interrupted."""
    command = [sys.executable, "-m", "appliance.cli.main", "audit", "tail", "-n", "1", "--deny", "--json"]
    environment = os.environ | {"ROSRV_STATE": str(state)}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert json.loads(process.stdout.readline())["resource"] == "/arm"
        log = AuditLog(state / "control" / "audit.db")
        log.record(decision(log, decision="allow"))
        log.record(decision(log, decision="deny", resource="/new"))
        assert settle(log) is None
        assert json.loads(process.stdout.readline())["resource"] == "/new"
        log.close()
        process.send_signal(signal.SIGINT)
        assert process.wait(_LIMIT_SECONDS) == 0
        assert process.stderr.read() == ""


def test_reader_that_stops_early(state: Path) -> None:
    """A reader that has enough (head) is no error."""
    command = f"{sys.executable} -m appliance.cli.main audit export --state {state} | head -1"
    done = subprocess.run(
        ["/bin/bash", "-c", f"set -o pipefail; {command}"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.stderr == ""
    assert done.stdout.count("\n") == 1


def test_checkpoints_kept_elsewhere(tmp_path: Path) -> None:
    """What `checkpoints` writes is what `verify --checkpoints` takes; a log that was cut does not agree with it."""
    (tmp_path / "control").mkdir()
    key = Ed25519PrivateKey.generate()
    public = key.public_key().public_bytes_raw()
    log = AuditLog(
        tmp_path / "control" / "audit.db",
        checkpoint_every=10,
        signer=lambda number, text: log.signed(number, key.sign(text), public),
    )
    for number in range(40):
        log.record(decision(log, number))
        assert settle(log) is None
    log.close()
    written = rosrv("checkpoints", state=tmp_path)
    kept = tmp_path / "kept.ndjson"
    kept.write_text(written.stdout)
    numbers = [one["number"] for one in lines(written)]
    assert numbers == list(range(1, len(numbers) + 1))
    assert [one["number"] for one in lines(rosrv("checkpoints", "--after", "2", state=tmp_path))] == numbers[
        2:
    ]
    whole = rosrv("verify", "--checkpoints", str(kept), state=tmp_path)
    assert whole.returncode == 0
    assert f"{len(numbers)} checkpoints kept elsewhere agree" in whole.stdout
    with closing(sqlite3.connect(tmp_path / "control" / "audit.db")) as attacker:
        attacker.execute("DELETE FROM record WHERE sequence > 15")
        attacker.execute("DELETE FROM checkpoint WHERE sequence > 15")
        attacker.commit()
    cut = rosrv("verify", "--checkpoints", str(kept), state=tmp_path)
    assert cut.returncode == 1
    assert "TRUNCATED: records 16 to" in cut.stdout
    none = rosrv("verify", "--checkpoints", str(tmp_path / "nothing"), state=tmp_path)
    assert none.returncode == 2
    assert "nothing: No such file" in none.stderr


def test_an_export_verifies_without_the_log(tmp_path: Path) -> None:
    """What was exported is proven with the public key alone; without a key, or tampered with, it is not."""
    (tmp_path / "control").mkdir()
    key = Ed25519PrivateKey.generate()
    public = key.public_key().public_bytes_raw()
    logs: list[AuditLog] = []
    log = AuditLog(
        tmp_path / "control" / "audit.db",
        checkpoint_every=10,
        signer=lambda number, text: logs[0].signed(number, key.sign(text), public) if logs else None,
    )
    logs.append(log)
    for number in range(60):
        log.record(decision(log, number))
        settle(log)
    log.close()
    pinned, file = tmp_path / "control" / "audit.pub", tmp_path / "evidence.ndjson"
    rosrv("export", "--topic", "/cmd_7", "--output", str(file), state=tmp_path)
    (tmp_path / "control" / "audit.db").unlink()
    proven = rosrv("verify", "--export", str(file), "--key", str(pinned))
    assert proven.returncode == 0
    assert "3 are proven by a signed checkpoint" in proven.stdout
    result = json.loads(rosrv("verify", "--export", str(file), "--key", str(pinned), "--json").stdout)
    assert (result["ok"], result["records"], result["proven"]) == (True, 3, 3)
    without = rosrv("verify", "--export", str(file))
    assert (without.returncode, without.stderr.count("--key")) == (2, 1)
    file.write_text(file.read_text().replace('"decision":"allow"', '"decision":"deny"', 1))
    changed = rosrv("verify", "--export", str(file), "--key", str(pinned))
    assert (changed.returncode, "CHANGED" in changed.stdout) == (1, True)
