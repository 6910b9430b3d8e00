"""Define the words of a search: the options of `rosrv audit search`, and the parameters of the collector's REST."""

from typing import Annotated, Any

import typer

from appliance.audit.log.record import Severity
from appliance.audit.log.record_format import rfc3339
from appliance.audit.search.query import Filter
from appliance.base import clock
from appliance.base.option_group import GroupedCommand, OptionGroup
from appliance.base.timestamps import TimestampError, parse_timestamp

Since = Annotated[
    str | None,
    typer.Option("--since", metavar="TIME", help="From this time: 1h (ago), 14:03, a date, or RFC 3339"),
]
Until = Annotated[str | None, typer.Option("--until", metavar="TIME", help="Before this time")]


def filter_given(
    *,
    deny: Annotated[
        bool, typer.Option("--deny", help="Only denied requests (and summaries of denials)")
    ] = False,
    allow: Annotated[bool, typer.Option("--allow", help="Only allowed requests")] = False,
    would_deny: Annotated[
        bool, typer.Option("--would-deny", help="Only requests that an audit-only policy would have denied")
    ] = False,
    ask: Annotated[
        bool, typer.Option("--ask", help="Only requests that waited for an operator's approval")
    ] = False,
    since: Since = None,
    until: Until = None,
    topic: Annotated[
        str | None,
        typer.Option(
            "--topic",
            "--resource",
            help="Topic, service, node or call; a glob such as '/cmd_*' (--text finds the parameter of a call)",
        ),
    ] = None,
    host: Annotated[
        str | None,
        typer.Option(
            "--host",
            help="Address, network or glob of the peer; with a running appliance also a host's name",
        ),
    ] = None,
    caller: Annotated[
        str | None, typer.Option("--caller", help="Name of the calling node, as it gave it; a glob")
    ] = None,
    event: Annotated[str | None, typer.Option("--event", help="Name of the event; a glob")] = None,
    category: Annotated[
        str | None, typer.Option("--category", help="Category of the request; a glob")
    ] = None,
    severity: Annotated[
        Severity | None,
        typer.Option(
            "--severity",
            metavar="SEVERITY",
            help="This severity or a higher one: debug, info, notice, warning or alarm",
        ),
    ] = None,
    rule: Annotated[
        str | None, typer.Option("--rule", help="Section or key of the policy rule; a glob")
    ] = None,
    text: Annotated[
        str | None, typer.Option("--text", help="Text anywhere in names, reason and details")
    ] = None,
    who: Annotated[
        str | None,
        typer.Option(
            "--who",
            help="Author: the name of a token or person, `operator` (on the appliance's machine), `disk` (a file that"
            " was read at a start), or a glob",
        ),
    ] = None,
) -> Filter:
    """Return the filter that the options define. Raises `TimestampError`."""
    wanted = {"deny": deny, "allow": allow, "would deny": would_deny, "ask": ask}
    begin, end = times_given(since, until)
    return Filter(
        decision=tuple(name for name, asked in wanted.items() if asked),
        since=begin,
        until=end,
        host=host,
        caller_id=caller,
        resource=topic,
        category=category,
        event=event,
        severity=severity,
        rule=rule,
        text=text,
        who=who,
    )


def times_given(since: str | None, until: str | None) -> tuple[int | None, int | None]:
    """Return both times in nanoseconds since the epoch; without a zone, they are in the machine's.

    Raises `TimestampError`.
    """
    now = clock.wall_ns()
    begin, end = _time("--since", since, now), _time("--until", until, now)
    if begin is not None and end is not None and begin > end:
        raise TimestampError(f"--since {since} is later than --until {until}")
    return begin, end


def _time(option: str, text: str | None, now: int) -> int | None:
    try:
        return None if text is None else parse_timestamp(text, now, None)
    except TimestampError as error:
        raise TimestampError(f"{option}: {error}") from None


def in_utc(since: str | None) -> str | None:
    """Return a time of a request over REST with its zone: without one, it is UTC. Raises `TimestampError`."""
    return None if since is None else rfc3339(parse_timestamp(since, clock.wall_ns()))


FILTER = OptionGroup(filter_given)


class FilteredCommand(GroupedCommand):
    """A command whose help lists the filter options before its own; `FILTER` makes a filter from them."""

    def __init__(self, name: str | None = None, **settings: Any) -> None:
        super().__init__(name, before=FILTER.options, **settings)
