"""The command `rosrv who-drove`."""

from typing import Annotated

import msgspec
import typer

from appliance.audit.log.record_format import rfc3339
from appliance.base.timestamps import in_local_zone
from appliance.cli.audit.audit_errors import Errors
from appliance.cli.connection.audit_source import audit_of
from appliance.cli.connection.target import Appliance, speaks_with
from appliance.cli.durations import time_given
from appliance.cli.output import say_json, usage_error
from appliance.features.logbook.log_source import OpenedLogs, Other, logs_of
from appliance.formats.machine_report import ENDS_OF_DRIVING, Period, read_records
from appliance.formats.report_words import host_words
from rosmop.tool.terminal import say

_VERB = "rosrv who-drove"
_EVENTS = ("authority handed over", "host enrolled", "host awaited", "door added", *ENDS_OF_DRIVING)


@speaks_with("One JSON object for each time that a host held a group")
def who_drove(
    appliance: Appliance,
    *,
    at: Annotated[
        str | None, typer.Option("--at", help="At this time: 1h (ago), 14:03, a date, or RFC 3339")
    ] = None,
    between: Annotated[
        tuple[str, str] | None,
        typer.Option("--between", metavar="TIME TIME", help="From the first to the second time"),
    ] = None,
    other: Other = None,
) -> None:
    """List the hosts that held a command group, since when, and by whose order.

    Give --at or --between. Without a group in [Authority] of the policy, the log does not say who drove: every host
    that may publish may drive. Exit status 1 if no host held a group then.

    Example: rosrv who-drove --at 14:03
    """
    with Errors():
        if (at is None) == (between is None):
            raise usage_error("give --at TIME or --between TIME TIME", verb=_VERB)
        option, (first, last) = ("--between", between) if between else ("--at", (at or "", at or ""))
        begin, end = (time_given(option, text, _VERB) for text in (first, last))
        if begin > end:
            raise usage_error(f"--between: {first} is after {last}: give the earlier time first", verb=_VERB)
        logs = logs_of(audit_of(appliance.way), other, _VERB)
        with OpenedLogs(logs) as opened:
            read = read_records(opened.of_events(_EVENTS), Period(begin, end + 1))
        # A span that ends at that very moment does not include it.
        rows = [row for row in read.drivers if row.until_utc != rfc3339(begin)]
    for row in rows:
        if appliance.as_json:
            say_json(msgspec.to_builtins(row))
            continue
        until = f"until {row.until_utc} ({row.ended_by})" if row.until_utc else "and holds it now"
        order = f" by {row.by}" if row.by else ""
        place = f" at {row.appliance}" if row.appliance else ""
        host = host_words(row.state, row.names, appliance.host_in_words)
        say(in_local_zone(f"{row.what}: {host} since {row.since_utc}{place}{order}, {until}: {row.reason}"))
    if not rows and not appliance.as_json:
        say("the log has no record that a host held a group then", "yellow")
    raise typer.Exit(0 if rows else 1)
