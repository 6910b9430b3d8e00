"""The output of `rosrv audit` on a terminal."""

import sys

import pytest

from appliance.audit.chain_findings import Verification
from appliance.audit.record import AuditRecord
from appliance.audit.record_format import LogEntry
from appliance.cli.audit.record_table import print_entries, print_verification


@pytest.mark.parametrize(
    ("signed_through", "verdict"),
    [
        (0, "The log is consistent, but nothing is signed yet"),
        (7, "The log is complete and unchanged."),
    ],
)
def test_a_log_is_complete_only_once_something_is_signed(
    capsys: pytest.CaptureFixture[str], signed_through: int, verdict: str
) -> None:
    """Without a signature, anyone who can write the files could have written another log."""
    print_verification(
        Verification(
            ok=True, log="one", first=1, last=9, records=9, removed=0, checkpoints=1, signed_checkpoints=1,
            signed_through=signed_through, unsealed=2, key="", findings=[],
        )
    )  # fmt: skip
    assert capsys.readouterr().out.splitlines()[-1].startswith(verdict)


def test_a_table_of_records_has_their_numbers(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The table has the record numbers that `rosrv audit why` and `rosrv policy grant` take as arguments."""
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "dumb")
    print_entries([LogEntry(4711, AuditRecord(id="0" * 20, time=0, event="decision", decision="deny"))])
    head, row = capsys.readouterr().out.splitlines()
    assert (head.split()[0], row.split()[0]) == ("record", "4711")
