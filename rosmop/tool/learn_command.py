"""Learn specifications from recordings of normal operation."""

import os
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from rosmop.batch.jobs import Failure, LearnJob, Survey, SurveyJob, definitions_by_type
from rosmop.batch.recording_list import RecordingName
from rosmop.learn.learner import LearningResult, learn
from rosmop.learn.passes import (
    AlarmFacts,
    AnyStep,
    ContentFacts,
    ContentStep,
    Facts,
    TimeFacts,
    TimeStep,
    named_files,
)
from rosmop.learn.recordings import LearningError
from rosmop.tool.batch_session import SOME_FAILED, BatchSession, RecordingsOptions, batch_session
from rosmop.tool.command_context import CommandContext
from rosmop.tool.specification_input import BESIDE
from rosmop.tool.terminal import say, say_json
from roswire.counted import counted
from roswire.definitions import Definitions
from roswire.errors import DefinitionError
from roswire.message_text import BUILTINS, MessageDefinition
from roswire.standard import standard_definitions


def learn_monitors(
    program: CommandContext,
    options: RecordingsOptions,
    topics: list[str],
    out: Path | None,
    *,
    hold_out: float,
    as_json: bool,
) -> int:
    if out is not None and out.exists():
        raise program.usage_error(f"{out} already exists: name a new file with --output")
    if len({os.path.realpath(bag) for bag in options.bags}) < len(options.bags):
        raise program.usage_error("a recording is given twice: it would test itself; give each one once")
    with batch_session(program, options) as session:
        surveys, failures, recorded = _surveys(session, topics or ["*"])
        try:
            learnt = learn(
                [survey for _number, survey in surveys],
                standard_definitions().merge(recorded),
                hold_out,
                _Passes(session, [session.recordings[number] for number, _survey in surveys], recorded).run,
            )
        except LearningError as error:
            raise program.usage_error(str(error)) from error
        failures |= {surveys[place][0]: Failure(text) for place, text in learnt.failed.items()}
        rows = [*session.failed_rows(sorted(failures.items())), *_rows(learnt)]
        session.keep(rows)
        session.write_report()
    _show(program, learnt, rows, recorded, out, as_json=as_json)
    return SOME_FAILED if failures else 0


def _surveys(
    session: BatchSession, topics: list[str]
) -> tuple[list[tuple[int, Survey]], dict[int, Failure], Definitions]:
    jobs = [SurveyJob(recording, topics) for recording in session.recordings]
    surveys: list[tuple[int, Survey]] = []
    failures: dict[int, Failure] = {}
    for number, result in enumerate(session.in_order("reading headers", jobs)):
        if isinstance(result, Survey):
            surveys.append((number, result))
            for note in result.notes:
                session.program.warn(note)
        elif isinstance(result, Failure):
            failures[number] = result
    definitions = {number: definitions_by_type(survey.definitions) for number, survey in surveys}
    recorded = _usual(definitions.values())
    for number, own in definitions.items():
        others = [
            kind for kind in own.message_types if _lines(own.message(kind)) != _lines(recorded.message(kind))
        ]
        if others:
            failures[number] = Failure(f"its definition of {others[0]} differs from that of most recordings")
    surveys = [(number, survey) for number, survey in surveys if number not in failures]
    session.require(list(failures.values()))
    if not surveys:
        session.failed_rows(sorted(failures.items()))
        raise session.program.usage_error("no recording can be read")
    return surveys, failures, recorded


def _usual(definitions: Iterable[Definitions]) -> Definitions:
    """Return the definition of each type that most recordings have, and of equally many the first."""
    found = [own.message(kind) for own in definitions for kind in own.message_types]
    numbers = Counter(map(_lines, found))
    usual: dict[str, MessageDefinition] = {}
    for message in sorted(found, key=lambda one: -numbers[_lines(one)]):
        usual.setdefault(message.name, message)
    return Definitions(usual)


def _lines(message: MessageDefinition) -> tuple[object, ...]:
    constants = tuple((constant.type, constant.name, constant.text) for constant in message.constants)
    return message.name, message.fields, constants


