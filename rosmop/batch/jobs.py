"""Jobs on one recording, and `work`, the pure function that executes them on any machine.

A job has all that its result depends on, except the messages. Results are bounded: their size does not depend on the
recording's length.
"""

from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import msgspec

from rosmop.batch.object_store import SCHEME, fetched
from rosmop.batch.recording_list import RecordingName
from rosmop.batch.replay_job import Replayed, ReplayJob, Specifications, replayed
from rosmop.check.sources import compiled_from
from rosmop.form.findings import SpecificationError
from rosmop.learn.exercised import covered
from rosmop.learn.passes import AlarmFacts, AnyStep, ContentFacts, TimeFacts, facts_of
from rosmop.learn.recordings import LearningError
from rosmop.recordings.recording import RecordedFile, RecordingError, open_recording
from rosmop.recordings.replay import refusals
from rosmop.run.engine import MonitorSet
from roswire.definitions import Definitions
from roswire.standard import standard_definitions


class SurveyJob(msgspec.Struct, frozen=True, tag=True):
    """Reads the headers of a recording, with the topics that match a pattern."""

    recording: RecordingName
    topics: list[str]


class Survey(msgspec.Struct, frozen=True, tag=True):
    """The first and last time in nanoseconds, the types of the topics, and the definitions by type."""

    name: str
    began: int
    ended: int
    topics: dict[str, str]
    definitions: dict[str, str]


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
    """The counts, in the order of `exercised.items_of`."""

    counts: list[int]


class Failure(msgspec.Struct, frozen=True, tag=True):
    """The reason why a job has no result. `findings` are the errors of its specifications."""

    text: str
    findings: list[str] = []


Job = SurveyJob | LearnJob | CoverageJob | ReplayJob
Result = Survey | TimeFacts | ContentFacts | AlarmFacts | Coverage | Replayed


class _Envelope(msgspec.Struct, frozen=True):
    """A job, and the version of the program that made it."""

    version: str
    job: Job


def packed(job: Job) -> bytes:
    """Return a job as bytes."""
    return msgspec.msgpack.encode(_Envelope(_version(), job))


def unpacked(result: bytes) -> Result | Failure:
    """Return the result that `work` returned as bytes. Raises `msgspec.DecodeError`."""
    decoded: Result | Failure = msgspec.msgpack.decode(result, type=Result | Failure)
    return decoded


def work(job: bytes) -> bytes:
    """Execute a job. Whatever goes wrong is a `Failure`: one recording never ends the work on others."""
    result: Result | Failure
    try:
        envelope = msgspec.msgpack.decode(job, type=_Envelope)
        if envelope.version != _version():
            result = Failure(
                f"the worker has version {_version()}, the command {envelope.version}; install the same"
            )
        else:
            result = _result(envelope.job)
    except SpecificationError as error:
        result = Failure(str(error), [str(finding) for finding in error.findings])
    except (RecordingError, LearningError) as error:
        result = Failure(_text(str(error)))
    except Exception as error:  # noqa: BLE001  a recording may be damaged in ways that no reader knows
        result = Failure(_text(f"{type(error).__name__}: {error}"))
    return msgspec.msgpack.encode(result)


def _result(job: Job) -> Result:
    with local_file(job.recording) as path:
        if isinstance(job, ReplayJob):
            return replayed(job, path)
        if isinstance(job, SurveyJob):
            recording = RecordedFile(path, job.topics, _name(job.recording))
            kinds = recording.definitions.message_types
            definitions = {kind: recording.definitions.message(kind).text for kind in kinds}
            return Survey(recording.name, recording.began, recording.ended, recording.topics, definitions)
        if isinstance(job, LearnJob):
            recording = RecordedFile(path, list(job.step.topics), _name(job.recording))
            known = definitions_by_type(job.definitions)
            return facts_of(job.step, recording, standard_definitions().extended(known))
        return _coverage(job, path, RecordedFile(path, ["*"], _name(job.recording)))


def _coverage(job: CoverageJob, path: Path, recording: RecordedFile) -> Coverage:
    known = job.specifications.known(recording.definitions)
    monitors = MonitorSet.of(compiled_from(job.specifications.texts, known))
    with closing(open_recording(path)) as reader:
        for text in refusals(monitors, reader):
            raise RecordingError(f"{job.recording.uri}: {text}")
    return Coverage(covered(job.specifications.texts, known, recording))


def definitions_by_type(texts: dict[str, str]) -> Definitions:
    """Return definitions of messages, given by type."""
    return Definitions.from_files({f"{kind}.msg": text for kind, text in texts.items()})


@contextmanager
def local_file(recording: RecordingName) -> Iterator[Path]:
    """Open a block with the path of a recording, which is fetched if it is remote. Errors have the name of the user."""
    with ExitStack() as opened:
        path = Path(recording.path)
        if recording.uri.startswith(SCHEME):
            path = opened.enter_context(fetched(recording.uri, recording.version))
        try:
            yield path
        except RecordingError as error:
            raise RecordingError(str(error).replace(str(path), recording.uri)) from error


def _name(recording: RecordingName) -> str:
    return Path(recording.uri).name


def _version() -> str:
    for name in ("rosmop", "rosrv-appliance"):
        try:
            return version(name)
        except PackageNotFoundError:
            continue
    return "unknown"


def _text(text: str) -> str:
    """Return a text without surrogates, which have no encoding."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")
