import errno
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from appliance.audit.log.log import AuditLog
from appliance.audit.log.record import Severity
from appliance.audit.log.retention import Retention
from appliance.audit.proof.copies import SYSLOG_ELEMENT, read_copies, signed_checkpoints
from appliance.audit.proof.verification import verify
from appliance.audit.search.query import Filter
from appliance.audit.search.search import SearchPage, search
from appliance.features.syslog.process import (
    Chosen,
    ForwardingPosition,
    LogForwarder,
    load_position,
    save_position,
)
from appliance.features.syslog.syslog import Formatter
from tests.support.audit import decision, settle
from tests.support.engines import let_pass
from tests.support.syslog import Message, parse
from tests.unit.features.conftest import MakeLog, Notary

_DAY = 86_400_000_000_000


class Kept:
    def __init__(self) -> None:
        self.lines: list[bytes] = []
        self.failing = 0
        self.torn = False

    def send(self, messages: Sequence[bytes]) -> None:
        if self.torn:
            self.lines += messages[: len(messages) // 2]
            raise ConnectionResetError("cut in the middle")
        if self.failing:
            self.failing -= 1
            raise ConnectionRefusedError("nobody there")
        self.lines += messages

    def close(self) -> None: ...

    @property
    def messages(self) -> list[Message]:
        return [parse(line) for line in self.lines]

    def sequences(self) -> list[int]:
        return [int(one.fields["sequence"]) for one in self.messages if SYSLOG_ELEMENT not in one.elements]


@pytest.fixture
def kept() -> Kept:
    return Kept()


def forwarder(path: Path, kept: Kept, chosen: Chosen = "all") -> LogForwarder:
    formatter = Formatter(facility=13, longest=8192, host_name="robot")
    return LogForwarder(path, path.with_name("position.json"), kept, formatter, chosen=chosen)


def run(log_forwarder: LogForwarder, steps: int = 100) -> None:
    for _ in range(steps):
        if log_forwarder.step() > 0:
            return
    raise AssertionError("it does not come to an end")


def record(log: AuditLog, count: int, **fields: object) -> None:
    for number in range(count):
        log.record(decision(log, number, **fields))
    assert settle(log) is None


def everything(path: Path) -> list[int]:
    found: list[int] = []
    cursor: str | None = "0"
    while cursor is not None:
        page = search(path, Filter(), cursor, 1000, newest_first=False)
        found += [entry.sequence for entry in page.entries]
        cursor = page.cursor
    return found


def test_the_whole_log_is_sent_in_order(make_log: MakeLog, path: Path, kept: Kept) -> None:
    log = make_log()
    record(log, 700)
    log_forwarder = forwarder(path, kept)
    run(log_forwarder)
    record(log, 3)
    run(log_forwarder)
    assert kept.sequences() == everything(path)
    assert log_forwarder.progress.behind == 0
    assert log_forwarder.progress.trouble == ""


def test_a_failed_batch_is_sent_again(make_log: MakeLog, path: Path, kept: Kept) -> None:
    log = make_log()
    record(log, 10)
    kept.failing = 4
    log_forwarder = forwarder(path, kept)
    pauses = []
    for _ in range(4):
        pauses.append(log_forwarder.step())
        let_pass(log, pauses[-1])
    assert pauses == sorted(pauses)
    assert pauses[-1] > pauses[0]
    assert log_forwarder.progress.trouble == "nobody there"
    assert log_forwarder.progress.behind >= 10
    assert log_forwarder.progress.seconds > 0
    run(log_forwarder)
    assert kept.sequences() == everything(path)
    assert log_forwarder.progress.trouble == ""


def test_the_interval_is_bounded(make_log: MakeLog, path: Path, kept: Kept) -> None:
    record(make_log(), 1)
    kept.failing = 50
    log_forwarder = forwarder(path, kept)
    assert max(log_forwarder.step() for _ in range(50)) == 30.0


def test_it_continues_after_a_restart(make_log: MakeLog, path: Path, kept: Kept) -> None:
    log = make_log()
    record(log, 300)
    first = forwarder(path, kept)
    run(first)
    first.close()
    record(log, 5)
    second = forwarder(path, kept)
    run(second)
    assert kept.sequences() == everything(path)


def test_a_killed_forwarder_repeats_its_batch(make_log: MakeLog, path: Path, kept: Kept) -> None:
    log = make_log()
    record(log, 300)
    first = forwarder(path, kept)
    first.step()
    kept.torn = True
    first.step()  # killed: nothing is closed
    kept.torn = False
    run(forwarder(path, kept))
    sequences = kept.sequences()
    assert sorted(set(sequences)) == everything(path)
    assert len(sequences) > len(set(sequences))


def test_only_denials_are_sent_if_configured(make_log: MakeLog, path: Path, kept: Kept) -> None:
    log = make_log(checkpoint_every=5)
    record(log, 20)
    log.record(decision(log, decision="deny", severity=Severity.WARNING, resource="/arm"))
    log.record(decision(log, decision=None, event="probe failed", severity=Severity.ALARM))
    assert settle(log) is None
    log.close()
    log_forwarder = forwarder(path, kept, "denials")
    run(log_forwarder)
    records = [message for message in kept.messages if SYSLOG_ELEMENT not in message.elements]
    assert {one.event for one in records} == {"decision", "probe-failed"}
    assert [one.fields.get("decision") for one in records if one.event == "decision"] == ["deny"]
    assert len(kept.messages) - len(records) == len(signed_checkpoints(path))
    assert log_forwarder.progress.behind == 0


def test_checkpoints_at_the_receiver_prove_the_log(
    make_log: MakeLog, path: Path, kept: Kept, tmp_path: Path
) -> None:
    log = make_log(checkpoint_every=50)
    for _ in range(10):
        record(log, 30)
    log.close()
    run(forwarder(path, kept))
    file = tmp_path / "messages.log"
    file.write_bytes(b"\n".join(b"Nov 20 10:00:00 robot " + line for line in kept.lines))
    copies = read_copies(file)
    assert copies == signed_checkpoints(path)
    result = verify(path, copies=copies)
    assert result.ok
    assert result.elsewhere is not None
    assert result.elsewhere.checkpoints == len(copies)
    seen = 0
    for message in kept.messages:
        if SYSLOG_ELEMENT in message.elements:
            assert int(message.fields["sequence"]) <= seen
        else:
            seen = int(message.fields["sequence"])


def test_records_removed_before_sending_are_counted(
    make_log: MakeLog, path: Path, kept: Kept, notary: Notary
) -> None:
    notary.ago = 2 * _DAY
    log = make_log(checkpoint_every=20, clock=lambda: 1)
    record(log, 100, time=1)
    first = forwarder(path, kept)
    first.step()
    first.close()
    record(log, 400, time=1)
    log.close()
    before = kept.sequences()[-1]
    notary.ago = 0
    log = make_log(checkpoint_every=20, retention=Retention(days=1))
    for _ in range(200):
        record(log, 1)
        if everything(path)[0] > before + 1:
            break
    log.close()
    log_forwarder = forwarder(path, kept)
    run(log_forwarder)
    assert log_forwarder.progress.missed == everything(path)[0] - before - 1
    assert log_forwarder.progress.missed > 0
    assert log_forwarder.progress.behind == 0


def test_an_old_log_has_no_missed_records(make_log: MakeLog, path: Path, kept: Kept, notary: Notary) -> None:
    notary.ago = 2 * _DAY
    log = make_log(checkpoint_every=20, clock=lambda: 1)
    record(log, 100, time=1)
    log.close()
    notary.ago = 0
    log = make_log(checkpoint_every=20, retention=Retention(days=1))
    for _ in range(200):
        record(log, 1)
        if everything(path)[0] > 50:
            break
    log_forwarder = forwarder(path, kept)
    run(log_forwarder)
    assert everything(path)[0] > 50
    assert log_forwarder.progress.missed == 0


def test_another_log_is_sent_from_its_start(make_log: MakeLog, path: Path, kept: Kept) -> None:
    log = make_log()
    record(log, 20)
    log_forwarder = forwarder(path, kept)
    run(log_forwarder)
    log.close()
    for file in path.parent.glob("audit.db*"):
        file.unlink()
    kept.lines.clear()
    record(make_log(), 4)
    log_forwarder.step()  # notices the new log
    run(log_forwarder)
    assert kept.sequences() == everything(path)


def test_a_missing_log_is_waited_for(path: Path, kept: Kept) -> None:
    log_forwarder = forwarder(path, kept)
    assert log_forwarder.step() > 0
    assert "no audit log yet" in log_forwarder.progress.trouble


def test_an_unreadable_position_stops_it(make_log: MakeLog, path: Path, kept: Kept) -> None:
    record(make_log(), 3)
    path.with_name("position.json").write_text("rubbish")
    log_forwarder = forwarder(path, kept)
    assert log_forwarder.step() > 0
    assert "position.json" in log_forwarder.progress.trouble
    assert kept.lines == []


def put_back(path: Path, copy: Path) -> None:
    for file in path.parent.glob("audit.db*"):
        file.unlink()
    shutil.copy(copy, path)


@pytest.mark.parametrize("later", [0, 2, 40])
def test_a_restored_log_is_continued(
    make_log: MakeLog, path: Path, kept: Kept, tmp_path: Path, later: int
) -> None:
    log = make_log(checkpoint_every=5)
    record(log, 20)
    log.close()
    shutil.copy(path, tmp_path / "copy.db")
    log = make_log(checkpoint_every=5)
    record(log, 15)
    log.close()
    first = forwarder(path, kept)
    run(first)
    first.close()
    put_back(path, tmp_path / "copy.db")
    before = everything(path)[-1]
    kept.lines.clear()
    log = make_log(checkpoint_every=5)
    let_pass(log, 1)  # so that the new records differ from those that were lost
    record(log, later)
    log_forwarder = forwarder(path, kept)
    run(log_forwarder)
    record(log, 10)
    log.close()
    run(log_forwarder)
    assert [number for number in everything(path) if number > before] == kept.sequences()
    assert log_forwarder.progress.trouble == ""
    assert log_forwarder.progress.missed == 0
    sealed = [int(one.fields["number"]) for one in kept.messages if SYSLOG_ELEMENT in one.elements]
    assert sealed
    assert sealed[-1] == signed_checkpoints(path)[-1].number


def test_an_old_position_beyond_the_end_is_corrected(make_log: MakeLog, path: Path, kept: Kept) -> None:
    log = make_log()
    record(log, 5)
    (last,) = everything(path)[-1:]
    log_id = verify(path).log
    position = {"log": log_id, "sequence": last + 50, "checkpoint": 7}
    path.with_name("position.json").write_text(json.dumps(position))
    log_forwarder = forwarder(path, kept)
    run(log_forwarder)
    record(log, 2)
    run(log_forwarder)
    assert kept.sequences() == [last + 1, last + 2]


def test_records_removed_while_reading_are_counted(
    make_log: MakeLog, path: Path, kept: Kept, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = make_log()
    record(log, 30)
    log_forwarder = forwarder(path, kept)
    log_forwarder.step()
    before = kept.sequences()[-1]
    record(log, 30)

    def removing(*arguments: Any, **named: Any) -> SearchPage:
        page = search(*arguments, **named)
        return SearchPage(page.entries[5:], page.cursor)

    monkeypatch.setattr("appliance.features.syslog.process.search", removing)
    log_forwarder.step()
    assert kept.sequences()[-1] > before
    assert log_forwarder.progress.missed == 5


def test_a_position_is_stored_and_loaded(tmp_path: Path) -> None:
    file = tmp_path / "position.json"
    assert load_position(file) is None
    for position in (ForwardingPosition("a" * 32, 7, 1), ForwardingPosition("a" * 32, 9, 2)):
        save_position(file, position)
        assert load_position(file) == position
    assert [one.name for one in tmp_path.iterdir()] == ["position.json"]


@pytest.mark.parametrize("text", ["", "{}", "rubbish", '{"log":1,"sequence":2}'])
def test_an_unreadable_position_is_an_error(tmp_path: Path, text: str) -> None:
    file = tmp_path / "position.json"
    file.write_text(text)
    with pytest.raises(ValueError, match=r"position\.json.*remove it"):
        load_position(file)


def test_a_full_disk_delays_no_record(make_log: MakeLog, kept: Kept, monkeypatch: pytest.MonkeyPatch) -> None:
    log = make_log()
    record(log, 600)
    log_forwarder = forwarder(log.path, kept)
    save = "appliance.features.syslog.process.save_position"

    def no_space(*_arguments: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "position.json")

    with monkeypatch.context() as full:
        full.setattr(save, no_space)
        run(log_forwarder)
        assert kept.sequences() == everything(log.path)
        assert "position is not kept" in log_forwarder.progress.trouble
        assert "position.json" in log_forwarder.progress.trouble
    record(log, 1)
    run(log_forwarder)
    assert log_forwarder.progress.trouble == ""
    position = load_position(log.path.with_name("position.json"))
    assert position is not None
    assert position.sequence == everything(log.path)[-1]
