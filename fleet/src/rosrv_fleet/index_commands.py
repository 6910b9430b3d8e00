"""The commands that read the index: `rosrv-fleet search`, `report interventions` and `who-drove`."""

import itertools
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from operator import itemgetter
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
import psycopg
import typer
from psycopg_pool import PoolTimeout

from appliance import __version__
from appliance.audit.log.columns import StoredColumns
from appliance.audit.log.record_format import LogEntry, printable, rfc3339, stored_entry
from appliance.audit.search.filter_options import FILTER, Since, Until
from appliance.base import clock
from appliance.base.counted import counted
from appliance.base.timestamps import in_local_zone, parse_timestamp
from appliance.formats.interventions import READ
from appliance.formats.machine_report import (
    Gap,
    MachineReport,
    NamedEntry,
    Period,
    Reading,
    ReportedLog,
    merge,
    read_records,
)
from appliance.formats.report_words import host_words, page, report_lines
from rosrv_fleet.collector import Collector, make_collector
from rosrv_fleet.config import load_config
from rosrv_fleet.database import INCOMPLETE, Connection, IndexDatabase, Row, is_complete
from rosrv_fleet.enrolment import Robot
from rosrv_fleet.options import DEFAULT_CONFIG, Config, Json
from rosrv_fleet.output import note
from rosrv_fleet.search import LARGEST_FLEET_PAGE, IndexDownError, SearchTooLongError, search_fleet
from rosrv_fleet.search_sql import FleetFilter, logs_statement, records_statement, regex_of

# Report the interventions in the safety settings of many robots, from the index, as `rosrv report interventions`.
#
# Each robot is one history: the logs of both appliances of a pair, and earlier logs, by time. A record that the
# collector has twice counts once: retention by size writes it again, and a log that was restored from a copy is sent
# again.

_LIVE = "not known to the collector: make the report of one robot on its machine"
_PAGE = 2000
_SECOND = 1_000_000_000


class CollectedLog(NamedTuple):
    """A log in the index: its last and first record, and the times of both (nanoseconds since the epoch)."""

    robot: str
    log: str
    last: int
    begins: int | None
    first: int = 1
    ends: int | None = None


def fleet_report(
    database: IndexDatabase,
    robot: str | None,
    since: int | None,
    until: int,
    *,
    waiting: int,
    version: str,
    heard: Mapping[str, float] | None = None,
) -> MachineReport:
    """Return the report of the robots whose names match. `waiting` is the number of segments that are not indexed yet.

    `heard` has the time (seconds since the epoch) up to which each robot has pushed its records; 0: up to the last one
    in the index.

    Raise `FilterError`, `SearchTooLongError` or `IndexDownError`.
    """
    try:
        with database.reading() as connection:
            logs = [CollectedLog(*row) for row in connection.execute(*logs_statement(robot))]
            found = report_of(logs, _rows(connection, robot), since, until, waiting=waiting, version=version)
            found.gaps.extend(_missing(logs, heard or {}, until))
            if not is_complete(connection):
                found.gaps.append(Gap(time_utc=rfc3339(until), event="not indexed", reason=INCOMPLETE))
            return found
    except psycopg.errors.QueryCanceled as error:
        raise SearchTooLongError("the report took too long: give --robot, for fewer robots") from error
    except (psycopg.OperationalError, PoolTimeout, psycopg.errors.UndefinedTable) as error:
        raise IndexDownError("the index cannot be read now: try again; segments are still stored") from error


def _missing(logs: Iterable[CollectedLog], heard: Mapping[str, float], until: int) -> Iterator[Gap]:
    """Yield what the index lacks: records before the first ones of a log, and those after the last that arrived."""
    ends: dict[str, int] = {}
    for log in logs:
        ends[log.robot] = max(ends.get(log.robot, 0), log.ends or 0)
        if log.first > 1:
            yield Gap(
                time_utc=rfc3339(log.begins or until), event="not in the index", appliance=log.robot,
                reason=f"the records before {log.first} of log {log.log}: a state that began there is not shown",
            )  # fmt: skip
    for robot, at in heard.items():
        last = at or ends.get(robot, 0) / _SECOND
        if robot not in ends:
            yield Gap(
                time_utc=rfc3339(until),
                event="not in the index",
                appliance=robot,
                reason="all records of this robot",
            )
        elif last < until / _SECOND:
            reason = "later records did not arrive: a state may have begun or ended since"
            time = rfc3339(round(last * _SECOND))
            yield Gap(time_utc=time, event="not collected since", appliance=robot, reason=reason)


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
    for _robot, log, *columns in rows:
        logs.setdefault(log, []).append(stored_entry(StoredColumns._make(columns)))
    return (NamedEntry(robot, entry) for _log, entry in merge(logs))


def _reported(logs: Iterable[CollectedLog]) -> list[ReportedLog]:
    return [
        ReportedLog(
            name=log.robot, id=log.log, begins_utc="" if log.begins is None else rfc3339(log.begins), last=log.last,
            verification=None,
        )
        for log in logs
    ]  # fmt: skip


report_app = typer.Typer(no_args_is_help=True, help="Print the robots' logbooks.")
_REPORT_SECONDS = 600.0


@report_app.callback()
def report() -> None:
    """Print the robots' logbooks."""


