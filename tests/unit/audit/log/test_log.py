import asyncio
import os
import signal
import sqlite3
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, NoReturn

import msgspec
import pytest
import structlog
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from appliance.audit.log import log as log_module
from appliance.audit.log import log_database
from appliance.audit.log.folding import FoldSettings, RecordFolder
from appliance.audit.log.log import AuditLog, Durability
from appliance.audit.log.log_writer import ChainWriter
from appliance.audit.proof.verification import verify
from appliance.audit.search.query import Filter
from appliance.audit.search.search import export, search, show
from appliance.base.engine_thread import Turn
from tests.support.audit import decision, settle
from tests.support.engines import ByHand, let_pass
from tests.support.small_disk import small_disk
from tests.support.virtual_clock import VirtualClock
from tests.support.waiting import eventually
from tests.unit.audit.conftest import MakeLog

_LIMIT_SECONDS = 30
OTHER_KEY = Ed25519PrivateKey.generate()


def events(path: Path) -> Counter[str]:
    return Counter(entry.record.event for entry in export(path, Filter()))


@pytest.mark.parametrize("durability", ["strict", "batched"])
def test_durable_records_are_on_disk(make_log: MakeLog, path: Path, durability: str) -> None:
    log = make_log(durability=durability)
    sent = [decision(log, number) for number in range(500)]
    for one in sent:
        log.record(one)
    assert settle(log) is None
    stored = [entry.record for entry in export(path, Filter(event="decision"))]
    assert stored == sent
    assert log.lag.records == 0


def tried_again(log: AuditLog) -> str | None:
    let_pass(log, 1)
    return log.failed


@pytest.mark.nightly
@pytest.mark.parametrize("durability", ["strict", "batched"])
def test_records_reach_the_disk_without_a_wait(path: Path, durability: Durability) -> None:
    log = AuditLog(path, durability=durability)
    for number in range(1, 4):
        log.record(decision(log))
        eventually(lambda: events(path)["decision"] == number, "it is on disk")  # noqa: B023  called before the next
    assert log.close() is None


@pytest.mark.parametrize(("durability", "gather"), [("strict", 0.0), ("batched", 0.02)])
def test_only_a_batched_log_gathers_records(path: Path, durability: Durability, gather: float) -> None:
    asked: list[float] = []

    def drive(name: str, turn: Turn, seconds: float) -> ByHand:
        asked.append(seconds)
        return ByHand(name, turn, seconds)

    assert AuditLog(path, durability=durability, drive=drive).close() is None
    assert asked == [gather]


def test_a_turn_writes_one_batch(path: Path, time: VirtualClock) -> None:
    log = AuditLog(path, drive=ByHand)
    for number in range(3000):
        log.record(decision(log, number))
    assert log.lag.records == 3000
    now = time.now_ns() / 1e9
    assert log.turn(now) == now
    assert (events(path)["decision"], log.lag.records) == (2048, 3000 - 2048)
    assert log.turn(now) == pytest.approx(now + 1)
    assert (events(path)["decision"], log.lag.records) == (3000, 0)
    assert log.close() is None


@pytest.mark.parametrize("part", [(ChainWriter, "append"), (RecordFolder, "expire")])
def test_a_defect_is_a_failure_until_it_has_passed(
    path: Path, time: VirtualClock, monkeypatch: pytest.MonkeyPatch, part: tuple[type, str]
) -> None:
    log = AuditLog(path, drive=ByHand)

    def defect(*_: object) -> NoReturn:
        raise RuntimeError("unforeseen")

    with monkeypatch.context() as broken:
        broken.setattr(*part, defect)
        log.record(decision(log))
        assert log.turn(time.now_ns() / 1e9) is not None, "the thread must not end"
        assert "RuntimeError: unforeseen" in str(log.failed)
        assert log.lag.records == 1
    let_pass(log, 1)
    assert (log.failed, settle(log), events(path)["decision"]) == (None, None, 1)
    assert events(path)["log failed"] == 1
    assert log.close() is None


