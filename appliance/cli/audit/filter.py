"""Define the filter options of `rosrv audit search`, `tail` and `export`."""

import functools
import inspect
import time
from collections.abc import Callable
from typing import Annotated, Concatenate, ParamSpec

import typer

from appliance.api.unrecorded import unrecorded
from appliance.audit.query import Filter
from appliance.audit.record import Severity
from appliance.audit.record_format import printable
from appliance.base.timestamps import TimestampError, parse_timestamp
from appliance.cli.audit.audit_errors import Errors, note
from appliance.cli.connection.target import Appliance
from appliance.cli.durations import Since, Until

_P = ParamSpec("_P")


def _filter(
    *,
    deny: Annotated[
        bool, typer.Option("--deny", help="Only denied requests (and summaries of denials)")
    ] = False,
    allow: Annotated[bool, typer.Option("--allow", help="Only allowed requests")] = False,
    would_deny: Annotated[
        bool, typer.Option("--would-deny", help="Only requests that an audit-only policy would have denied")
    ] = False,
    since: Since = None,
    until: Until = None,
    topic: Annotated[
        str | None,
        typer.Option(
            "--topic", "--resource", help="Topic, service, parameter or call; a glob such as '/cmd_*'"
        ),
    ] = None,
    host: Annotated[str | None, typer.Option("--host", help="Address of the peer; a glob")] = None,
    caller: Annotated[str | None, typer.Option("--caller", help="Name that the node gave; a glob")] = None,
    event: Annotated[str | None, typer.Option("--event", help="Name of the event; a glob")] = None,
    category: Annotated[
        str | None, typer.Option("--category", help="Category of the request; a glob")
    ] = None,
    severity: Annotated[
        Severity | None, typer.Option("--severity", help="This severity or a higher one")
    ] = None,
    rule: Annotated[
        str | None, typer.Option("--rule", help="Section or key of the policy rule; a glob")
    ] = None,
    text: Annotated[
        str | None, typer.Option("--text", help="Text anywhere in names, reason and details")
    ] = None,
    who: Annotated[
        str | None,
        typer.Option("--who", help="Author: the name of a token, operator, or disk; a glob"),
    ] = None,
) -> Filter:
    wanted = {"deny": deny, "allow": allow, "would deny": would_deny}
    begin, end = times_given(since, until)
    found = Filter(
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
    for warning in unrecorded(found):
        note(printable(warning))
    return found


def times_given(since: str | None, until: str | None) -> tuple[int | None, int | None]:
    """Return the times of --since and --until. Raises `TimestampError`."""
    now = time.time_ns()
    begin = None if since is None else parse_timestamp(since, now)
    end = None if until is None else parse_timestamp(until, now)
    if begin is not None and end is not None and begin > end:
        raise TimestampError(f"--since {since} is later than --until {until}")
    return begin, end


def filtered(
    verb: Callable[Concatenate[Appliance, Filter, _P], None],
) -> Callable[Concatenate[Appliance, _P], None]:
    """Replace a verb's second parameter, a `Filter`, by the filter options."""
    options = inspect.signature(
        _filter
    ).parameters  # typer reads the options of a verb from its signature only

    @functools.wraps(verb)
    def asked(appliance: Appliance, *args: _P.args, **kwargs: _P.kwargs) -> None:
        with Errors():
            given = {name: kwargs.pop(name) for name in options}
            verb(appliance, _filter(**given), *args, **kwargs)  # type: ignore[arg-type]  # as the options say

    own = inspect.signature(verb, eval_str=True)
    first, _wanted, *rest = own.parameters.values()
    asked.__signature__ = own.replace(parameters=[first, *options.values(), *rest])  # type: ignore[attr-defined]  # what `speaks` reads
    return asked  # type: ignore[return-value]  # mypy gives the appliance a name that it is not called by
