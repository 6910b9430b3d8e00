"""Report which parts of specifications recordings exercise."""

from collections.abc import Iterable
from pathlib import Path

from rich.console import Console
from rich.table import Column

from rosmop.batch.jobs import Coverage, CoverageJob, Failure
from rosmop.batch.replay_job import Specifications
from rosmop.form.findings import SpecificationError
from rosmop.learn.exercised import CoverageItem, add_counts, items_of
from rosmop.tool.batch_session import SOME_FAILED, BatchSession, RecordingsOptions, batch_session
from rosmop.tool.command_context import CommandContext
from rosmop.tool.specification_input import read_for_recordings
from rosmop.tool.tables import add_row, table_of
from rosmop.tool.terminal import refusal, say, say_json

_KINDS = ("event", "branch", "function", "handler", "state", "transition")


def coverage(
    program: CommandContext,
    files: list[Path],
    folders: list[Path],
    options: RecordingsOptions,
    *,
    fail_under: float,
    as_json: bool,
) -> int:
    try:
        specifications = read_for_recordings(program, files, folders)
        items = items_of(specifications.texts)
    except SpecificationError as error:
        raise refusal(error.findings) from None
    with batch_session(program, options) as session:
        counts, rows = _cover(session, specifications, items)
        failed = any("error" in row for row in rows)
        rows += [
            {
                "specification": item.specification, "kind": item.kind, "what": item.what,
                "file": item.position.file, "line": item.position.line, "count": count,
            } for item, count in counts.items()
        ]  # fmt: skip
        session.keep(rows)
        session.write_report()
    exercised = sum(count > 0 for count in counts.values())
    percent = 100 * exercised / len(counts) if counts else 100.0
    if as_json:
        for row in rows:
            say_json(row)
    else:
        _show(counts)
        say(f"{exercised} of {len(counts)} exercised: {percent:.1f} %")
    if percent < fail_under:
        return 1
    return SOME_FAILED if failed else 0


def _cover(
    session: BatchSession, specifications: Specifications, items: list[CoverageItem]
) -> tuple[dict[CoverageItem, int], list[dict[str, object]]]:
    jobs = [CoverageJob(recording, specifications) for recording in session.recordings]
    counts = [0] * len(items)
    failures: dict[int, Failure] = {}
    for number, result in session.results("reading", jobs):
        if isinstance(result, Coverage):
            counts = add_counts(counts, result.counts)
            for note in result.notes:
                session.program.warn(f"{note}; its messages are left out")
        elif isinstance(result, Failure):
            failures[number] = result
    ordered = sorted(failures.items())
    session.require([failure for _number, failure in ordered])
    return dict(zip(items, counts, strict=True)), session.failed_rows(ordered)


def _show(counts: dict[CoverageItem, int]) -> None:
    columns = (Column(kind, justify="right") for kind in _KINDS)
    table = table_of("monitor", *columns)
    for name in dict.fromkeys(item.specification for item in counts):
        own = [(item, count) for item, count in counts.items() if item.specification == name]
        add_row(
            table, name, *(_fraction(count for item, count in own if item.kind == kind) for kind in _KINDS)
        )
    Console(highlight=False).print(table)
    for item, count in counts.items():
        if not count:
            place = f"{item.position.file}:{item.position.line}"
            say(f"{place}: never: {item.kind} {item.what} of {item.specification}", "yellow")


def _fraction(counts: Iterable[int]) -> str:
    found = list(counts)
    return f"{sum(count > 0 for count in found)}/{len(found)}" if found else "-"
