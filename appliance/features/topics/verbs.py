"""The commands `rosrv topic echo|info|publishers`; the last also answers for a time in the past."""

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any

import typer

from appliance.api.front.moments import in_full
from appliance.audit.log.record_format import LogEntry, rfc3339
from appliance.audit.search.query import Filter
from appliance.base import clock
from appliance.base.timestamps import in_local_zone, local_text
from appliance.base.validation_messages import meant
from appliance.channel import admin
from appliance.channel.answers.graph_answers import Topic
from appliance.cli import completion
from appliance.cli.audit.audit_errors import Errors
from appliance.cli.connection.audit_source import audit_of
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.durations import bounded_span, time_given
from appliance.cli.message_lines import lines_of
from appliance.cli.output import say_json, usage_error
from appliance.features.topics.requests import TopicLook, TopicMessage
from rosmop.tool.terminal import printable, refusal, say
from roswire.errors import InvalidNameError
from roswire.message_view import CUT
from roswire.names import resolve

# Compute the publishers of a topic at a time in the past, from the records of registrations. No I/O.

_NODES = ("node lost", "node returned", "replaced", "takeover")
_REGISTRATIONS = ("registered", "unregistered")
_RUNS = ("appliance started", "appliance stopped")
_COUNTED = "repetitions folded"


@dataclass(frozen=True, slots=True)
class PastPublisher:
    node: str
    host: str
    since: int | None
    """Nanoseconds since the epoch; None if the log has only the end of the registration."""
    sequence: int | None
    """The record of the registration, or of the node's return."""


@dataclass(frozen=True, slots=True)
class PastPublishers:
    """The publishers by name, with sentences on gaps of the log."""

    publishers: tuple[PastPublisher, ...]
    unknown: tuple[str, ...]


def publishers_at(
    export: Callable[[Filter], Iterable[LogEntry]], first: LogEntry | None, topic: str, at: int
) -> PastPublishers:
    """Return the publishers of a topic at a time (ns since the epoch). `first` is the first record of the log."""
    registrations = (Filter(event=event, category="publication", resource=topic) for event in _REGISTRATIONS)
    others = (Filter(event=event, until=at + 1) for event in _NODES)
    gaps = (Filter(event=event) for event in (*_RUNS, "records lost", _COUNTED))
    entries = [entry for wanted in (*registrations, *others, *gaps) for entry in export(wanted)]
    entries.sort(key=lambda entry: entry.sequence)
    past = [entry for entry in entries if entry.record.time <= at]
    known = _registrations(past)
    seen = {
        (entry.record.host, entry.record.caller_id) for entry in past if entry.record.event == "registered"
    }
    reaches = first is not None and first.record.time <= at
    ended = _ended_later((entry for entry in entries if entry.record.time > at), seen) if reaches else ()
    found = sorted([*known, *ended], key=lambda one: (one.node, one.host))
    unknown = [*_unknown(past, first, at), *_runs(entries, first, at)]
    if any(_counts(entry, topic, at) for entry in entries):
        unknown.append(
            "registrations before this time were only counted: rosrv audit search --event 'repetitions folded'"
        )
    return PastPublishers(tuple(found), tuple(unknown))


def _registrations(past: Iterable[LogEntry]) -> list[PastPublisher]:
    holders: dict[str, PastPublisher] = {}
    lost: dict[str, PastPublisher] = {}
    for sequence, record in past:
        name, host = record.caller_id or "", record.host or ""
        match record.event:
            case "registered":
                holders[name] = PastPublisher(name, host, record.time, sequence)
                lost.pop(name, None)
            case "unregistered":
                for nodes in (holders, lost):
                    if name in nodes and nodes[name].host == host:
                        del nodes[name]
            case "replaced" | "takeover":
                holders.pop(name, None)
                lost.pop(name, None)
            case "node lost" if name in holders and holders[name].host == host:
                lost[name] = holders.pop(name)
            case "node returned" if name in lost and lost[name].host == host:
                holders[name] = replace(lost.pop(name), since=record.time, sequence=sequence)
    return list(holders.values())


def _ended_later(
    later: Iterable[LogEntry], seen: set[tuple[str | None, str | None]]
) -> Iterator[PastPublisher]:
    for entry in later:
        if entry.record.event == "records lost":
            return
        if entry.record.event in _REGISTRATIONS:
            key = entry.record.host, entry.record.caller_id
            if key not in seen and entry.record.event == "unregistered":
                yield PastPublisher(key[1] or "", key[0] or "", None, None)
            seen.add(key)


