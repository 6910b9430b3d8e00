import csv
import io

from appliance.audit.log.record import AuditRecord, Severity
from appliance.audit.log.record_format import LogEntry
from appliance.features.audit_tools.csv_records import COLUMNS, csv_head, csv_lines


def test_a_spreadsheet_reads_each_cell_and_runs_none() -> None:
    hostile = '=HYPERLINK("https://evil.example","x")'
    record = AuditRecord(
        id="18ea0bbd5e6abf7f3238", time=7, event="decision", severity=Severity.WARNING, decision="deny",
        host="10.0.0.7", caller_id=hostile, resource="/a,b", reason='says "no",\nin two lines', detail={"n": 1},
    )  # fmt: skip
    [(sequence, line)] = csv_lines([LogEntry(12, record)])
    [head, cells] = csv.reader(io.StringIO(f"{csv_head()}\n{line}\n", newline=""))
    row = dict(zip(head, cells, strict=True))
    assert (sequence, tuple(head)) == (12, COLUMNS)
    assert row["caller_id"] == f"'{hostile}"
    assert (row["resource"], row["reason"], row["detail"]) == ("/a,b", record.reason, '{"n":1}')
    assert (row["time"], row["category"], row["section"]) == ("1970-01-01T00:00:00.000000007Z", "", "")
