"""`rosrv monitor replay`: run a monitor on recordings and report what it would have done."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, NamedTuple

import typer
from rich.table import Column

from appliance.channel import admin
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.monitor.monitor_program import MONITOR
from appliance.cli.monitor.recorder_input import EVER, Piece, Span, gaps, pieces_of, require_recorded, span_of
from appliance.cli.output import say_json
from rosmop.check.sources import compiled_from
from rosmop.fast.build import fast_path_of
from rosmop.form.findings import Position, SpecificationError, line_of
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import Margin, Outcome, bound
from rosmop.tool.bag import ReplayStep, definitions_of, open_bag, refusals, replay
from rosmop.tool.bounded_bag import BoundedReader
from rosmop.tool.monitor_output import BILLION, because
from rosmop.tool.options import Folders
from rosmop.tool.progress_bar import progress
from rosmop.tool.specification_input import read_definitions, read_specifications, topics_of
from rosmop.tool.tables import say_table, table_of
from rosmop.tool.terminal import counted, refused, say
from roswire.definitions import Definitions
from roswire.standard import standard_definitions

_KINDS = ("drop", "change", "verdict", "warning", "fault")
_WOULD = {"drop": "would drop it", "change": "would change it"}
_PROGRESS_EVERY = 1000  # messages


class _Found(NamedTuple):
    """An effect that a monitor would have had."""

    monitor: str
    kind: str
    text: str


@speaks
def replay_monitor(
    appliance: Appliance,
    what: Annotated[
        str,
        typer.Argument(
            metavar="MONITOR|FILE",
            help="A monitor of the running appliance, or a file (.rv)",
            show_default=False,
        ),
    ],
    *,
    bags: Annotated[
        list[Path] | None,
        typer.Option("--bag", metavar="FILE", help="A recording (repeatable)", show_default=False),
    ] = None,
    since: Annotated[
        str | None,
        typer.Option(
            "--since",
            help="Without --bag: read the flight recorder from this time on: 1h (ago), a date, or RFC 3339",
            show_default=False,
        ),
    ] = None,
    until: Annotated[
        str | None,
        typer.Option("--until", help="Read the flight recorder up to this time", show_default=False),
    ] = None,
    topics: Annotated[
        list[str] | None,
        typer.Option(
            "--topic", metavar="PATTERN", help="Only these topics; `*` matches anything (repeatable)"
        ),
    ] = None,
    most: Annotated[
        int,
        typer.Option(
            "--most", min=0, metavar="N", help="Number of places to show for each monitor, topic and kind"
        ),
    ] = 10,
    margins: Annotated[
        bool, typer.Option("--margins", help="Also show how close each comparison of numbers came (slower)")
    ] = False,
    msg: Folders = None,
) -> None:
    """List and count the recorded messages that a monitor would have dropped or changed.

    Read bags (--bag), or the running appliance's flight recorder (--since), with its recordings and its memory; gaps
    are reported. Each recording starts in the monitor's initial state. With --json, print every place.

    Example: rosrv monitor replay safeTrigger --since 1h
    """
    if bool(bags) is (since is not None or until is not None):
        raise MONITOR.usage_error(
            "give --bag FILE (repeatable), or --since and --until for the flight recorder"
        )
    report = _Report(most, appliance.as_json)
    patterns = topics or ["*"]
    messages = 0
    try:
        texts, definitions, chosen = _specifications(appliance, what, msg or [])
        with ExitStack() as fetched:
            if bags:
                pieces = [Piece(str(bag), bag, EVER, "") for bag in bags]
            else:
                span = span_of(since, until)
                recorded = appliance.ask_or_exit(admin.RecordingsWanted())
                require_recorded(recorded, _topics(texts, chosen, patterns))
                pieces = fetched.enter_context(pieces_of(appliance, recorded, span))
                report.cover(pieces, span)
            for piece in pieces:
                with closing(open_bag(MONITOR, piece.bag)) as reader:
                    known = definitions_of(reader).extended(definitions)
                    compiled = compiled_from(texts, known, margins=margins)
                    monitors = _only(chosen, MonitorSet.of(compiled, fast=fast_path_of(compiled)))
                    for text in refusals(monitors, reader, patterns):
                        raise MONITOR.usage_error(f"{piece.name}: {text}")
                    messages += report.of(monitors, reader, piece, patterns)
    except SpecificationError as error:
        raise refused(error.findings) from None
    if not appliance.as_json:
        report.show()
    report.show_margins(texts)
    if not appliance.as_json:
        say(f"{counted(messages, 'message')} of {counted(len(pieces), 'recording')}")


def _specifications(
    appliance: Appliance, what: str, folders: Sequence[Path]
) -> tuple[dict[str, str], Definitions, str | None]:
    """Return texts, definitions and the monitor's name; for a file, the name is None."""
    path = Path(what)
    if path.suffix == ".rv" or path.is_file():
        return read_specifications(MONITOR, [path]), read_definitions(MONITOR, [path], folders), None
    loaded = appliance.ask_or_exit(admin.MonitorsWanted(texts=True))
    names = [row.name for row in loaded.monitors]
    if what not in names:
        known = ", ".join(names) or "no monitor is loaded"
        raise MONITOR.usage_error(f"{what} is neither a file (.rv) nor a loaded monitor ({known})")
    own = Definitions.from_files(loaded.definitions or {})
    definitions = standard_definitions().extended(own)
    return loaded.files or {}, definitions, what


