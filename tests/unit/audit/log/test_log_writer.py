from pathlib import Path

from appliance.audit.log.log_writer import ChainWriter
from appliance.audit.log.record import Severity
from appliance.audit.log.repetition import KIND, FoldState


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
