"""`rosrv audit summary`: the denials by host."""

from collections.abc import Iterator
from typing import Annotated

import typer

from appliance.audit.log.record_format import printable
from appliance.audit.search.denial_summary import LARGEST_SUMMARY, DenialSummary, HostDenials
from appliance.audit.search.filter_options import Since, Until, times_given
from appliance.audit.search.query import Filter
from appliance.base.counted import counted
from appliance.base.timestamps import local_text, parse_date
from appliance.cli.audit.audit_errors import Errors
from appliance.cli.audit.verification_text import write
from appliance.cli.connection.audit_source import audit_of
from appliance.cli.connection.target import Appliance, speaks_with
from appliance.cli.output import say_json
from appliance.policy.host_names import HostInWords

_LONGEST_REASON = 160


@speaks_with("One JSON object")
def summarise(
    appliance: Appliance,
    since: Since = None,
    until: Until = None,
    *,
    limit: Annotated[
        int, typer.Option("--limit", min=1, max=LARGEST_SUMMARY, help="Largest number of hosts")
    ] = 20,
) -> None:
    """Show the denials of each host: number, first and last time, callers, the three most frequent rules or reasons.

    The host with the most denials comes first. Its reasons begin with decisions about calls; all others, such as
    malformed data, follow. Repetitions that the log only counts are included with their number.

    Example: rosrv audit summary --since 1h
    """
    with Errors():
        begin, end = times_given(since, until)
        summary = audit_of(appliance.way).denials(Filter(since=begin, until=end), limit)
        if appliance.as_json:
            say_json(summary)
            return
        for line in _lines(summary, appliance.host_in_words):
            write(printable(line))


def _lines(summary: DenialSummary, host_in_words: HostInWords) -> Iterator[str]:
    if not summary.hosts:
        yield "no denials"
    hosts = [host_in_words(row.host) for row in summary.hosts]
    width = max(map(len, hosts), default=0)
    for host, row in zip(hosts, summary.hosts, strict=True):
        yield f"{host:<{width}}  {counted(row.count, 'denial')}, {_span(row)}{_callers(row)}"
        for reason in row.reasons:
            yield f"{reason.count:>8}  {_cut(reason.name)}"
        if row.more_reasons:
            yield f"{'':>8}  and {counted(row.more_reasons, 'other reason')}"
    if summary.more_hosts:
        yield (
            f"and {counted(summary.more_hosts, 'more host')} with {counted(summary.more_denials, 'denial')}: --limit"
            f" {min(LARGEST_SUMMARY, len(summary.hosts) + summary.more_hosts)}"
        )
    if summary.counted_since is not None:
        earlier = local_text(parse_date(summary.counted_since), digits=0)
        yield f"earlier records were not counted, as there are too many: --until {earlier}"


def _span(row: HostDenials) -> str:
    first, last = _second(row.first), _second(row.last)
    return first if first == last else f"{first} to {last}"


def _second(time: str) -> str:
    return local_text(parse_date(time), digits=0).replace("T", " ")


def _callers(row: HostDenials) -> str:
    if not row.callers:
        return ""
    more = f" and {row.more_callers} more" if row.more_callers else ""
    return f", by {', '.join(caller.name for caller in row.callers)}{more}"


def _cut(reason: str) -> str:
    return reason if len(reason) <= _LONGEST_REASON else f"{reason[:_LONGEST_REASON]}…"
