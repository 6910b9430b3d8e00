"""Report the interventions in the safety settings of many robots, from the index, as `rosrv report interventions`.

Each robot is one history: the logs of both appliances of a pair, and earlier logs, by time. A record that the collector
has twice counts once: retention by size writes it again, and a log that was restored from a copy is sent again.
"""

import itertools
from collections.abc import Iterable, Iterator
from operator import itemgetter
from typing import NamedTuple

import psycopg
from psycopg_pool import PoolTimeout

from appliance.audit.log.columns import StoredColumns, from_columns
from appliance.audit.log.record_format import LogEntry, rfc3339
from appliance.base import clock
from appliance.base.counted import counted
from appliance.formats.interventions import READ
from appliance.formats.machine_report import (
    Gap,
    MachineReport,
    NamedEntry,
    Period,
    Reading,
    ReportedLog,
    merged,
    read_records,
)
from rosrv_fleet.database import Connection, IndexDatabase, Row
from rosrv_fleet.search import IndexDownError, SearchTooLongError
from rosrv_fleet.search_sql import logs_statement, records_statement

_LIVE = "not known to the collector: make the report of one robot on its machine"
_PAGE = 2000


class CollectedLog(NamedTuple):
    """A log in the index: its last record, and the time of its earliest one (nanoseconds since the epoch)."""

    robot: str
    log: str
    last: int
    begins: int | None


def fleet_report(
    database: IndexDatabase, robot: str | None, since: int | None, until: int, *, waiting: int, version: str
) -> MachineReport:
    """Return the report of the robots whose names match. `waiting` is the number of segments that are not indexed yet.

    Raise `FilterError`, `SearchTooLongError` or `IndexDownError`.
    """
    try:
        with database.reading() as connection:
            logs = [CollectedLog(*row) for row in connection.execute(*logs_statement(robot))]
            return report_of(logs, _rows(connection, robot), since, until, waiting=waiting, version=version)
    except psycopg.errors.QueryCanceled as error:
        raise SearchTooLongError("the report took too long: give --robot, for fewer robots") from error
    except (psycopg.OperationalError, PoolTimeout, psycopg.errors.UndefinedTable) as error:
        raise IndexDownError("the index cannot be read now: try again; segments are still stored") from error


def _rows(connection: Connection, robot: str | None) -> Iterator[Row]:
    """Yield the rows in pages, so that the collector does not hold a year of all robots."""
    with connection.cursor(name="interventions") as cursor:
        cursor.itersize = _PAGE
        yield from cursor.execute(*records_statement(READ, robot))


def report_of(
    logs: Iterable[CollectedLog],
    rows: Iterable[Row],
    since: int | None,
    until: int,
    *,
    waiting: int,
    version: str,
) -> MachineReport:
    """Return the report of rows that are ordered by robot, log and sequence."""
    known = list(logs)
    begins = [log.begins for log in known if log.begins is not None]
    period = Period(min(begins, default=until) if since is None else since, until)
    found = Reading()
    for robot, of_robot in itertools.groupby(rows, key=itemgetter(0)):
        read = read_records(_history(robot, of_robot), period)
        found.interventions += read.interventions
        found.switched_off += read.switched_off
        found.blocks += read.blocks
        found.software += read.software
        found.drivers += read.drivers
        found.gaps += read.gaps
    if waiting:
        text = f"{counted(waiting, 'segment is', 'segments are')} stored, and not in the index yet: made too early"
        found.gaps.append(Gap(time_utc=rfc3339(until), event="not indexed yet", reason=text))
    return MachineReport(
        robot=f"{counted(len({log.robot for log in known}), 'robot')} of the collector", logs=_reported(known),
        since_utc=rfc3339(period.since), until_utc=rfc3339(until), made_utc=rfc3339(clock.wall_ns()), version=version,
        verify="rosrv-fleet verify", interfaces=[], rights=[], live_reason=_LIVE,
        interventions=sorted(found.interventions, key=lambda row: row.time),
        switched_off=found.switched_off, blocks=found.blocks, software=found.software, drivers=found.drivers,
        gaps=sorted(found.gaps, key=lambda gap: gap.time_utc),
    )  # fmt: skip


def _history(robot: str, rows: Iterable[Row]) -> Iterator[NamedEntry]:
    logs: dict[str, list[LogEntry]] = {}
    for _robot, log, *columns, detail in rows:
        stored = StoredColumns._make((*columns, detail.encode()))
        logs.setdefault(log, []).append(LogEntry(stored.sequence, from_columns(stored)))
    return (NamedEntry(robot, entry) for _log, entry in merged(logs))


def _reported(logs: Iterable[CollectedLog]) -> list[ReportedLog]:
    return [
        ReportedLog(
            name=log.robot, id=log.log, begins_utc="" if log.begins is None else rfc3339(log.begins), last=log.last,
            verification=None,
        )
        for log in logs
    ]  # fmt: skip
