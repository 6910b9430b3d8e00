"""Read interventions, gaps and their origins from the audit logs of an appliance, or of a pair."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from appliance.audit.log.record_format import LogEntry
from appliance.audit.search.query import Filter
from appliance.base.actors import DISK, OPERATOR, UNCONFIRMED
from appliance.cli.connection.audit_file import FileLog
from appliance.cli.connection.audit_over_rest import RestLog
from appliance.cli.output import usage_error
from appliance.features.logbook.interventions import Intervention

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
        help="State directory, or a copy, of the other appliance of a pair: of both logs",
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
    if not other.is_dir():
        raise usage_error(
            f"{other}: no such directory; give the other appliance's state directory", verb=verb
        )
    partner = FileLog(other)
    if own.present() == partner.present():
        raise usage_error(f"{other}: the same log as that of --state; give the other appliance's", verb=verb)
    found: dict[str, Log] = {_name_in(own) or "this appliance": own}
    found[_name_in(partner) or "the other appliance"] = partner
    return found


def _name_in(log: FileLog) -> str:
    """Return the name of the appliance that wrote a log, or an empty string if it never took over."""
    taken = next(iter(log.of_events(("took over", "handed over"))), None)
    return "" if taken is None else str(taken.record.detail.get("appliance", ""))


def with_origin(log: Log, row: Intervention) -> Intervention:
    """Return the row with the address of its REST call, if the log leaves no doubt."""
    if row.who in _LOCAL:
        return row
    calls = log.search(Filter(event="rest call"), str(row.sequence), _ORIGIN_RECORDS, newest_first=False)
    return msgspec.structs.replace(row, origin=origin_of(row, calls.entries))


def origin_of(row: Intervention, calls: Iterable[LogEntry]) -> str:
    """Return the address of the call that made a change: it was answered after the change.

    If its author's changes in that time came from several addresses, it may be any of them, and none is returned.
    """
    hosts = {
        entry.record.host or ""
        for entry in calls
        if 0 <= entry.record.time - row.time <= _ORIGIN_SECONDS * 1_000_000_000
        and entry.record.detail.get("who") == row.who
        and entry.record.detail.get("method") not in _READS
    }
    return hosts.pop() if len(hosts) == 1 else ""
