"""The commands `rosrv topic echo|info|publishers`; the last also answers for a time in the past."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Annotated, Any

import typer

from appliance.api.front.moments import in_full
from appliance.audit.log.record_format import rfc3339
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
from appliance.features.topics.publishers import publishers_at
from appliance.features.topics.requests import TopicLook, TopicMessage
from rosmop.tool.terminal import printable, refused, say
from roswire.errors import InvalidNameError
from roswire.message_view import CUT
from roswire.names import resolve

_AT_ONCE = 20  # messages in one request


def _resolved(topic: str) -> str:
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
        callback=_resolved,
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
            raise refused([f"rosrv topic: no message of {topic} in {seconds:g} s"])


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
        raise refused([f"rosrv topic: no node publishes or subscribes to {printable(topic)}{near}"])
    if appliance.as_json:
        say_json(found)
    else:
        for line in _described(found):
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


def _described(topic: Topic) -> Iterator[str]:
    yield f"{printable(topic.name)}  {printable(topic.type)}"
    for publisher in topic.publishers:
        rate = f"{publisher.messages_per_second:.1f} Hz, {publisher.bytes_per_second:.0f} bytes/s"
        delay = f"{publisher.delay_seconds * 1e6:.0f} µs in the relay"
        yield f"  published by {printable(publisher.node)}: {rate}, {delay}, {publisher.dropped} not delivered"
    connected = {connection.to for connection in topic.connections}
    for node in topic.subscribers:
        if node in connected or not topic.mediated or all(one.node == node for one in topic.publishers):
            yield f"  received by {printable(node)}"
        else:
            yield f"  subscribed by {printable(node)}, which is not connected to a publisher"
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
