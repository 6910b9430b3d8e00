"""Read a period from the running appliance's flight recorder: its recordings and its memory."""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple

from appliance.audit.log.record_format import rfc3339
from appliance.base import clock
from appliance.cli.connection.admin_client import NotRunningError
from appliance.cli.connection.target import Appliance
from appliance.cli.durations import time_given
from appliance.cli.monitor_program import MONITOR
from appliance.cli.output import say_json
from appliance.features.recorder import requests as recording_requests
from appliance.features.recorder.recording_answers import OpenRecording, Recording, Recordings
from appliance.features.recorder.requests import RecordingsWanted
from appliance.features.recorder.verbs import bag_of
from rosmop.tool.monitor_output import BILLION
from rosmop.tool.terminal import refusal, say

_SECOND = 1_000_000_000


class Span(NamedTuple):
    """A period in nanoseconds since the epoch, both ends included."""

    since: int
    until: int

    def __str__(self) -> str:
        seconds = (self.until - self.since) / _SECOND
        return f"{rfc3339(self.since)} to {rfc3339(self.until)} ({seconds:.1f} s)"


class Piece(NamedTuple):
    """A bag, and the period to read from it, which overlaps no other."""

    name: str
    bag: Path
    span: Span
    why_not: str


def span_of(since: str | None, until: str | None) -> Span:
    now, verb = clock.wall_ns(), "rosrv monitor"
    span = Span(
        0 if since is None else time_given("--since", since, verb),
        now if until is None else min(now, time_given("--until", until, verb)),
    )
    if span.since >= span.until:
        end = "now" if until is None else f"--until {until}"
        raise MONITOR.usage_error(f"--since {since} is not before {end}")
    return span


def require_recorded(known: Recordings, topics: Mapping[str, str]) -> None:
    for topic, kind in topics.items():
        if not any(fnmatchcase(topic, glob) for glob in known.topics):
            raise MONITOR.usage_error(
                f"{topic} is not recorded: recorder.topics has {', '.join(known.topics)}"
            )
        out = next((glob for glob in known.never for name in (topic, kind) if fnmatchcase(name, glob)), None)
        if out is not None:
            raise MONITOR.usage_error(f"{topic} ({kind}) is not recorded: recorder.never has {out}")


@contextmanager
def pieces_of(appliance: Appliance, known: Recordings, span: Span) -> Iterator[list[Piece]]:
    """Yield the bags that cover the span. They stay open in the block, so a removed recording remains readable."""
    found: list[tuple[Span, Recording]] = []
    for row in sorted(known.recordings, key=lambda row: row.began):
        since = max(row.began, found[-1][0].until + 1 if found else span.since)
        until = min(row.ended, span.until)
        if since <= until:
            found.append((Span(since, until), row))
    memory = clock.wall_ns() - int(known.before * _SECOND)
    missing = [gap for gap in gaps([part for part, _row in found], span) if gap.until > memory]
    lent = _lent(appliance, Span(missing[0].since, span.until)) if missing else None
    if lent is not None:
        parts = (Span(max(gap.since, lent.began), min(gap.until, lent.ended)) for gap in missing)
        found += [(part, lent) for part in parts if part.since <= part.until]
    pieces: list[Piece] = []
    with tempfile.TemporaryDirectory(prefix="rosrv-replay-") as folder, ExitStack() as opened:
        bags: dict[str, Path] = {}
        for part, row in sorted(found, key=lambda entry: entry[0]):
            if row.id not in bags:
                bag = bag_of(appliance, row.id, Path(folder) / row.id)
                try:
                    file = opened.enter_context(bag.open("rb"))
                except OSError as error:
                    raise MONITOR.usage_error(f"the bag of {row.id} was removed: {error.strerror}") from None
                bags[row.id] = Path(f"/proc/self/fd/{file.fileno()}")
            pieces.append(Piece("memory" if row is lent else row.id, bags[row.id], part, row.why_not))
        if not pieces:
            text = f"there are no recordings of {span}: {_available(known.recordings)}"
            raise refusal([f"rosrv monitor: {text}; the memory has the last {known.before:g} s"])
        yield pieces


@contextmanager
def recorded_messages(
    appliance: Appliance, since: str | None, until: str | None, topics: Mapping[str, str]
) -> Iterator[tuple[list[tuple[str, Path, tuple[int, int]]], str]]:
    """Yield the name, bag and period of each piece, and the node name under which monitors publish."""
    span = span_of(since, until)
    recorded = appliance.ask_or_exit(RecordingsWanted())
    require_recorded(recorded, topics)
    with pieces_of(appliance, recorded, span) as pieces, MONITOR.reports():
        _cover(pieces, span, recorded.in_progress, as_json=appliance.as_json)
        yield [(piece.name, piece.bag, piece.span) for piece in pieces], recorded.publish_as


def _cover(
    pieces: Sequence[Piece], span: Span, in_progress: Sequence[OpenRecording], *, as_json: bool
) -> None:
    # Without --since, the time before the first piece is not a gap.
    began = span.since or pieces[0].span.since
    for gap in gaps([piece.span for piece in pieces], Span(began, span.until)):
        if as_json:
            say_json({"kind": "gap", "since": gap.since / BILLION, "until": gap.until / BILLION})
        else:
            making = next((one for one in in_progress if one.began <= gap.until), None)
            until = (
                ""
                if making is None
                else f"; {making.id} is being recorded until {rfc3339(making.ends)} or later"
            )
            say(f"{'not recorded' if making is None else 'not readable yet'}: {gap}{until}", "yellow")
    for name, why_not in dict.fromkeys((piece.name, piece.why_not) for piece in pieces if piece.why_not):
        if as_json:
            say_json({"kind": "incomplete", "bag": name, "text": why_not})
        else:
            say(f"{name} is incomplete: {why_not}", "yellow")


def gaps(parts: Sequence[Span], span: Span) -> Iterator[Span]:
    """Yield the periods of `span` that no piece covers. The pieces must be in order."""
    at = span.since
    for part in parts:
        if part.since > at:
            yield Span(at, part.since - 1)
        at = max(at, part.until + 1)
    if span.until >= at:
        yield Span(at, span.until)


def _lent(appliance: Appliance, span: Span) -> Recording | None:
    try:
        answer = appliance.ask(recording_requests.RecordingOfMemory(*span))
    except NotRunningError as error:
        raise MONITOR.usage_error(str(error)) from None
    return None if answer.trouble == "unknown" else appliance.body_or_exit(answer)


def _available(recordings: Sequence[Recording]) -> str:
    if not recordings:
        return "there are no recordings"
    first, last = min(row.began for row in recordings), max(row.ended for row in recordings)
    return f"the recordings cover {rfc3339(first)} to {rfc3339(last)}"
