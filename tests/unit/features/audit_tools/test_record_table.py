import re
import sys

import pytest

from appliance.audit.log.record import AuditRecord
from appliance.audit.log.record_format import LogEntry
from appliance.features.audit_tools.audit_verbs import print_entries

_STYLE = re.compile(r"\x1b\[[\d;]*m")


def show_on_terminal(monkeypatch: pytest.MonkeyPatch, columns: int = 200) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm" if columns > 80 else "dumb")
    monkeypatch.setenv("COLUMNS", str(columns))


def test_a_table_of_records_has_their_numbers(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    show_on_terminal(monkeypatch)
    print_entries([LogEntry(4711, AuditRecord(id="0" * 20, time=0, event="decision", decision="deny"))], str)
    head, row = _STYLE.sub("", capsys.readouterr().out).splitlines()
    assert (head.split()[0], row.split()[0]) == ("record", "4711")


def test_a_table_of_records_has_the_author_of_a_change(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    show_on_terminal(monkeypatch)
    loaded = ("policy loaded", "alice"), ("policy loaded", 7)
    authors = *loaded, ("rest call", None), ("denials folded", "None")
    records = [AuditRecord(id="0" * 20, time=0, event=event, detail={"who": who}) for event, who in authors]
    print_entries([LogEntry(number, record) for number, record in enumerate(records)], str, each=True)
    head, *rows = _STYLE.sub("", capsys.readouterr().out).splitlines()
    column = head.index("who")
    assert [row[column:].strip() for row in rows] == ["by alice", "by 7", "", ""]


def test_a_narrow_terminal_has_the_reason_below(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    show_on_terminal(monkeypatch, 80)
    denied = AuditRecord(
        id="0" * 20, time=0, event="decision", decision="deny", host="10.77.0.66", caller_id="/tablet",
        category="publish", resource="/cmd_vel", reason="10.77.0.66 is not among the hosts that may publish /cmd_vel",
    )  # fmt: skip
    print_entries([LogEntry(12, denied), LogEntry(11, AuditRecord(id="1", time=0, event="log begun"))], str)
    assert [line.rstrip() for line in capsys.readouterr().out.splitlines()] == [
        "12  1970-01-01 00:00:00.000Z  deny  decision  10.77.0.66 /tablet  publish",
        "    /cmd_vel",
        "    10.77.0.66 is not among the hosts that may publish /cmd_vel",
        "11  1970-01-01 00:00:00.000Z  log begun",
    ]


def test_equal_records_are_one_row(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    show_on_terminal(monkeypatch)
    entries = [
        LogEntry(
            number,
            AuditRecord(
                id="0" * 20, time=(86_000 + number) * 1_000_000_000, event="message dropped", category="monitor",
                resource="/cmd_vel", reason=f"speed 0.{number}", detail={"monitor": "speedLimit"},
            ),
        )
        for number in (5, 4, 3)
    ]  # fmt: skip
    print_entries(entries, str)
    _head, row = _STYLE.sub("", capsys.readouterr().out).splitlines()
    assert " ".join(row.split()) == (
        "3 1970-01-01 23:53:23 to 23:53:25Z message dropped monitor speedLimit /cmd_vel 3 times, last: speed 0.5"
    )
    print_entries(entries, str, each=True)
    numbers = [_STYLE.sub("", row).split()[0] for row in capsys.readouterr().out.splitlines()]
    assert numbers == ["record", "5", "4", "3"]
