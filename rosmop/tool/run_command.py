"""Run monitors on recordings."""

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from rosmop.batch.jobs import Failure, failure_of
from rosmop.batch.recording_list import RecordingName
from rosmop.batch.replay_job import Replayed, ReplayJob, Specifications, replay_recording
from rosmop.form.findings import SpecificationError
from rosmop.recordings.recording import Reader, RecordingError, definitions_of, open_recording
from rosmop.recordings.replay import EVER, OutputBag, refusals, replay
from rosmop.run.engine import MonitorSet
from rosmop.tool.batch_session import (
    SOME_FAILED,
    BatchSession,
    RecordingsOptions,
    batch_session,
    progress,
    require,
)
from rosmop.tool.command_context import CommandContext
from rosmop.tool.monitor_output import lines, record
from rosmop.tool.replay_report import MAX_IN_ROWS, ReplayReport
from rosmop.tool.specification_input import read_for_recordings
from rosmop.tool.terminal import refusal, say, say_json
from roswire.counted import counted

_PROGRESS_EVERY = 1000


def run(
    program: CommandContext,
    files: list[Path],
    folders: list[Path],
    options: RecordingsOptions,
    *,
    output: Path | None,
    as_json: bool,
) -> int:
    try:
        specifications = read_for_recordings(program, files, folders)
        if options.single is not None:
            with program.reports():
                _run_single(program, specifications, options, options.single, output, as_json=as_json)
            return 0
    except SpecificationError as error:
        raise refusal(error.findings) from None
    if output is not None:
        raise program.usage_error("--output is for a single --bag FILE")
    with batch_session(program, options) as session:
        return run_batch(session, specifications, ReplayReport(10, as_json=as_json), strict=False)


def run_batch(
    session: BatchSession,
    specifications: Specifications,
    report: ReplayReport,
    topics: list[str] | None = None,
    *,
    margins: bool = False,
    strict: bool = True,
) -> int:
    # Each recording has its rows, so the same places are kept with and without --json.
    jobs = [
        ReplayJob(recording, specifications, topics or ["*"], EVER, MAX_IN_ROWS, margins, strict)
        for recording in session.recordings
    ]
    results = session.in_order("replaying", jobs)
    for recording, result in zip(session.recordings, results, strict=True):
        assert isinstance(result, Replayed | Failure)  # noqa: S101  for mypy: jobs of one kind
        session.keep(report.add(recording.uri, result))
    session.require(report.failures)
    session.keep(report.show(specifications.texts))
    session.write_report()
    return SOME_FAILED if report.failures else 0


def run_spans(
    program: CommandContext,
    specifications: Specifications,
    spans: Sequence[tuple[str, Path, tuple[int, int]]],
    report: ReplayReport,
    topics: list[str],
    *,
    own: str,
    margins: bool,
) -> int:
    for name, path, span in spans:
        recording = RecordingName(name, path.stat().st_size, "")
        job = ReplayJob(recording, specifications, topics, span, MAX_IN_ROWS, margins, strict=True, own=own)
        try:
            report.add(name, replay_recording(job, path))
        except (SpecificationError, RecordingError) as error:
            report.add(name, failure_of(error))
    require(program, report.failures, len(spans))
    report.show(specifications.texts)
    return SOME_FAILED if report.failures else 0


def _run_single(
    program: CommandContext,
    specifications: Specifications,
    options: RecordingsOptions,
    bag: Path,
    output: Path | None,
    *,
    as_json: bool,
) -> None:
    with closing(open_recording(bag)) as reader:
        monitors = specifications.monitors(definitions_of(reader))
        for text in refusals(monitors, reader):
            program.warn(f"{text}; its messages are dropped")
        if output is None:
            _report(monitors, reader, None, options, as_json=as_json)
        else:
            with OutputBag(output, monitors.definitions) as recording:
                _report(monitors, reader, recording, options, as_json=as_json)


def _report(
    monitors: MonitorSet,
    reader: Reader,
    recording: OutputBag | None,
    options: RecordingsOptions,
    *,
    as_json: bool,
) -> None:
    counts = {"passed": 0, "changed": 0, "dropped": 0}
    verdicts = faults = 0
    with progress(
        "replaying", lambda: reader.message_count, shares_screen=True, always=options.progress
    ) as advance:
        for number, replayed in enumerate(replay(monitors, reader, recording)):
            outcome = replayed.outcome
            if replayed.index is not None:
                counts[outcome.result] += 1
            verdicts += len(outcome.verdicts)
            faults += len(outcome.faults)
            if as_json:
                say_json(record(outcome, replayed.index, replayed.topic, replayed.publisher))
            else:
                for line in lines(outcome, replayed.index, replayed.topic, replayed.publisher):
                    say(line)
            if not number % _PROGRESS_EVERY:
                advance(sum(counts.values()))
    if not as_json:
        total = ", ".join(f"{number} {word}" for word, number in counts.items())
        say(f"{counted(sum(counts.values()), 'message')}: {total}; "
            f"{counted(verdicts, 'verdict')}, {counted(faults, 'fault')}")  # fmt: skip
