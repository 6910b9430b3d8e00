from pathlib import Path

import pytest

from appliance.audit.log import log_writer
from appliance.audit.log.ids import IdSource
from appliance.audit.log.log_writer import ChainWriter
from appliance.audit.log.record import AuditRecord, Severity
from appliance.audit.log.repetition import KIND, FoldState
from appliance.signing.log_proof import Checkpoint, parse_checkpoint

_DAY = 86_400_000_000_000
_STEP = 2


def counted(number: int) -> FoldState:
    return FoldState(
        scope=KIND, event="decision", severity=Severity.INFO, decision="allow", host="10.0.0.5",
        caller_id="/n", category="command", resource="getParam", rule=None, revision=1, reason="",
        recorded_id="1", count=number,
    )  # fmt: skip


def test_counts_of_many_kinds_are_stored_changed_and_removed_together(tmp_path: Path) -> None:
    """More kinds than one statement takes; the next writer finds the newest counts."""
    keys = [f"{number}".encode() for number in range(150)]
    writer = ChainWriter(tmp_path / "audit.db", 0)
    writer.append([], [(key, counted(1)) for key in keys])
    writer.append([], [(key, counted(2) if number % 2 else None) for number, key in enumerate(keys)])
    writer.close()
    again = ChainWriter(tmp_path / "audit.db", 0)
    assert {key: state.count for key, state in again.open_folds().items()} == dict.fromkeys(keys[1::2], 2)
    again.close()


@pytest.mark.parametrize("number", [0, 1, _STEP, 20 * _STEP - 1, 20 * _STEP + 1, 50 * _STEP])
def test_checkpoints_of_a_clock_that_was_ahead_are_removed_with_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    writer, ids, read = ChainWriter(tmp_path / "audit.db", 0), IdSource(clock=lambda: 0), list[bytes]()

    def parse(text: bytes) -> Checkpoint:
        read.append(text)
        return parse_checkpoint(text)

    monkeypatch.setattr(log_writer, "parse_checkpoint", parse)

    def seal(time: int) -> None:
        def report(_made: Checkpoint) -> AuditRecord:
            return AuditRecord(id=ids.next(), time=time, event="checkpoint", severity=Severity.DEBUG)

        writer.seal(time, report)

    for ahead in range(number):
        seal(3650 * _DAY + ahead)
    for day in range(12):
        seal(day * _DAY)
    for _look in range(2):
        # 7 days are kept; while the clock is behind, no checkpoint is usable.
        assert writer.removable(_STEP, signed=False, before=-7 * _DAY, now=-1) is None
        gone = writer.removable(_STEP, signed=False, before=5 * _DAY, now=12 * _DAY)
        assert gone is not None
        assert number < gone.last_checkpoint <= number + 5
        assert gone.first_sequence == 1
    read.clear()
    assert writer.removable(_STEP, signed=False, before=5 * _DAY, now=12 * _DAY) == gone
    assert len(read) <= _STEP + 2
    writer.close()