def search(
    context: typer.Context,
    robot: Annotated[str | None, typer.Option("--robot", help="Name of the robot; a glob")] = None,
    limit: Annotated[
        int,
        typer.Option("--limit", min=1, max=LARGEST_FLEET_PAGE, metavar="N", help="Largest number of records"),
    ] = 100,
    cursor: Annotated[
        str | None, typer.Option("--cursor", metavar="CURSOR", help="Continue where a search ended")
    ] = None,
    config: Config = DEFAULT_CONFIG,
    *,
    as_json: Json = False,
) -> None:
    """Find records of all robots, newest first.

    Example: rosrv-fleet search --deny --since 1h --topic '/cmd_*' --robot 'arm*'
    """
    wanted = FILTER.value(context.params)
    collector = make_collector(load_config(config))
    waiting = collector.store.waiting()
    database = collector.searches.database
    database.open()
    try:
        page = search_fleet(database, FleetFilter(robot, wanted), cursor, limit, waiting)
    finally:
        database.close()
    for record in page.records:
        typer.echo(json.dumps(record, separators=(",", ":")) if as_json else _line(record))
    if page.waiting:
        note(f"{page.waiting} stored segments are not indexed yet: this search misses them")
    if not page.complete:
        note(INCOMPLETE)
    if page.cursor is not None:
        note(f"more records match: --cursor {page.cursor}, or a larger --limit")


def _line(record: dict[str, Any]) -> str:
    names = ("robot", "time", "severity", "decision", "event", "host", "caller_id", "resource", "reason")
    shown = record | {"time": in_local_zone(record["time"])}
    return "  ".join(printable(str(shown[name])) for name in names if shown.get(name))


@report_app.command("interventions")
def report_interventions(
    robot: Annotated[str | None, typer.Option("--robot", help="Name of the robot; a glob")] = None,
    since: Since = None,
    until: Until = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FILE", help="Write one HTML page without scripts; must not exist"
        ),
    ] = None,
    config: Config = DEFAULT_CONFIG,
    *,
    as_json: Json = False,
) -> None:
    """Report who changed which safety setting of the robots, from what to what, as `rosrv report interventions` does.

    A robot and its standby are one machine. The index has a record up to a minute after its robot wrote it.

    Example: rosrv-fleet report interventions --since 2026-03-01 --robot 'arm*' --output march.html
    """
    now = clock.wall_ns()
    begin = None if since is None else parse_timestamp(since, now)
    report = _report(config, robot, begin, now if until is None else parse_timestamp(until, now))
    if output is not None:
        with output.open("x", encoding="utf-8") as file:
            file.write(page(report))
        note(f"written to {output}")
    if as_json:
        typer.echo(msgspec.json.encode(report).decode())
    elif output is None:
        for line in report_lines(report):
            typer.echo(printable(line))


def who_drove(
    at: Annotated[str, typer.Option("--at", metavar="TIME", help="At this time: 5m (ago), 14:03, a date")],
    robot: Annotated[str | None, typer.Option("--robot", help="Name of the robot; a glob")] = None,
    config: Config = DEFAULT_CONFIG,
    *,
    as_json: Json = False,
) -> None:
    """List the hosts that held a group of [Authority] of each robot at a time. Exit status 1 if no host did.

    Example: rosrv-fleet who-drove --at 14:03 --robot arm7
    """
    moment = parse_timestamp(at, clock.wall_ns())
    report = _report(config, robot, moment, moment + 1)
    for gap in report.gaps:
        note(printable(f"{gap.appliance}  {gap.event} {gap.time_utc}: {gap.reason}".strip()))
    for row in report.drivers:
        if as_json:
            typer.echo(msgspec.json.encode(row).decode())
            continue
        until = (
            f"until {row.until_utc} ({row.ended_by})"
            if row.until_utc
            else "and still in the last collected record"
        )
        host = host_words(row.state, row.names)
        typer.echo(
            printable(f"{row.appliance}  {row.what}: {host} since {row.since_utc}, {until}: {row.reason}")
        )
    if not report.drivers:
        note("the index has no record that a host held a group then")
    raise typer.Exit(0 if report.drivers else 1)


def _heard(collector: Collector, robot: Robot, until: int) -> float:
    """Return up to when all appliances of a robot have pushed; infinity if that is `until`, but for a usual silence."""
    signs = [collector.presence.last(robot.name, name) for name in robot.connecting]
    running = [0.0 if sign is None else sign.at for sign in signs if sign is None or not sign.off]
    last = min(running, default=0.0 if robot.removed is not None else math.inf)
    return math.inf if last + collector.config.silent_seconds >= until / _SECOND else last


def _report(config: Path, robot: str | None, since: int | None, until: int) -> MachineReport:
    collector = make_collector(load_config(config))
    database = IndexDatabase(collector.config.database, connections=1, statement_seconds=_REPORT_SECONDS)
    database.open()
    try:
        waiting = collector.store.waiting()
        matching = re.compile(regex_of(robot or "*"))
        heard = {
            one.name: _heard(collector, one, until)
            for one in collector.robots.known().values()
            if matching.search(one.name)
        }
        return fleet_report(database, robot, since, until, waiting=waiting, version=__version__, heard=heard)
    finally:
        database.close()
