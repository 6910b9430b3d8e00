"""Exports and verifications that need real files. The transcripts `audit.txt` and `signed.txt` have the rest."""

import contextlib
import itertools
import json
import os
import pty
import re
import signal
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import appliance
from appliance.audit.proof.copies import SignedCheckpoint
from appliance.cli.connection.admin_client import AccessDeniedError, NotRunningError
from appliance.cli.output import new_file
from appliance.features.audit_tools import audit_verbs
from appliance.features.audit_tools.audit_verbs import _checkpoints
from appliance.features.audit_tools.unrecorded import CATEGORIES
from appliance.master.graph.registry import Kind
from appliance.policy.model import Category
from appliance.specifications.allocation import SERVICE, TOPIC
from tests.support.audit import decision, settle
from tests.support.command import rosrv
from tests.support.engines import open_log
from tests.support.small_disk import small_disk

_EVIL = "/evil\x1b[31m\u202e\r\n[bold]x[/bold]"
_LIMIT_SECONDS = 60


@pytest.fixture
def state(tmp_path: Path) -> Path:
    (tmp_path / "control").mkdir()
    log = open_log(tmp_path / "control" / "audit.db")
    for number in range(20):
        log.record(decision(log, number))
    log.record(
        decision(
            log, decision="deny", caller_id=_EVIL, host="10.66.0.1", resource="/arm", reason="no rule lets it"
        )
    )
    log.close()
    return tmp_path


def checkpoint(number: int, log: str = "one") -> SignedCheckpoint:
    return SignedCheckpoint(
        log=log, number=number, sequence=number, hash="", time=0, previous="", signature="", key="",
        removed=None,
    )  # fmt: skip


def followed(
    monkeypatch: pytest.MonkeyPatch, *answers: list[SignedCheckpoint] | NotRunningError
) -> Iterator[SignedCheckpoint]:
    """Follow a log that gives these lists of all its checkpoints, or errors; the last one again and again."""
    monkeypatch.setattr(audit_verbs, "_CHECKPOINT_SECONDS", 0.0)
    later = itertools.chain(answers, itertools.repeat(answers[-1]))

    def read(after: int) -> list[SignedCheckpoint]:
        answer = next(later)
        if isinstance(answer, NotRunningError):
            raise answer
        return [checkpoint for checkpoint in answer if checkpoint.number > after]

    checkpoints = _checkpoints(read, 0, follow=True)
    return (one for several in checkpoints for one in several)


def test_following_checkpoints_survives_a_restart_of_the_appliance(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    one, two, three = map(checkpoint, (1, 2, 3))
    away = [NotRunningError("https://robot: the connection broke")] * 50
    checkpoints = followed(monkeypatch, [], [one, two], *away, [one, two], [one, two, three])
    assert list(itertools.islice(checkpoints, 3)) == [one, two, three]
    assert capsys.readouterr().err == "rosrv: https://robot: the connection broke; trying again\n"


def test_following_checkpoints_ends_without_access_and_without_a_first_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.raises(AccessDeniedError):
        list(followed(monkeypatch, [checkpoint(1)], AccessDeniedError("the token has expired")))
    with pytest.raises(NotRunningError):
        list(followed(monkeypatch, NotRunningError("cannot be reached")))


def test_following_checkpoints_continues_with_the_log_that_replaces_the_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first, second = [checkpoint(number) for number in range(1, 4)], [checkpoint(1, "two")]
    checkpoints = followed(monkeypatch, first, first, second)
    assert list(itertools.islice(checkpoints, 4)) == [*first, *second]
    full = [*first, checkpoint(4), checkpoint(5)]
    checkpoints = followed(monkeypatch, first, full)
    assert list(itertools.islice(checkpoints, 5)) == full


def test_every_recorded_category_is_known() -> None:
    sources = Path(appliance.__file__).parent.rglob("*.py")
    written = {word for path in sources for word in re.findall(r'category="(\w+)"', path.read_text())}
    assert written | {TOPIC, SERVICE, *Category, *Kind} == set(CATEGORIES)


@pytest.mark.nightly
def test_search_on_a_terminal_is_a_table(state: Path) -> None:
    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "appliance.cli.main", "audit", "search", "--deny", "--state", str(state)]
    environment = os.environ | {"COLUMNS": "200", "TERM": "xterm"}
    with subprocess.Popen(command, stdout=theirs, stderr=theirs, env=environment) as process:
        os.close(theirs)
        shown = b""
        with contextlib.suppress(OSError):  # the terminal closes with the command
            while part := os.read(ours, 65_536):
                shown += part
        assert process.wait(_LIMIT_SECONDS) == 0
    os.close(ours)
    assert b"decision" in shown
    assert b"/evil\\x1b[31m\\u202e\\r\\n[bold]x[/bold]" in shown
    assert b"\x1b[31mx" not in shown
    assert "\u202e".encode() not in shown


@pytest.mark.nightly
@pytest.mark.parametrize("what", [[], ["--deny"]], ids=["amid it", "when its only piece is written"])
def test_an_export_to_a_full_disk_leaves_no_file(state: Path, tmp_path: Path, what: list[str]) -> None:
    """A partial file would look complete, and block the next export."""
    with small_disk(tmp_path / "disk", "4k") as disk:
        (disk / "full").write_bytes(bytes(4096))
        done = rosrv("audit", "export", *what, "--output", str(disk / "out.ndjson"), "--state", str(state))
        assert (done.returncode != 0, "out.ndjson: No space left" in done.stderr) == (True, True), done.stderr
        assert [one.name for one in disk.iterdir()] == ["full"]


@pytest.mark.nightly
def test_tail_follows(state: Path) -> None:
    command = [sys.executable, "-m", "appliance.cli.main", "audit", "tail", "-n", "1", "--deny", "--json"]
    environment = os.environ | {"ROSRV_STATE": str(state)}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert json.loads(process.stdout.readline())["resource"] == "/arm"
        log = open_log(state / "control" / "audit.db")
        log.record(decision(log, decision="allow"))
        log.record(decision(log, decision="deny", resource="/new"))
        assert settle(log) is None
        assert json.loads(process.stdout.readline())["resource"] == "/new"
        log.close()
        process.send_signal(signal.SIGINT)
        assert process.wait(_LIMIT_SECONDS) == 0
        assert process.stderr.read() == ""


def test_an_export_is_private(tmp_path: Path) -> None:
    before = os.umask(0o022)
    try:
        with new_file(tmp_path / "week.ndjson") as file:
            file.write(b"{}\n")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "week.ndjson").stat().st_mode) == 0o600
    assert (tmp_path / "week.ndjson").read_text() == "{}\n"