def _counts(entry: LogEntry, topic: str, at: int) -> bool:
    detail, resource = entry.record.detail, entry.record.resource
    return (
        entry.record.event == _COUNTED
        and detail.get("of") in (*_REGISTRATIONS, *_NODES)
        and detail.get("first_time", 0) <= at
        and (resource is None or (resource == topic and entry.record.category == "publication"))
    )


def _unknown(past: list[LogEntry], first: LogEntry | None, at: int) -> Iterator[str]:
    if first is None or at < first.record.time:
        begins = "the log is empty" if first is None else f"the log begins at {rfc3339(first.record.time)}"
        yield f"{begins}: earlier registrations are missing"
    elif first.record.event != "log begun":
        yield (
            f"records before {rfc3339(first.record.time)} were removed: nodes that registered earlier, and have not"
            " unregistered since, are missing"
        )
    elif first.record.detail.get("earlier_log_missing"):
        yield f"an earlier log is missing, with the registrations before {rfc3339(first.record.time)}"
    if any(entry.record.event == "records lost" for entry in past):
        yield "records were lost before this time: rosrv audit search --event 'records lost'"


def _runs(entries: list[LogEntry], first: LogEntry | None, at: int) -> Iterator[str]:
    if first is None or at < first.record.time:
        return
    runs = [entry.record for entry in entries if entry.record.event in _RUNS]
    before = [run for run in runs if run.time <= at]
    after = [run for run in runs if run.time > at]
    if before and before[-1].event == "appliance stopped":
        yield f"the appliance was stopped at {rfc3339(before[-1].time)}: these were registered then"
    elif after and after[0].event == "appliance started" and (before or first.record.event != "log begun"):
        # Power that is cut leaves no record.
        yield (
            f"the appliance ended without a record before its start at {rfc3339(after[0].time)}: it may have been off"
            " at this time"
        )


_AT_ONCE = 20  # messages in one request


def _resolve_name(topic: str) -> str:
    """Resolve a name like the stock tools: `odom` is /odom."""
    try:
        return resolve(topic, "")
    except InvalidNameError as error:
        raise usage_error(f"{error}; write it like /cmd_vel", "rosrv topic") from None


_Topic = Annotated[
    str,
    typer.Argument(
        metavar="TOPIC",
        help="Its name, such as /cmd_vel",
        show_default=False,
        autocompletion=completion.topics,
        callback=_resolve_name,
    ),
]


@speaks
def echo(
    appliance: Appliance,
    topic: _Topic,
    *,
    count: Annotated[
        int, typer.Option("-n", "--count", min=1, max=100_000, help="How many messages to wait for")
    ] = 1,
    within: Annotated[str, typer.Option(help="The longest wait for each message, 0.1s to 10s")] = "5s",
    field: Annotated[
        str | None, typer.Option(metavar="NAME", help="Only this field, such as pose.position.x or ranges.3")
    ] = None,
) -> None:
    """Show the next messages of a topic as subscribers receive them, after the monitors.

    The audit log records the request. Long strings and arrays are cut, bytes are hexadecimal.
    Exit status 1 if no message came in time.

    Example: rosrv topic echo /odom -n 3 --field pose.pose.position
    """
    seconds = bounded_span("--within", within, "0.1s", "10s", "rosrv topic")
    shown = 0
    while shown < count:
        request = TopicLook(topic, min(count - shown, _AT_ONCE), seconds, latched=not shown)
        body = appliance.ask_or_exit(request)
        for message in body.messages:
            _show(message, field, as_json=appliance.as_json)
        shown += len(body.messages)
        if not body.messages:
            raise refusal([f"rosrv topic: no message of {topic} in {seconds:g} s"])


@speaks
def info(appliance: Appliance, topic: _Topic) -> None:
    """Show the publishers, subscribers and rates of a topic.

    Example: rosrv topic info /scan
    """
    body = appliance.ask_or_exit(admin.GraphWanted())
    found = next((row for row in body.topics if row.name == topic), None)
    if found is None:
        known = [row.name for row in body.topics]
        near = meant(topic, known) or ": rosrv topic list shows all topics"
        raise refusal([f"rosrv topic: no node publishes or subscribes to {printable(topic)}{near}"])
    if appliance.as_json:
        say_json(found)
    else:
        for line in _describe(found, {node.name for node in body.nodes if node.uncallable}):
            say(line)


