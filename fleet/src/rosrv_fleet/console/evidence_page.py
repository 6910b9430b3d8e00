"""The page that lists evidence bundles."""

from collections.abc import Mapping

from rosrv_fleet.collector import Collector
from rosrv_fleet.console.frame import Column, field, link, local_time, moment, row, table, text
from rosrv_fleet.evidence.store import StoredEvidence

FILTERS = ("robot", "id")
_COLUMNS = (
    Column("Robot"),
    Column("From"),
    Column("Until"),
    Column("Recording"),
    Column("Records", number=True),
    Column("Bytes", number=True),
    Column("Checkpoints"),
    Column("Added"),
    Column("Bundle"),
)


def evidence_page(collector: Collector, asked: Mapping[str, str], *, may_get: bool) -> str:
    stored = collector.evidence.all(asked["robot"])
    rows = (_bundle(one, may_get=may_get) for one in stored if asked["id"] in ("", one.id))
    return (
        '<h1>Evidence</h1><form class="filter" action="/evidence" role="search" aria-label="Evidence">'
        + field("robot", asked["robot"])
        + "<button>Show</button></form>"
        + table("Evidence bundles", _COLUMNS, rows, "None: rosrv-fleet evidence add FILE --robot NAME")
    )


def _bundle(one: StoredEvidence, *, may_get: bool) -> str:
    name = one.id[:12]
    return row(
        _COLUMNS,
        (
            link("/evidence", one.robot, robot=one.robot),
            *(text(local_time(at)) for at in (one.since, one.until)),
            text(one.recording),
            f"{one.records:,}",
            f"{one.bytes:,}",
            f"{one.collected:,} of {one.checkpoints:,} are collected",
            f"{moment(one.added / 10**9)} by {text(one.by)}",
            link(f"/v1/evidence/{one.id}", name) if may_get else text(name),
        ),
    )
