"""The commands `rosrv record now|list|show|timeline|messages|fetch|remove`."""

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from tempfile import gettempdir
from typing import TYPE_CHECKING, Annotated, TypeVar

import msgspec
import typer

from appliance.audit.log.log_database import LogUnreadableError
from appliance.audit.log.record_format import rfc3339
from appliance.base.atomic_files import name_to_make
from appliance.base.counted import counted
from appliance.base.timestamps import local_text
from appliance.base.user_errors import with_remedy
from appliance.cli import completion
from appliance.cli.connection.admin_client import AdminSocket, NotRunningError, RestProblemError
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.durations import bounded_span, time_given
from appliance.cli.message_lines import lines_of
from appliance.cli.output import OR_STANDARD, STANDARD_OUTPUT, new_file, say_json, usage_error
from appliance.features.recorder import requests as recording_requests
from appliance.features.recorder.bag_reader import MessagePosition
from appliance.features.recorder.mcap import as_mcap
from appliance.features.recorder.recording_answers import RecordedMessages, Recording, Sender, Timeline
from appliance.features.recorder.timeline import (
    MAX_COLUMNS,
    MAX_NEIGHBOURS,
    NEIGHBOURS,
    is_record,
    messages_around,
    timeline,
)
from appliance.policy.host_names import HostInWords
from rosmop.tool.terminal import printable, refusal, say

if TYPE_CHECKING:
    from appliance.cli.connection.rest_orders import RestWay

_Id = Annotated[
    str,
    typer.Argument(
        metavar="ID",
        help="As in `rosrv record list`",
        show_default=False,
        autocompletion=completion.names_of_feature(
            "recordings", lambda body: [row.id for row in body.recordings]
        ),
    ),
]
_SECOND = 1_000_000_000
_PIECE = 1 << 20  # bytes
_BARS = " ▁▂▃▄▅▆▇█"
_T = TypeVar("_T")


@speaks
def now(
    appliance: Appliance,
    *,
    before: Annotated[
        str | None,
        typer.Option(
            help="Time before now to keep: 30s, 2m (default: `recorder.before` of the configuration)",
            show_default=False,
        ),
    ] = None,
    after: Annotated[
        str | None,
        typer.Option(
            help="Time after now to record: 10s (default: `recorder.after` of the configuration)",
            show_default=False,
        ),
    ] = None,
    note: Annotated[
        str, typer.Option(help="Description of the event, for the recording and the audit log")
    ] = "",
) -> None:
    """Make a recording of the last and the next seconds.

    Example: rosrv record now --after 30s --note "the arm hit the door"
    """
    if len(note) > recording_requests.LONGEST_NOTE:  # nothing may delay the recording
        typer.echo(f"rosrv: the note is cut after {recording_requests.LONGEST_NOTE} characters", err=True)
        note = note[: recording_requests.LONGEST_NOTE]
    request = recording_requests.RecordNow(_seconds("--before", before), _seconds("--after", after), note)
    body = appliance.answer_or_exit(request)
    say(body.id)
    typer.echo(
        f"rosrv: ready at {_moment(body.ends)}, or later if monitors act until then: rosrv record fetch {body.id}",
        err=True,
    )


@speaks
def list_recordings(appliance: Appliance) -> None:
    """List the recordings, oldest first, and those that are still being made. --json lists only finished ones.

    Example: rosrv record list
    """
    body = appliance.ask_or_exit(recording_requests.RecordingsWanted())
    rows = body.recordings
    for row in rows:
        if appliance.as_json:
            say_json(row)
        else:
            say(f"{row.id}  {_moment(row.began)}  {_summary(row)}")
    for making in [] if appliance.as_json else body.in_progress:
        ends = f"being recorded until {_moment(making.ends)} or later, by {making.trigger.what}"
        say(f"{making.id}  {_moment(making.began)}  {ends}")
    if not rows and not body.in_progress and not appliance.as_json:
        say("no recordings; make one: rosrv record now (a recording is listed once it ends)")