@speaks
def publishers(
    appliance: Appliance,
    topic: _Topic,
    *,
    at: Annotated[
        str,
        typer.Option(help="At this time: 1h (ago), 14:03, 'yesterday 14:03', a date, RFC 3339, or now"),
    ] = "now",
) -> None:
    """Show the nodes that were registered as publishers of a topic now or in the past, from the audit log.

    The output also names gaps in the log. The appliance may be stopped. Exit status 1 if no publisher is found.

    Example: rosrv topic publishers /cmd_vel --at 10:32
    """
    with Errors():
        now = clock.wall_ns()
        then = now if at == "now" else time_given("--at", at, "rosrv topic")
        if then > now:
            raise usage_error(f"--at {at} is in the future: give a time in the past")
        log = audit_of(appliance.way)
        first = next(iter(log.search(Filter(), None, 1, newest_first=False).entries), None)
        found = publishers_at(log.export, first, topic, then)
    rows = [
        asdict(row) | {"since": None if row.since is None else rfc3339(row.since)} for row in found.publishers
    ]
    if appliance.as_json:
        say_json({"topic": topic, "at": rfc3339(then), "publishers": rows, "unknown": found.unknown})
    else:
        say(f"{topic} at {local_text(then, digits=0)}", "bold")
        for row in rows:
            began = (
                f"since {_to_seconds(in_local_zone(row['since']))} (#{row['sequence']})"
                if row["since"]
                else "before the log begins"
            )
            say(f"  {row['node']} on {appliance.host_in_words(row['host'])}, registered {began}")
        if not found.publishers:
            say("  no publisher is found")
        for line in found.unknown:
            say(f"not known: {_to_seconds(in_local_zone(line))}", "yellow")
    raise typer.Exit(0 if found.publishers else 1)


def _to_seconds(text: str) -> str:
    return re.sub(r"(T\d\d:\d\d:\d\d)\.\d++", r"\1", text)


_UNCALLABLE = "it cannot be called (NAT), and gets later publishers when it subscribes again"


def _describe(topic: Topic, uncallable: Collection[str] = ()) -> Iterator[str]:
    yield f"{printable(topic.name)}  {printable(topic.type)}"
    for publisher in topic.publishers:
        rate = f"{publisher.messages_per_second:.1f} Hz, {publisher.bytes_per_second:.0f} bytes/s"
        delay = f"{publisher.delay_seconds * 1e6:.0f} µs in the relay"
        yield f"  published by {printable(publisher.node)}: {rate}, {delay}, {publisher.dropped} not delivered"
    connected = {connection.to for connection in topic.connections}
    for node in topic.subscribers:
        if node in connected or not topic.mediated or all(one.node == node for one in topic.publishers):
            line = f"  received by {printable(node)}"
        else:
            why = f"rosrv audit search --deny --topic {printable(topic.name)}"
            line = f"  subscribed by {printable(node)}, which is not connected to a publisher ({why})"
        yield f"{line}; {_UNCALLABLE}" if node in uncallable else line
    if topic.mediated and not topic.subscribers:
        yield "  no node subscribes: messages pass the relay only for monitors, so 0.0 Hz need not be silence"
    if not topic.mediated:
        yield "  its messages bypass the appliance"


def _show(message: TopicMessage, field: str | None, *, as_json: bool) -> None:
    value = message.fields if field is None else part_of(message.fields, field)
    if as_json:
        say_json({**in_full(message), "fields": value})
        return
    at = local_text(message.time, digits=3)
    words = [at, printable(message.node), f"{message.size} bytes", printable(message.why)]
    say("  ".join(filter(None, words)), "dim")
    for line in lines_of(value, 0):
        say(line)


def part_of(fields: Any, path: str) -> Any:
    """Return the field at `path`, or the sign that it was left out. An unknown path ends with status 2."""
    value = fields
    for name in path.split("."):
        if isinstance(value, Mapping) and name in value:
            value = value[name]
        elif isinstance(value, list) and name.isdecimal() and int(name) < len(value):
            value = value[int(name)]
        elif sign := _left_out(value, name):
            return sign
        else:
            known = ", ".join(map(str, value)) if isinstance(value, Mapping) else "no fields"
            raise usage_error(f"no field {path}: {name!r} is not one of: {known}")
    return value


def _left_out(value: object, name: str) -> str:
    if isinstance(value, Mapping):
        return str(value.get(CUT, ""))
    last = value[-1] if isinstance(value, list) and value else value
    numbered = name.isdecimal() or last == CUT
    return CUT + last.partition(CUT)[2] if isinstance(last, str) and CUT in last and numbered else ""
