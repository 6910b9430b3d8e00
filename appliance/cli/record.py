"""`rosrv record now|list|show|fetch|remove`: what the flight recorder has of the robot's messages."""

import hashlib
import shutil
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from appliance.channel import admin
from appliance.channel.answers.recordings import Recording
from appliance.cli import completion
from appliance.cli.admin_socket import AdminSocket, NotRunningError
from appliance.cli.output import Json, counted, say, say_json, usage_error
from appliance.cli.running import Appliance, speaks
from appliance.cli.spans import span_given

_Id = Annotated[str, typer.Argument(metavar="ID", show_default=False, autocompletion=completion.recordings)]
_SECOND = 1_000_000_000


@speaks
def now(
    appliance: Appliance,
    *,
    before: Annotated[
        str | None,
        typer.Option(help="How much of the past: 30s, 2m (default: recorder.before)", show_default=False),
    ] = None,
    after: Annotated[
        str | None,
        typer.Option(help="How much of what comes: 10s (default: recorder.after)", show_default=False),
    ] = None,
    note: Annotated[
        str, typer.Option(help="What happened; it stands in the recording and the audit log")
    ] = "",
    as_json: Json = False,
) -> None:
    """Record the last seconds, and the next ones, of what the robot says.

    Example: rosrv record now --after 30s --note "the arm hit the door"
    """
    request = admin.RecordNow(_seconds("--before", before), _seconds("--after", after), note)
    body = appliance.answer_or_exit(request, as_json=as_json)
    say(body.id)
    typer.echo(f"rosrv: it is there from {_moment(body.ends)} on: rosrv record fetch {body.id}", err=True)


@speaks
def list_recordings(appliance: Appliance, as_json: Json = False) -> None:
    """List the recordings that are kept, the oldest first.

    Example: rosrv record list
    """
    for row in appliance.ask_or_exit(admin.RecordingsWanted(), as_json=as_json).recordings:
        if as_json:
            say_json(row)
        else:
            say(f"{row.id}  {_moment(row.began)}  {_summary(row)}")


@speaks
def show(appliance: Appliance, recording: _Id, as_json: Json = False) -> None:
    """Show why a recording was made, and what it has.

    Example: rosrv record show 1879f3c2a4b5d6e7f012
    """
    body = appliance.answer_or_exit(admin.RecordingWanted(recording), as_json=as_json)
    for line in _described(body):
        say(line)


@speaks
def fetch(
    appliance: Appliance,
    recording: _Id,
    *,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="The file (default: rosrv-ID.bag)", show_default=False)
    ] = None,
    mcap: Annotated[
        bool, typer.Option("--mcap", help="As MCAP (rosrv-ID.mcap), for Foxglove and others")
    ] = False,
    as_json: Json = False,
) -> None:
    """Write a recording's bag to a file; it is recorded who fetched it.

    Example: rosrv record fetch 1879f3c2a4b5d6e7f012 && rosbag info rosrv-1879f3c2a4b5d6e7f012.bag
    """
    target = out or Path(f"rosrv-{recording}.{'mcap' if mcap else 'bag'}")
    if target.exists():
        raise usage_error(f"{target} is there already")
    part = target.with_name(f"{target.name}.part")
    try:
        body = _fetched(appliance, recording, part, as_json=as_json)
        with part.open("rb") as file:
            whole = hashlib.file_digest(file, "sha256").hexdigest() == body.sha256
        if whole and mcap:
            _convert(part, target)
        elif whole:
            part.replace(target)
    except OSError as error:
        raise usage_error(f"{error.filename}: {error.strerror}") from None
    finally:
        part.unlink(missing_ok=True)
    if not whole:
        typer.echo(
            f"rosrv: the bag of {body.id} is not the one that was recorded: its hash is another", err=True
        )
        raise typer.Exit(1)
    if as_json:
        say_json({"file": str(target), "sha256": body.sha256, "format": "mcap" if mcap else "bag"})
    else:
        say(f"{target}: {_summary(body)}")


@speaks
def remove(appliance: Appliance, recording: _Id, as_json: Json = False) -> None:
    """Remove a recording; it is recorded who removed it.

    Example: rosrv record remove 1879f3c2a4b5d6e7f012
    """
    body = appliance.answer_or_exit(admin.RecordingRemove(recording), as_json=as_json)
    say(f"recording {body.id} is removed")


def _fetched(appliance: Appliance, recording: str, part: Path, *, as_json: bool) -> Recording:
    """The bag in a file, and what it must be. Raises `OSError`."""
    way = appliance.way
    if isinstance(way, AdminSocket):
        body = appliance.ask_or_exit(admin.RecordingFetch(recording), as_json=as_json)
        shutil.copyfile(way.state / "recordings" / body.id / "recording.bag", part)
        return body
    from appliance.cli.rest.session import ProblemError  # noqa: PLC0415  httpx is not imported for the socket

    body = appliance.ask_or_exit(admin.RecordingWanted(recording), as_json=as_json)
    try:
        with way.client.streamed("GET", f"/v1/recordings/{body.id}/bag") as answer, part.open("wb") as file:
            for piece in answer.iter_bytes():
                file.write(piece)
    except (ProblemError, NotRunningError) as error:
        raise usage_error(str(error)) from None
    return body


def _convert(bag: Path, target: Path) -> None:
    """Write the bag as MCAP. Raises `OSError`; ends the program with 1 where a message type makes no sense."""
    from rosbags.rosbag1 import ReaderError  # noqa: PLC0415  slow to import

    from appliance.recorder.mcap import as_mcap  # noqa: PLC0415

    try:
        with target.open("xb") as file:
            for piece in as_mcap(bag):
                file.write(piece)
    except (ReaderError, ValueError) as error:
        target.unlink()
        typer.echo(f"rosrv: it cannot be made MCAP, fetch the bag: {error}", err=True)
        raise typer.Exit(1) from None


def _seconds(option: str, given: str | None) -> float | None:
    return None if given is None else span_given(option, given, "10s, 2m or 1h", "rosrv record")


def _moment(nanoseconds: int) -> str:
    return datetime.fromtimestamp(nanoseconds / _SECOND, UTC).strftime("%Y-%m-%d %H:%M:%SZ")


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


def _described(recording: Recording) -> Iterator[str]:
    yield f"{recording.id}  {_summary(recording)}"
    yield f"  from {_moment(recording.began)} to {_moment(recording.ended)}"
    yield f"  policy revision {recording.policy}, specifications revision {recording.monitors}"
    yield f"  sha256 {recording.sha256}"
    if recording.why_not:
        yield f"  missing: {recording.why_not}"
    for trigger in recording.triggers:
        yield f"  {_moment(trigger.time)}  {trigger.what}  {trigger.text}  (record {trigger.record})"
    for topic in recording.topics:
        missed = f", {topic.missed} missed" if topic.missed else ""
        yield f"  {topic.topic}  {topic.type}  {counted(topic.messages, 'message')}, {topic.bytes} bytes{missed}"
