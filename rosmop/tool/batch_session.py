"""Execute the jobs of `run`, `learn`, `coverage` and `replay` on recordings.

The exit status is 3 if one of several recordings failed. If the only recording failed, that is a usage error.
"""

import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from rosmop.batch.jobs import Failure, Job, Result
from rosmop.batch.journal import JournalError, ResumeJournal, TemporaryStore
from rosmop.batch.ray_cluster import ClusterError
from rosmop.batch.recording_list import RecordingName, recordings_of
from rosmop.batch.runner import JobRunner, executor_for
from rosmop.recordings.recording import RecordingError
from rosmop.tool.command_context import CommandContext
from rosmop.tool.terminal import refusal

# Show progress on standard error: a bar on a terminal, lines if the user wants them, nothing otherwise.


@contextmanager
def progress(
    what: str, total: Callable[[], int], *, shares_screen: bool = False, always: bool = False
) -> Iterator[Callable[[int], None]]:
    """Show progress during a block, which passes the finished part of `total()` to the function that it gets.

    If the work `shares_screen`, there is no bar when standard output is a terminal. Without a bar, `always`
    prints a line for each percent.
    """
    console = Console(stderr=True)
    is_bar = console.is_terminal and not (shares_screen and sys.stdout.isatty())
    if not is_bar and not always:
        yield lambda _done: None
        return
    columns = (
        SpinnerColumn(), TextColumn(what), BarColumn(), TaskProgressColumn(), TimeElapsedColumn(),
        TimeRemainingColumn(),
    )  # fmt: skip
    with Progress(*columns, console=console, transient=True, disable=not is_bar) as bar:
        task = bar.add_task(what, total=total() or None)
        shown = -1

        def advance(done: int) -> None:
            nonlocal shown
            bar.update(task, completed=done)
            row = bar.tasks[0]
            if not is_bar and int(row.percentage) > shown:
                shown = int(row.percentage)
                left = "" if row.time_remaining is None else f", {row.time_remaining:.0f} s left"
                sys.stderr.write(f"{what}: {shown} %{left}\n")

        yield advance


SOME_FAILED = 3
_INTERRUPTED = 130


@dataclass(frozen=True)
class RecordingsOptions:
    """The options of a command with recordings."""

    bags: Sequence[Path] = ()
    sets: Sequence[str] = ()
    workers: int | None = None
    on: str | None = None
    resume: Path | None = None
    report: Path | None = None
    progress: bool = False

    @property
    def single(self) -> Path | None:
        many = self.sets or self.workers or self.on or self.resume or self.report
        return self.bags[0] if len(self.bags) == 1 and not many else None


@dataclass(frozen=True)
class BatchSession:
    """The recordings, and a runner of jobs on them."""

    program: CommandContext
    recordings: Sequence[RecordingName]
    options: RecordingsOptions
    runner: JobRunner
    kept: TemporaryStore

    def results(self, what: str, jobs: Sequence[Job]) -> Iterator[tuple[int, Result | Failure]]:
        with self._progress(what, jobs) as done:
            yield from self.runner.run(jobs, done)

    def in_order(self, what: str, jobs: Sequence[Job]) -> Iterator[Result | Failure]:
        with self._progress(what, jobs) as done:
            yield from self.runner.in_order(jobs, done)

    def require(self, failures: Sequence[Failure]) -> None:
        require(self.program, failures, len(self.recordings))

    def failed_rows(self, failures: Iterable[tuple[int, Failure]]) -> list[dict[str, object]]:
        rows: list[dict[str, object]] = []
        for number, failure in failures:
            uri = self.recordings[number].uri
            self.program.warn(f"{uri} failed: {failure.text}")
            rows.append({"kind": "recording", "bag": uri, "error": failure.text})
        return rows

    def keep(self, rows: Iterable[Mapping[str, object]]) -> None:
        if self.options.report is not None:
            lines = "".join(json.dumps(msgspec.to_builtins(row)) + "\n" for row in rows)
            self.kept.append(lines.encode("ascii"))

    def write_report(self) -> None:
        if self.options.report is None:
            return
        try:
            self.program.write(self.options.report, self.kept.whole())
        except OSError as error:
            raise self.program.usage_error(f"cannot write {self.options.report}: {error.strerror}") from error

    @contextmanager
    def _progress(self, what: str, jobs: Sequence[Job]) -> Iterator[Any]:
        sizes = [job.recording.size for job in jobs]
        finished = 0
        with progress(what, lambda: sum(sizes), shares_screen=True, always=self.options.progress) as advance:

            def done(number: int) -> None:
                nonlocal finished
                finished += sizes[number]
                advance(finished)

            yield done


def require(program: CommandContext, failures: Sequence[Failure], recordings: int) -> None:
    """Exit if all recordings failed with the same errors of specifications, or if the only one failed."""
    if len(failures) < recordings:
        return
    findings = [failure.findings for failure in failures]
    if findings[0] and all(other == findings[0] for other in findings):
        raise refusal(findings[0])
    if len(failures) == 1:
        raise program.usage_error(failures[0].text)


@contextmanager
def batch_session(program: CommandContext, options: RecordingsOptions) -> Iterator[BatchSession]:
    if not options.bags and not options.sets:
        raise program.usage_error("give recordings: --bag FILE, or --bags with a folder or a pattern")
    if options.report is not None and not os.access(options.report.parent, os.W_OK):
        raise program.usage_error(f"cannot write {options.report}: its folder is missing or not writable")
    with ExitStack() as opened:
        advice = "add --resume FILE to keep what is finished"
        if options.resume is not None:
            advice = f"{options.resume} has what is finished; the same command continues"
        try:
            recordings = recordings_of(options.bags, options.sets)
            journal = None if options.resume is None else opened.enter_context(ResumeJournal(options.resume))
            executor = opened.enter_context(executor_for(len(recordings), options.workers, options.on))
            kept = opened.enter_context(TemporaryStore())
            try:
                yield BatchSession(program, recordings, options, JobRunner(executor, journal), kept)
            except ClusterError as error:
                raise program.usage_error(f"{error}; {advice}") from error
        except (RecordingError, JournalError, ClusterError) as error:
            raise program.usage_error(str(error)) from error
        except KeyboardInterrupt:
            program.warn(f"interrupted; {advice}")
            raise typer.Exit(_INTERRUPTED) from None
