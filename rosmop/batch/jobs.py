"""Jobs on one recording, and `work`, the pure function that executes them.

A job has everything on which its result depends, except the messages. The size of the result does not depend on the
recording's length.
"""

import os
import signal
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import msgspec

from rosmop.batch.recording_list import RecordingName, local_recording
from rosmop.batch.replay_job import Replayed, ReplayJob, Specifications, replay_recording
from rosmop.check.sources import compiled_from
from rosmop.form.findings import SpecificationError
from rosmop.learn.exercised import coverage
from rosmop.learn.passes import AlarmFacts, AnyStep, ContentFacts, TimeFacts, facts_of
from rosmop.learn.recordings import LearningError
from rosmop.recordings.recording import RecordedFile, RecordingError, definitions_of, open_recording
from rosmop.recordings.replay import refusals
from rosmop.run.engine import MonitorSet
from roswire.definitions import Definitions
from roswire.errors import DefinitionError
from roswire.standard import standard_definitions


class SurveyJob(msgspec.Struct, frozen=True, tag=True):
    """Reads the headers of a recording, with the topics that match a pattern."""

    recording: RecordingName
    topics: list[str]


class Survey(msgspec.Struct, frozen=True, tag=True):
    """The first and last time in nanoseconds, the types of the topics, and the definitions by type.

    `notes` names the connections whose messages are left out.
    """

    name: str
    began: int
    ended: int
    topics: dict[str, str]
    definitions: dict[str, str]
    notes: list[str]


class LearnJob(msgspec.Struct, frozen=True, tag=True):
    """Executes a step of learning. `definitions` are by type."""

    recording: RecordingName
    step: AnyStep
    definitions: dict[str, str]


class CoverageJob(msgspec.Struct, frozen=True, tag=True):
    """Counts how often a recording exercises each item of specifications."""

    recording: RecordingName
    specifications: Specifications


class Coverage(msgspec.Struct, frozen=True, tag=True):
    """How often each item of `exercised.items_of` was covered, in that order. `notes` are reasons of drops."""

    counts: list[int]
    notes: list[str]


class Failure(msgspec.Struct, frozen=True, tag=True):
    """The reason why a job has no result. `findings` are the errors of its specifications."""

    text: str
    findings: list[str] = []


Job = SurveyJob | LearnJob | CoverageJob | ReplayJob
Result = Survey | TimeFacts | ContentFacts | AlarmFacts | Coverage | Replayed


_SECONDS, _SECONDS_PER_MB = 600.0, 10.0  # of processor time


class _TooLong(BaseException):
    """Raised when a job takes too long; no reader of damaged files handles it by accident."""


class _Envelope(msgspec.Struct, frozen=True):
    version: str
    job: Job


def to_bytes(job: Job) -> bytes:
    return msgspec.msgpack.encode(_Envelope(_version(), job))


def unpack(result: bytes) -> Result | Failure:
    decoded: Result | Failure = msgspec.msgpack.decode(result, type=Result | Failure)
    return decoded


def work(job: bytes) -> bytes:
    """Execute a job. Every error becomes a `Failure`, so one recording never ends the work on others."""
    try:
        envelope = msgspec.msgpack.decode(job, type=_Envelope)
        if envelope.version != _version():
            failure = Failure(
                f"the worker has version {_version()}, the command {envelope.version}; install the same"
            )
        else:
            with _limit(_SECONDS + _SECONDS_PER_MB * envelope.job.recording.size / 1e6) as seconds:
                return msgspec.msgpack.encode(_result(envelope.job))
    except _TooLong:
        failure = Failure(f"it takes more than {seconds:.0f} s of processor time")
    except Exception as error:  # noqa: BLE001  a recording may be damaged in ways that no reader knows
        failure = failure_of(error)
    return msgspec.msgpack.encode(failure)


def failure_of(error: Exception) -> Failure:
    if isinstance(error, SpecificationError):
        return Failure(_text(str(error)), [_text(str(finding)) for finding in error.findings])
    is_known = isinstance(error, RecordingError | LearningError)
    return Failure(_text(str(error) if is_known else f"{type(error).__name__}: {error}"))


@contextmanager
def _limit(seconds: float) -> Iterator[float]:
    """Raise `_TooLong` in the block when it has used the processor for this time.

    Each message has limits, but timers and few bytes can make many messages slow. Unlike elapsed time, processor time
    depends neither on the machine's load nor on pauses.
    """

    def end(_signal: int, _frame: object) -> None:
        raise _TooLong

    before = signal.signal(signal.SIGPROF, end)
    # It is repeated, because a callback from compiled code may lose an exception.
    signal.setitimer(signal.ITIMER_PROF, seconds, 1)
    try:
        yield seconds
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def _result(job: Job) -> Result:
    name = Path(job.recording.uri).name
    with local_file(job.recording) as path:
        if isinstance(job, ReplayJob):
            return replay_recording(job, path)
        if isinstance(job, SurveyJob):
            recording = RecordedFile(path, job.topics, name)
            definitions: dict[str, str] = {}
            for kind in recording.topics.values():
                with suppress(DefinitionError):  # no node sent its text
                    definitions |= {part.name: part.text for part in recording.definitions.parts(kind)}
            return Survey(
                recording.name, recording.began, recording.ended, recording.topics, definitions, recording.notes
            )  # fmt: skip
        if isinstance(job, LearnJob):
            known = standard_definitions().merge(definitions_by_type(job.definitions))
            topics = job.step.topics
            return facts_of(job.step, RecordedFile(path, list(topics), name, topics, known), known)
        return _coverage(job, path, name)


def _coverage(job: CoverageJob, path: Path, name: str) -> Coverage:
    with closing(open_recording(path)) as reader:
        known = job.specifications.merge(definitions_of(reader))
        monitors = MonitorSet.of(compiled_from(job.specifications.texts, known))
        notes = [
            f"{job.recording.uri}: {text}" for text in refusals(monitors, reader, strict=job.recording.uri)
        ]
    recording = RecordedFile(path, ["*"], name, monitors.topics, known)
    return Coverage(coverage(job.specifications.texts, known, recording), notes)


def definitions_by_type(texts: dict[str, str]) -> Definitions:
    return Definitions.from_files({f"{kind}.msg": text for kind, text in texts.items()})


@contextmanager
def local_file(recording: RecordingName) -> Iterator[Path]:
    """Yield the path of a recording.

    Raises `RecordingError`, even after the block if the file has changed since the command listed it.
    """
    path = Path(os.fsdecode(recording.path))
    try:
        yield path
    except RecordingError as error:
        raise RecordingError(str(error).replace(str(path), recording.uri)) from error
    now = local_recording(path)
    if (now.size, now.version) != (recording.size, recording.version):
        raise RecordingError(f"{recording.uri} changed after the command began")


def _version() -> str:
    for name in ("rosmop", "rosrv-appliance"):
        try:
            return version(name)
        except PackageNotFoundError:
            continue
    return "unknown"


def _text(text: str) -> str:
    return text.encode("utf-8", "backslashreplace").decode("utf-8")
