"""Read interventions, gaps and their origins from the audit logs of an appliance, or of a pair."""

import itertools
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from appliance.audit.log.record_format import LogEntry
from appliance.audit.search.search import LogSnapshot
from appliance.base.actors import DISK, OPERATOR, UNCONFIRMED
from appliance.cli.connection.audit_file import FileLog
from appliance.cli.connection.audit_over_rest import RestLog, RestSnapshot
from appliance.cli.output import usage_error
from appliance.formats.interventions import Intervention
from appliance.formats.machine_report import NamedEntry, merge

_ORIGIN_SECONDS = 60
_ORIGIN_RECORDS = 50
_LOCAL = {"", OPERATOR, DISK, UNCONFIRMED}
_READS = ("GET", "HEAD")

Log = FileLog | RestLog
Other = Annotated[
    Path | None,
    typer.Option(
        "--other",
        metavar="DIR",
        help="Also report from the log of the other appliance of a pair: its state directory, or a copy",
    ),
]


def logs_of(own: Log, other: Path | None, verb: str) -> dict[str, Log]:
    """Return the log, or both logs of a pair by the names of their appliances. Exits with 2 for a wrong `--other`."""
    if other is None:
        return {"": own}
    if isinstance(own, RestLog):
        raise usage_error(
            "--other needs the logs' files: give --state, on any machine with copies of both", verb=verb
        )
    if not (other / "control").is_dir():
        raise usage_error(
            f"{other} is not a state directory: give the other appliance's with --other", verb=verb
        )
    partner = FileLog(other)
    if own.present() == partner.present():
        raise usage_error(f"{other}: the same log as that of --state; give the other appliance's", verb=verb)
    logs: dict[str, Log] = {_name_in(own) or "this appliance": own}
    logs[_name_in(partner) or "the other appliance"] = partner
    return logs


def _name_in(log: FileLog) -> str:
    """Return the name of the appliance that wrote a log, or an empty string if it never took over."""
    with closing(log.snapshot()) as snapshot:
        taken = next(snapshot.of_events(("took over", "handed over")), None)
    return "" if taken is None else str(taken.record.detail.get("appliance", ""))


class OpenedLogs(ExitStack):
    """The logs as they are now, each by the name of its appliance."""

    def __init__(self, logs: Mapping[str, Log]) -> None:
        super().__init__()
        self._logs: dict[str, LogSnapshot | RestSnapshot] = {}
        for name, log in logs.items():
            self._logs[name] = snapshot = log.snapshot()
            self.callback(snapshot.close)

    def of_events(self, events: Collection[str]) -> Iterator[NamedEntry]:
        return merge({name: log.of_events(events) for name, log in self._logs.items()})

    def with_origin(self, row: Intervention) -> Intervention:
        """Return the row with the address of its REST call, if the log leaves no doubt."""
        if row.who in _LOCAL:
            return row
        calls = self._logs[row.appliance].following("rest call", row.sequence)
        return msgspec.structs.replace(row, origin=origin_of(row, itertools.islice(calls, _ORIGIN_RECORDS)))


def origin_of(row: Intervention, calls: Iterable[LogEntry]) -> str:
    """Return the address of the call that made a change: it was answered after the change.

    If its author's changes in that time came from several addresses, it may be any of them, and none is returned.
    """
    hosts = set()
    for entry in calls:
        if entry.record.time - row.time > _ORIGIN_SECONDS * 1_000_000_000:
            break
        detail = entry.record.detail
        if (
            entry.record.time >= row.time
            and detail.get("who") == row.who
            and detail.get("method") not in _READS
        ):
            hosts.add(entry.record.host or "")
    return hosts.pop() if len(hosts) == 1 else ""