def test_many_waiters_share_commits(make_log: MakeLog, path: Path) -> None:
    """Each gets its answer only after its own record is on disk."""
    log = make_log(durability="strict")

    async def request(number: int) -> None:
        record = decision(log, number)
        log.record(record)
        assert await log.wait_durable() is None

    async def all_of_them() -> None:
        await asyncio.gather(*(request(number) for number in range(100)))

    asyncio.run(asyncio.wait_for(all_of_them(), _LIMIT_SECONDS))
    assert events(path)["decision"] == 100


def test_a_reopened_log_continues(make_log: MakeLog, path: Path) -> None:
    first = make_log(clock=lambda: 2_000_000_000_000_000_000)
    first.record(decision(first))
    assert first.close() is None
    second = make_log(clock=lambda: 1_000_000_000_000_000_000)
    second.record(decision(second))
    assert second.close() is None
    ids = [entry.record.id for entry in export(path, Filter(event="decision"))]
    assert ids[0][:16] < ids[1][:16]
    result = verify(path)
    assert result.ok, result.findings
    assert events(path)["log begun"] == 1
    modes = [path.with_name(name).stat().st_mode & 0o777 for name in ("audit.db", "audit.db.lock")]
    assert modes == [0o640, 0o600]


@pytest.mark.nightly
def test_a_killed_writer_loses_nothing_confirmed(path: Path) -> None:
    script = (
        "import asyncio, sys; from pathlib import Path; from appliance.audit.log.log import AuditLog;"
        "from tests.support.audit import decision\n"
        "log = AuditLog(Path(sys.argv[1]), durability='strict')\n"
        "async def work():\n"
        "    number = 0\n"
        "    while True:\n"
        "        for _ in range(50):\n"
        "            number += 1; log.record(decision(log, number))\n"
        "        assert await log.wait_durable() is None\n"
        "        print(number, flush=True)\n"
        "asyncio.run(work())\n"
    )
    confirmed = 0
    for _life in range(3):
        with subprocess.Popen(
            [sys.executable, "-c", script, str(path)], stdout=subprocess.PIPE, text=True, cwd=Path.cwd()
        ) as process:
            assert process.stdout is not None
            lines = [process.stdout.readline() for _ in range(20)]
            process.send_signal(signal.SIGKILL)
            rest = process.stdout.read().splitlines()
        confirmed += int([line for line in lines + rest if line.strip()][-1])
    assert events(path)["decision"] >= confirmed
    result = verify(path)
    assert result.ok, result.findings
    log = AuditLog(path, drive=ByHand)
    assert log.failed is None
    log.record(decision(log))
    assert log.close() is None
    assert verify(path).ok