@speaks
def show(appliance: Appliance, recording: _Id) -> None:
    """Show a recording's triggers and contents.

    Example: rosrv record show 1879f3c2a4b5d6e7f012
    """
    body = appliance.answer_or_exit(recording_requests.RecordingWanted(recording))
    for line in _describe(body, appliance.host_in_words):
        say(line)


@speaks
def show_timeline(
    appliance: Appliance,
    recording: _Id,
    *,
    since: Annotated[
        str | None,
        typer.Option(help="From this time: 1h (ago), 14:03, a date, or RFC 3339", show_default=False),
    ] = None,
    until: Annotated[str | None, typer.Option(help="Up to this time", show_default=False)] = None,
    columns: Annotated[
        int, typer.Option(min=1, max=MAX_COLUMNS, help="Columns that the time is divided into")
    ] = 60,
) -> None:
    """Show the messages on each topic and the events of a recording on one time line.

    Example: rosrv record timeline 1879f3c2a4b5d6e7f012
    """
    way = appliance.way
    if isinstance(way, AdminSocket):
        body = appliance.ask_or_exit(recording_requests.RecordingWanted(recording))
        start, end = _moment_given("--since", since), _moment_given("--until", until)
        found = _read(
            lambda: timeline(
                body, _bag(way, body), start, end, columns, log=way.state / "control" / "audit.db"
            )
        )
    else:
        query = {"since": _in_utc("--since", since), "until": _in_utc("--until", until), "columns": columns}
        found = _ask(way, f"{recording}/timeline", query, Timeline)
    if appliance.as_json:
        say_json(found)
        return
    for line in _draw(found, appliance.host_in_words):
        say(line)


@speaks
def messages(
    appliance: Appliance,
    recording: _Id,
    *,
    at: Annotated[
        str | None,
        typer.Option(
            help="A time, the id of an audit record in the recording, or the position of a message (default: the first"
            " trigger of the recording)",
            show_default=False,
        ),
    ] = None,
    topic: Annotated[
        list[str] | None, typer.Option(help="Only this topic (repeatable)", show_default=False)
    ] = None,
    neighbours: Annotated[
        int, typer.Option(min=1, max=MAX_NEIGHBOURS, help="Number of messages before and after it")
    ] = NEIGHBOURS,
) -> None:
    """Show the messages of a recording around a point in time. The audit log records the request.

    Messages are shown as sent, before monitors changed or dropped them. Long strings and arrays are cut, bytes are
    hexadecimal.

    Example: rosrv record messages 1879f3c2a4b5d6e7f012 --topic /cmd_vel
    """
    topics = topic or []
    body = appliance.ask_or_exit(recording_requests.RecordingWanted(recording))
    text = body.triggers[0].record if at is None else at
    way = appliance.way
    if isinstance(way, AdminSocket):
        place = text if is_record(text) else MessagePosition.parse(text) or _moment_given("--at", text)
        assert place is not None  # noqa: S101  it is text
        appliance.ask_or_exit(recording_requests.RecordingRead(recording, topics))
        found = _read(lambda: messages_around(body, _bag(way, body), place, topics, neighbours))
    else:
        point = text if is_record(text) or MessagePosition.parse(text) else _in_utc("--at", text)
        query = {"at": point, "topic": topics, "neighbours": neighbours}
        found = _ask(way, f"{recording}/messages", query, RecordedMessages)
    for number, message in enumerate(found.messages):
        if appliance.as_json:
            say_json(message)
            continue
        mark = "->" if number == found.chosen else "  "
        sender = _sender(message.sender, appliance.host_in_words)
        size = f"{message.size} bytes{'' if message.carried else ', not carried'}"
        words = (local_text(message.time), message.topic, sender, size, message.why)
        say(f"{mark} {'  '.join(printable(word) for word in words if word)}", "dim")
        for line in lines_of(message.fields, 2):
            say(line)


