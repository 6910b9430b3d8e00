"""Describe a guard's state for a person."""

from datetime import UTC, datetime

from appliance.base.counted import counted
from appliance.cli.output import moment
from appliance.features.guards.guard_answers import GuardRow, GuardTimes


def origin_in_words(row: GuardRow) -> str:
    match row.origin:
        case "older":
            return f"{row.preset} {row.version}, older: rosrv guard upgrade {row.name};"
        case "changed":
            return f"{row.preset} {row.version}, changed: not the text of the preset;"
    return row.preset


def state_in_words(row: GuardRow) -> str:
    if row.error:
        held = "holds its topics" if row.state == "holding" else "does nothing"
        return f"{held}, because its file has an error: {row.error}: rosrv monitor load {row.file}"
    acts = counted(row.stops, "stop")
    match row.state:
        case "holding":
            return f"holds its topics: rosrv monitor resume {row.name}"
        case "shadow":
            return f"in shadow mode, {acts} only recorded"
        case "off":
            return f"disabled: rosrv monitor enable {row.name}"
    if row.awaits:
        resume = f"rosrv monitor resume {row.name}"
        return f"in force, stops until it hears {row.awaits}; if that has another name now: {resume}"
    end = (
        ""
        if row.confirm_by is None
        else f", until {moment(row.confirm_by)} unless you run: rosrv monitor confirm"
    )
    return f"in force, {row.state}{'' if row.preset == 'withhold' else f', {acts}'}{_last_stop(row)}{end}"


def afresh_in_words(row: GuardRow) -> str:
    """Return how the guard would begin with a new state directory, if not as it is, with the remedy."""
    name = row.name
    if row.confirm_by is not None or row.off_until is not None:
        return ""  # it ends automatically
    now = row.state if row.state in ("shadow", "off") else "on"
    if row.afresh == now:
        return ""
    switch = {"on": f"enable {name}", "shadow": f"enable {name} --shadow", "off": f"disable {name}"}[now]
    command = f"monitor {switch}"
    write = f"rosrv {command}, on the appliance's machine, writes it there"
    if row.afresh == "absent":
        return f"it is only in the state directory, not in the folder of specifications: {write}"
    then = {"on": "in force", "shadow": "in shadow mode", "off": "disabled"}[row.afresh]
    return f"its state is not in {row.file}, so with a new state directory it would be {then}: {write}"


def times_in_words(times: GuardTimes) -> str:
    """Say how late a guard has been, with what was measured, and since when."""
    since = datetime.fromtimestamp(times.since, UTC)
    span = f"{times.seconds / 3600:.1f} h" if times.seconds >= 3600 else f"{times.seconds / 60:.0f} min"
    span = span if times.seconds >= 60 else f"{times.seconds:.0f} s"
    return (
        f"in {span} in force since {since:%Y-%m-%d %H:%MZ}, {times.late:,} of {times.timed:,} ticks and messages came"
        f" more than {times.limit * 1e3:g} ms late, the latest {times.latest * 1e3:.1f} ms"
    )


def _last_stop(row: GuardRow) -> str:
    stop = row.last_stop
    if stop is None:
        return ""
    when = f"since {moment(stop.since)}" if stop.until is None else f"last until {moment(stop.until)}"
    node, host = stop.node or stop.publisher_node, stop.host or stop.publisher_host
    who = f" ({node} on {host})" if node else ""
    return f", {when}{f': {stop.cause}' if stop.cause else ''}{who}"