def _topics(texts: Mapping[str, str], chosen: str | None, patterns: Sequence[str]) -> dict[str, str]:
    """Return the selected topics and their types, for the chosen monitor; if None, for all monitors in the texts."""
    return {
        topic: kind
        for topic, kind in topics_of(texts, chosen).items()
        if any(fnmatchcase(topic, pattern) for pattern in patterns)
    }


def _only(chosen: str | None, monitors: MonitorSet) -> MonitorSet:
    """Enable only the chosen monitor and monitors that share variables with it; if None, enable all monitors."""
    if chosen is not None:
        (together,) = monitors.compiled.groups([chosen])
        monitors.switch({name: name in together for name in monitors.names}, 0)
    return monitors


class _Closest(NamedTuple):
    """The smallest distance of a comparison, and where it occurred."""

    margin: Margin
    bag: str
    time: int
    number: int | None


class _Report:
    """Prints the first effects of each monitor, topic and kind, and counts all of them."""

    def __init__(self, most: int, as_json: bool) -> None:
        self._most = most
        self._as_json = as_json
        self._counts: Counter[tuple[str, str, str]] = Counter()
        self._closest: dict[tuple[Position, int, bool], _Closest] = {}

    def cover(self, pieces: Sequence[Piece], span: Span) -> None:
        """Print the gaps between the pieces, and which pieces are incomplete."""
        # Without --since, the time before the first piece is not a gap.
        began = span.since or pieces[0].span.since
        for gap in gaps([piece.span for piece in pieces], Span(began, span.until)):
            if self._as_json:
                say_json({"kind": "gap", "since": gap.since / BILLION, "until": gap.until / BILLION})
            else:
                say(f"not recorded: {gap}", "yellow")
        for name, why_not in dict.fromkeys((piece.name, piece.why_not) for piece in pieces if piece.why_not):
            if self._as_json:
                say_json({"kind": "incomplete", "bag": name, "text": why_not})
            else:
                say(f"{name} is incomplete: {why_not}", "yellow")

    def of(self, monitors: MonitorSet, reader: BoundedReader, piece: Piece, topics: Sequence[str]) -> int:
        """Replay a recording, print its effects and return the number of messages."""
        given = 0
        with progress("replaying", lambda: reader.message_count, shares_screen=True) as report:
            for number, replayed in enumerate(replay(monitors, reader, None, topics, piece.span)):
                given += replayed.topic is not None
                for found in _found(replayed.outcome):
                    self._say(piece.name, replayed, found)
                for margin in monitors.take_margins():
                    known = self._closest.get(key := (margin.position, margin.number, not margin.holds))
                    if known is None or margin.distance < known.margin.distance:
                        self._closest[key] = _Closest(
                            margin, piece.name, replayed.outcome.time, replayed.index
                        )
                if not number % _PROGRESS_EVERY:
                    report(given)
        return given

    def show_margins(self, texts: Mapping[str, str]) -> None:
        """Print the smallest distance of each comparison, while it was true and while it was false."""
        for _key, (margin, bag, time, number) in sorted(self._closest.items()):
            position = margin.position
            if self._as_json:
                say_json({
                    "kind": "margin", "monitor": margin.monitor, "file": position.file,
                    "line": position.line, "column": position.column, "holds": margin.holds,
                    "distance": margin.distance, "left": margin.left, "right": margin.right,
                    "threshold_at": margin.threshold_at, "bag": bag, "time": time / BILLION, "index": number,
                })  # fmt: skip
            else:
                place = "" if number is None else f" #{number}"
                line = line_of(texts[position.file], position.line)
                where = f"{bag} {time / BILLION:.3f}{place}"
                word = "true" if margin.holds else "false"
                sides = f"{margin.left:.6g} against {margin.right:.6g}"
                say(f"{position}: {line}: {word} by {margin.distance:.6g} at the closest, {sides} ({where})")

    def _say(self, bag: str, replayed: ReplayStep, found: _Found) -> None:
        where, outcome = replayed.topic or replayed.outcome.timer or "", replayed.outcome
        self._counts[found.monitor, where, found.kind] += 1
        if self._as_json:
            say_json({
                "bag": bag, "monitor": found.monitor, "kind": found.kind, "topic": replayed.topic,
                "index": replayed.index, "timer": outcome.timer, "time": outcome.time / BILLION,
                "text": found.text,
            })  # fmt: skip
        elif self._counts[found.monitor, where, found.kind] <= self._most:
            place = where if replayed.index is None else f"#{replayed.index} {where}"
            words = _WOULD.get(found.kind, found.kind)
            say(f"{bag} {outcome.time / BILLION:.3f} {place}: {found.monitor} {words}: {found.text}")

    def show(self) -> None:
        """Print the counts by monitor and topic."""
        counts = self._counts
        if not counts:
            say("no message would have been dropped or changed, and no monitor reached a verdict", "green")
            return
        heads = ("would drop", "would change", "verdicts", "warnings", "faults")
        table = table_of(
            "monitor", Column("topic", overflow="fold"), *(Column(head, justify="right") for head in heads)
        )
        for monitor, where in dict.fromkeys((monitor, where) for monitor, where, _kind in counts):
            table.add_row(monitor, where, *(str(counts[monitor, where, kind]) for kind in _KINDS))
        say_table(table)


def _found(outcome: Outcome) -> Iterator[_Found]:
    said = {line.monitor: line.text for line in outcome.log}
    if outcome.result == "dropped":
        why = outcome.reason or (outcome.fatal.text if outcome.fatal is not None else "")
        yield _Found(outcome.dropped_by, "drop", why or said.get(outcome.dropped_by) or outcome.events[-1])
    for monitor in dict.fromkeys(event.partition(".")[0] for event in outcome.changed_by):
        own = [event for event in outcome.changed_by if event.startswith(f"{monitor}.")]
        yield _Found(monitor, "change", ", ".join(own))
    for verdict in outcome.verdicts:
        text = f"{verdict.category} of property {verdict.property + 1} ({verdict.logic}){bound(verdict)}"
        yield _Found(verdict.monitor, "verdict", "; ".join((text, *because(verdict))))
    for line in outcome.log:
        if line.level not in ("DEBUG", "INFO"):
            yield _Found(line.monitor, "warning", line.text)
    for fault in outcome.faults:
        yield _Found(fault.monitor, "fault", f"{fault.position}: {fault.text}")