@speaks
def fetch(
    appliance: Appliance,
    recording: _Id,
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help=f"File to write (default: rosrv-ID.bag); {OR_STANDARD}", show_default=False
        ),
    ] = None,
    mcap: Annotated[
        bool, typer.Option("--mcap", help="As MCAP (rosrv-ID.mcap), for Foxglove and others")
    ] = False,
) -> None:
    """Write a recording to a bag file. The audit log records the request.

    Example: rosrv record fetch 1879f3c2a4b5d6e7f012 --mcap
    """
    target = out or Path(f"rosrv-{recording}.{'mcap' if mcap else 'bag'}")
    if target != STANDARD_OUTPUT and os.path.lexists(target):
        raise usage_error(f"{target} already exists: remove it, or name another file with --output")
    body = appliance.ask_or_exit(recording_requests.RecordingWanted(recording))
    part = name_to_make(Path(gettempdir(), body.id) if target == STANDARD_OUTPUT else target)
    try:
        os.close(_private(part))
    except OSError as error:
        raise usage_error(f"cannot write {with_remedy(error, target)}") from None
    try:
        bag = bag_of(appliance, body.id, part)
        with bag.open("rb") as file:
            whole = hashlib.file_digest(file, "sha256").hexdigest() == body.sha256
            if whole:
                file.seek(0)
                with new_file(target) as made:
                    made.writelines(as_mcap(bag) if mcap else iter(lambda: file.read(_PIECE), b""))
    except ValueError as error:
        raise refusal([f"rosrv: cannot convert to MCAP: {error}; fetch the bag without --mcap"]) from None
    except OSError as error:
        raise usage_error(with_remedy(error, error.filename2 or error.filename or target)) from None
    finally:
        part.unlink(missing_ok=True)
    if not whole:
        raise refusal([f"rosrv: the bag of {body.id} was changed after it was recorded: its hash differs"])
    if appliance.as_json:
        say_json({"file": str(target), "sha256": body.sha256, "format": "mcap" if mcap else "bag"})
    else:
        say(f"{target}: {_summary(body)}")


@speaks
def remove(appliance: Appliance, recording: _Id) -> None:
    """Remove a recording. The audit log records the request.

    Example: rosrv record remove 1879f3c2a4b5d6e7f012
    """
    body = appliance.answer_or_exit(recording_requests.RecordingRemove(recording))
    say(f"recording {body.id} is removed")


def bag_of(appliance: Appliance, recording: str, part: Path) -> Path:
    """Return the bag's path once the request is recorded. Over REST, the bag is written to `part`."""
    way = appliance.way
    if isinstance(way, AdminSocket):
        return _bag(way, appliance.ask_or_exit(recording_requests.RecordingFetch(recording)))
    try:
        with way.client.stream("GET", f"/v1/recordings/{recording}/bag") as answer, part.open("wb") as file:
            for piece in answer.iter_bytes():
                file.write(piece)
    except (RestProblemError, NotRunningError) as error:
        raise usage_error(str(error)) from None
    return part


def _bag(way: AdminSocket, recording: Recording) -> Path:
    return way.state / "recordings" / recording.id / "recording.bag"


def _ask(way: "RestWay", path: str, query: Mapping[str, object], kind: type[_T]) -> _T:
    given = {name: value for name, value in query.items() if value is not None}
    try:
        return msgspec.convert(way.client.call("GET", f"/v1/recordings/{path}", params=given), kind)
    except RestProblemError as problem:
        if problem.kind == "bad-input":
            raise usage_error(str(problem)) from None
        raise refusal([f"rosrv: {problem}"]) from None
    except NotRunningError as error:
        raise usage_error(str(error)) from None


def _read(what: Callable[[], _T]) -> _T:
    try:
        return what()
    except OSError as error:
        raise usage_error(f"{error.filename}: {error.strerror}") from None
    except (ValueError, LogUnreadableError) as error:
        raise usage_error(str(error)) from None