@dataclass(frozen=True)
class _Passes:
    session: BatchSession
    recordings: Sequence[RecordingName]
    recorded: Definitions

    def run(self, steps: list[AnyStep]) -> Iterator[tuple[int, Facts | LearningError]]:
        texts = {kind: self.recorded.message(kind).text for kind in self.recorded.message_types}
        jobs = [LearnJob(self.recordings[step.recording], step, texts) for step in steps]
        for number, result in self.session.results(_pass_of(steps), jobs):
            if isinstance(result, Failure):
                yield number, LearningError(result.text)
            elif isinstance(result, TimeFacts | ContentFacts | AlarmFacts):
                yield number, result


def _pass_of(steps: Sequence[AnyStep]) -> str:
    if not steps or isinstance(steps[0], TimeStep):
        return "learning (1 of 3)"
    return "learning (2 of 3)" if isinstance(steps[0], ContentStep) else "testing (3 of 3)"


def _show(
    program: CommandContext,
    learnt: LearningResult,
    rows: Sequence[dict[str, object]],
    recorded: Definitions,
    out: Path | None,
    *,
    as_json: bool,
) -> None:
    if out is not None:
        _write(program, out, learnt, recorded)
    if as_json:
        for row in rows:
            say_json(row)
    elif out is None:
        for number, text in enumerate(learnt.texts, 1):
            if number > 1:
                sys.stdout.write(
                    f"\n// Too long for one file: file {number} begins here; --output writes all.\n"
                )
            sys.stdout.write(text)
    else:
        conditions, names = counted(len(learnt.candidates), "condition"), set(learnt.names.values())
        files = ", ".join(map(str, _files(out, learnt)))
        say(f"{conditions} in {counted(len(names), 'specification')}: {files}")
        widened = sum(1 for candidate in learnt.candidates if candidate.widened)
        if learnt.held_out:
            say(f"alarms on the held-out part: {widened} widened, {len(learnt.left_out)} left out")


def _rows(learnt: LearningResult) -> Iterator[dict[str, object]]:
    for result, candidates in (("kept", learnt.candidates), ("left out", learnt.left_out)):
        for candidate in candidates:
            yield {
                "specification": learnt.names.get(candidate.key, ""), "topic": candidate.topic, "kind": candidate.kind,
                "field": candidate.place, "says": candidate.says, "seen": candidate.seen,
                "support": asdict(candidate.support), "held_out_alarms": candidate.alarms,
                "result": "widened" if candidate.widened else result,
            }  # fmt: skip


def _files(out: Path, learnt: LearningResult) -> dict[Path, str]:
    named = named_files(learnt.texts, out.stem, out.suffix)
    return {out.with_name(name): text for name, text in named.items()}


def _write(program: CommandContext, out: Path, learnt: LearningResult, recorded: Definitions) -> None:
    files = _files(out, learnt)
    for path in files:
        if path.exists():
            raise program.usage_error(f"{path} already exists: name a new file with --output")
    for name in _needed(learnt, recorded):
        path = out.parent / BESIDE / f"{name}.msg"
        text = recorded.message(name).text
        if path.exists() and program.read_text(path) != text:
            raise program.usage_error(
                f"{path} already exists and differs from the definition in the recordings"
            )
        files[path] = text
    try:
        for path, text in files.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            program.write(path, text.encode("utf-8", "surrogateescape"))
    except OSError as error:
        raise program.usage_error(f"cannot write {out}: {error.strerror}") from error


def _needed(learnt: LearningResult, recorded: Definitions) -> list[str]:
    own = standard_definitions()
    waiting = [learnt.types[topic] for candidate in learnt.candidates for topic in candidate.topics]
    found: set[str] = set()
    while waiting:
        name = waiting.pop()
        if name in found or name in BUILTINS:
            continue
        try:
            if own.fingerprint(name) == recorded.fingerprint(name):
                continue
        except DefinitionError:
            pass  # not a type of ROS itself
        found.add(name)
        waiting += [field.type for field in recorded.message(name).fields]
    return sorted(found)