@pytest.mark.nightly
def test_counted_denials_survive_a_kill(path: Path) -> None:
    script = (
        "import asyncio, os, signal, sys; from pathlib import Path; from appliance.audit.log.log import AuditLog;"
        "from appliance.audit.log.folding import FoldSettings; from tests.support.audit import decision\n"
        "log = AuditLog(Path(sys.argv[1]), fold=FoldSettings(seconds=3600))\n"
        "for _ in range(100): log.record(decision(log, decision='deny'))\n"
        "asyncio.run(log.wait_durable()); os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    subprocess.run([sys.executable, "-c", script, str(path)], cwd=Path.cwd(), timeout=60, check=False)
    AuditLog(path, drive=ByHand).close()
    (entry,) = export(path, Filter(event="denials folded"))
    assert entry.record.detail["count"] == 99
    assert entry.record.detail["recovered"] is True


def test_flood_of_denials(make_log: MakeLog, path: Path) -> None:
    log = make_log(fold=FoldSettings(seconds=10))
    before = decision(log, decision="deny", resource="/evidence")
    log.record(before)
    for _ in range(10):
        for _ in range(10_000):
            log.record(decision(log, decision="deny"))
        let_pass(log, 2)
    assert log.close() is None
    records = [entry.record for entry in export(path, Filter(decision=("deny",)))]
    assert records[0] == before
    assert [one.detail["count"] for one in records if one.event == "denials folded"] == [49_999, 50_000]
    assert len(records) == 4
    assert verify(path).ok


@pytest.mark.parametrize("unknown", [False, True], ids=["named", "unknown"])
@pytest.mark.parametrize("at_once", [False, True], ids=["later", "at once"])
def test_a_repeated_denial_gets_the_id_of_a_stored_record(
    make_log: MakeLog, path: Path, unknown: bool, at_once: bool
) -> None:
    log = make_log()

    def told(**about: Any) -> str:
        record = decision(log, decision="deny", **about)
        found_by = log.record(msgspec.structs.replace(record, unknown=unknown))
        assert at_once or settle(log) is None
        return found_by

    again = [told() for _ in range(3)]
    assert len(set(again)) == 1
    assert settle(log) is None
    shown = show(path, again[-1], 0)
    assert shown is not None
    assert shown.entry.record.decision == "deny"
    assert told(resource="/another") not in again
    assert told(caller_id="/another") not in again


def fill(path: Path) -> None:
    with path.open("wb", buffering=0) as file, pytest.raises(OSError, match="No space"):
        while True:
            file.write(b"x" * 512)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with small_disk(tmp_path / "disk", "2m") as place:
        yield place


@pytest.mark.nightly
def test_full_disk(disk: Path) -> None:
    path = disk / "audit.db"
    filler = disk / "filler"
    log = AuditLog(path, drive=ByHand)
    log.record(decision(log))
    assert settle(log) is None
    fill(filler)
    count = 0
    while log.failed is None:
        count += 1
        log.record(decision(log, count))
        settle(log)
        assert count < 100_000
    assert "full" in log.failed
    assert str(path) in log.failed
    assert settle(log, 0.5) == log.failed
    log.record(decision(log, count, resource="/while-failed"))
    filler.unlink()
    assert tried_again(log) is None
    assert settle(log) is None
    assert events(path)["decision"] == count + 2
    assert len(search(path, Filter(resource="/while-failed")).entries) == 1
    reports = search(path, Filter(event="log failed")).entries
    assert reports
    assert all("full" in report.record.reason for report in reports)
    assert log.close() is None
    assert verify(path).ok


@pytest.mark.nightly
def test_the_queue_is_bounded_and_losses_are_counted(disk: Path, time: VirtualClock) -> None:
    path = disk / "audit.db"
    log = AuditLog(path, drive=ByHand, queue_limit=100)
    assert settle(log) is None
    filler = disk / "filler"
    fill(filler)
    sent = 0
    while log.failed is None:
        sent += 1
        log.record(decision(log, sent))
        settle(log)
    for number in range(1000):
        sent += 1
        log.record(decision(log, number))
    assert log.lag.records <= 101
    time.advance(3)
    assert log.lag.seconds == pytest.approx(3)
    filler.unlink()
    assert tried_again(log) is None
    assert log.close() is None
    (lost,) = search(path, Filter(event="records lost")).entries
    assert events(path)["decision"] + lost.record.detail["count"] == sent
    assert verify(path).ok


@pytest.mark.parametrize("content", [b"", b"not a database" * 1000, b"SQLite format 3\0" + b"\0" * 5000])
def test_a_damaged_file_is_an_error_and_stays(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    log = AuditLog(path, drive=ByHand)
    assert log.failed is not None
    assert str(path) in log.failed
    log.record(decision(log))
    assert settle(log, 0.5) is not None
    assert log.close() is not None
    assert path.read_bytes() == content


def test_another_database_is_an_error(path: Path) -> None:
    with closing(sqlite3.connect(path)) as other:
        other.execute("CREATE TABLE something (x)")
    log = AuditLog(path, drive=ByHand)
    assert log.failed is not None
    assert "not an audit log" in log.failed
    log.close()


def test_a_changed_end_stops_writing(make_log: MakeLog, path: Path) -> None:
    log = make_log()
    log.record(decision(log))
    log.close()
    with closing(sqlite3.connect(path)) as attacker:
        attacker.execute("UPDATE record SET host = '10.9.9.9' WHERE event = 'decision'")
        attacker.commit()
    log = AuditLog(path, drive=ByHand)
    assert log.failed is not None
    assert "record 2" in log.failed
    assert "rosrv audit verify" in log.failed
    log.close()


def test_a_removed_file_is_noticed(make_log: MakeLog, path: Path) -> None:
    log = make_log()
    assert settle(log) is None
    path.rename(path.with_name("stolen.db"))
    log.record(decision(log))
    assert "removed or replaced" in (settle(log, 0.5) or "")


def test_a_second_writer_is_refused(make_log: MakeLog, path: Path) -> None:
    first = make_log()
    second = AuditLog(path, drive=ByHand)
    assert second.failed is not None
    assert "another process" in second.failed
    second.record(decision(second))
    first.close()
    assert tried_again(second) is None
    assert second.close() is None
    assert events(path)["decision"] == 1
    assert verify(path).ok


def test_the_process_that_locks_the_log_is_named(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[list[int]] = []
    monkeypatch.setattr(log_database, "_BUSY_SECONDS", 0)
    monkeypatch.setattr(log_module, "holders", lambda _path: [os.getpid(), 4711])
    log = AuditLog(path, drive=ByHand, held_by=told.append)
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        log.record(decision(log))
        assert settle(log) == f"{path}: database is locked by process 4711"
    assert told == [[4711]]
    assert settle(log, 0.5) is None
    assert log.close() is None


def test_a_missing_directory_is_a_failure(tmp_path: Path) -> None:
    path = tmp_path / "missing" / "audit.db"
    with structlog.testing.capture_logs() as said:
        log = AuditLog(path, drive=ByHand)
        log.record(decision(log))
        assert str(path) in (settle(log, 0.5) or "")
        path.parent.mkdir()
        assert tried_again(log) is None
    assert log.close() is None
    assert [one["event"] for one in said] == [
        "the audit log cannot be written",
        "the audit log is written again",
    ]
    assert str(path) in said[0]["reason"]
    assert events(path)["decision"] == 1
    (report,) = search(path, Filter(event="log failed")).entries
    assert report.record.detail["until"] - report.record.detail["since"] == 1_000_000_000


def test_missing_earlier_log_is_an_alarm(make_log: MakeLog, path: Path) -> None:
    log = make_log(checkpoint_every=1)
    log.record(decision(log))
    assert settle(log) is None
    log.close()
    assert path.with_name("audit.pub").exists()
    for one in path.parent.glob("audit.db*"):
        one.unlink()
    make_log().close()
    (begun,) = search(path, Filter(event="log begun")).entries
    assert begun.record.severity == "alarm"
    assert begun.record.detail["earlier_log_missing"] is True


def test_waiting_on_a_closed_log_is_an_error(make_log: MakeLog) -> None:
    log = make_log()
    log.close()
    log.record(decision(log))
    assert "closed" in (settle(log) or "")


def test_recovery_counts_denials_once(make_log: MakeLog, path: Path) -> None:
    log = make_log(fold=FoldSettings(seconds=3600))
    for _ in range(50):
        log.record(decision(log, decision="deny"))
    assert settle(log) is None
    stolen = path.with_name("stolen.db")
    path.rename(stolen)
    log.record(decision(log, decision="deny"))
    assert tried_again(log) is not None
    assert not path.exists(), "no new log takes the place of one that was removed"
    stolen.rename(path)
    assert tried_again(log) is None
    assert log.close() is None
    denials = [entry.record for entry in export(path, Filter(decision=("deny",)))]
    counted = sum(denial.detail["count"] for denial in denials if denial.event == "denials folded")
    assert counted + sum(denial.event == "decision" for denial in denials) == 51
    assert verify(path).ok


def signed_now(log: AuditLog) -> str | None:
    return asyncio.run(asyncio.wait_for(log.wait_signed(), _LIMIT_SECONDS))


def test_a_signature_can_be_requested_at_once(make_log: MakeLog, path: Path) -> None:
    log = make_log(checkpoint_seconds=3600)
    for number in range(5):
        log.record(decision(log, number))
    assert signed_now(log) is None
    sealed = verify(path)
    assert (sealed.ok, sealed.unsealed) == (True, 1)  # the record of the checkpoint
    before = events(path)["checkpoint"]
    assert signed_now(log) is None
    assert events(path)["checkpoint"] == before
    log.record(decision(log))
    assert signed_now(log) is None
    assert events(path)["checkpoint"] == before + 1


def test_a_refused_signature_is_reported(make_log: MakeLog) -> None:
    asked: list[int] = []
    log = make_log(checkpoint_seconds=3600, signer=lambda number, _text, **_: asked.append(number))
    log.record(decision(log))

    async def refused() -> str | None:
        waiting = asyncio.create_task(log.wait_signed())
        await asyncio.sleep(0)
        assert not waiting.done()
        log.refused(asked[-1], "it does not follow")
        let_pass(log, 1)
        return await waiting

    assert asyncio.run(asyncio.wait_for(refused(), _LIMIT_SECONDS)) == "it does not follow"


UNSIGNED: dict[str, Callable[[int, bytes], tuple[bytes, bytes] | str | None]] = {
    "signed with": lambda _number, text: (
        OTHER_KEY.sign(text),
        OTHER_KEY.public_key().public_bytes_raw(),
    ),
    "another checkpoint 6 ": lambda number, _text: (
        f"another checkpoint {number} of this log was signed before"
        if number == 6
        else f"checkpoint {number} does not follow number 6"
    ),
    "No space left": lambda _number, _text: "[Errno 28] No space left on device: '/signer/ab.signed'",
    "does not answer": lambda _number, _text: None,
}


@pytest.mark.parametrize("words", UNSIGNED)
def test_an_unsigned_log_is_degraded_and_not_flooded(
    make_log: MakeLog, path: Path, key: Ed25519PrivateKey, words: str
) -> None:
    public, faulty = key.public_key().public_bytes_raw(), False

    def sign(number: int, text: bytes, **_: object) -> None:
        answer = UNSIGNED[words](number, text) if faulty else (key.sign(text), public)
        if isinstance(answer, str):
            log.refused(number, answer)
        elif answer is not None:
            log.store_signature(number, *answer)

    def work(minutes: int) -> None:
        for number in range(minutes):
            log.record(decision(log, number))
            let_pass(log, 60)

    log = make_log(signer=sign, checkpoint_seconds=60)
    work(5)
    assert log.degraded is None
    faulty = True
    work(2)
    assert (log.degraded or "").startswith("the audit log is behind: ")
    assert words in (log.degraded or "")
    work(60)
    assert words in (log.degraded or "")
    assert events(path)["signature refused"] <= 2
    faulty = False
    work(2)
    assert log.degraded is None
    assert verify(path).signed_checkpoints > 60


def test_abandoned_waits_leave_no_memory(make_log: MakeLog) -> None:
    asked: list[int] = []
    log = make_log(checkpoint_seconds=3600, signer=lambda number, _text, **_: asked.append(number))

    async def give_up() -> None:
        for number in range(1, 6):
            log.record(decision(log, number))
            waiting = asyncio.create_task(log.wait_signed())
            await asyncio.sleep(0)
            assert len(asked) == number
            waiting.cancel()
            await asyncio.wait([waiting])

    asyncio.run(asyncio.wait_for(give_up(), _LIMIT_SECONDS))
    assert len(log.housekeeping.unsigned) <= 1