def _moment_given(option: str, text: str | None) -> int | None:
    return None if text is None else time_given(option, text, "rosrv record")


def _in_utc(option: str, text: str | None) -> str | None:
    """Return a time for REST, where a time without a zone would be in UTC."""
    moment = _moment_given(option, text)
    return None if moment is None else rfc3339(moment)


def _sender(sender: Sender, host_in_words: HostInWords) -> str:
    return " ".join(filter(None, (sender.node, sender.host and host_in_words(sender.host))))


def _draw(found: Timeline, host_in_words: HostInWords) -> Iterator[str]:
    yield f"{found.id}  {_moment(found.since)} to {_moment(found.until)}"
    lanes = [(flow.topic, flow.counts, "message", flow.senders) for flow in found.topics]
    lanes += [(mark.kind, mark.counts, "event", []) for mark in found.marks]
    width = min(40, max((len(name) for name, *_rest in lanes), default=0))
    for name, counts, what, senders in lanes:
        most = max(counts) or 1
        bars = "".join(_BARS[-(-count * (len(_BARS) - 1) // most)] for count in counts)
        by = ", ".join(_sender(sender, host_in_words) for sender in senders)
        yield f"  {printable(name):{width}} {bars} {counted(sum(counts), what)}  {printable(by)}".rstrip()
    if found.more_topics:
        yield f"  {counted(found.more_topics, 'more topic')} with fewer messages"
    for event in found.events:
        host = event.host and host_in_words(event.host)
        who = " ".join(filter(None, (event.resource, event.caller_id, host)))
        offset = (event.time - found.since) / _SECOND
        what = f"{event.event}: {event.reason}" if event.reason else event.event
        kind = event.kind if event.times == 1 else f"{event.kind} {event.times} times"
        yield f"  +{offset:.3f} s  {kind}  {printable(who)}  {printable(what)}  (record {event.record})"
    if found.more_events:
        yield f"  {counted(found.more_events, 'more event')}: list them with a shorter time (--since, --until)"


def _private(path: Path) -> int:
    """Let only the owner read the file, because messages are private."""
    return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)


def _seconds(option: str, given: str | None) -> float | None:
    return None if given is None else bounded_span(option, given, "0.1s", "1h", "rosrv record")


def _moment(nanoseconds: int) -> str:
    return local_text(nanoseconds, digits=0).replace("T", " ")


def _summary(recording: Recording) -> str:
    why = recording.triggers[0]
    more = f" and {len(recording.triggers) - 1} more" if recording.triggers[1:] else ""
    messages = sum(topic.messages for topic in recording.topics)
    whole = "" if recording.complete else "  NOT COMPLETE"
    seconds = (recording.ended - recording.began) / _SECOND
    return (
        f"{seconds:.0f} s, {counted(messages, 'message')} of {counted(len(recording.topics), 'topic')},"
        f" {recording.size / 1e6:.1f} MB, by {why.what}{more}{whole}"
    )


def _describe(recording: Recording, host_in_words: HostInWords) -> Iterator[str]:
    yield f"{recording.id}  {_summary(recording)}"
    yield f"  from {_moment(recording.began)} to {_moment(recording.ended)}"
    yield f"  policy revision {recording.policy}, specifications revision {recording.monitors}"
    yield f"  sha256 {recording.sha256}"
    yield f"  charged to {host_in_words(recording.charged_to)}"
    if recording.why_not:
        yield f"  missing: {recording.why_not}"
    for trigger in recording.triggers:
        yield f"  {_moment(trigger.time)}  {trigger.what}  {trigger.text}  (record {trigger.record})"
    for topic in recording.topics:
        missed = f", {topic.missed} missed" if topic.missed else ""
        yield f"  {topic.topic}  {topic.type}  {counted(topic.messages, 'message')}, {topic.bytes} bytes{missed}"
    for row in recording.left_out:
        yield f"  {row.topic}  {row.type}  left out: {row.why} ({host_in_words(row.host)})"
