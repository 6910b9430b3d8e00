"""Learn specifications from recordings of a robot that behaves."""

import os
import sys
from dataclasses import asdict
from pathlib import Path

from rosmop.learn.learner import LearningError, Learnt, learn
from rosmop.tool.bag import Recorded
from rosmop.tool.program import Program
from rosmop.tool.progress_bar import progress
from rosmop.tool.specification_input import BESIDE
from rosmop.tool.terminal import counted, say, say_json
from roswire.definitions import Definitions
from roswire.errors import DefinitionError
from roswire.message_text import BUILTINS
from roswire.standard import standard_definitions


def learn_monitors(
    program: Program,
    bags: list[Path],
    topics: list[str],
    out: Path | None,
    *,
    hold_out: float,
    as_json: bool,
) -> None:
    """Propose specifications from recordings of a robot that behaves."""
    if out is not None and out.exists():
        raise program.usage_error(f"{out} is there already")
    if len({os.path.realpath(bag) for bag in bags}) < len(bags):
        raise program.usage_error("a recording is given twice: it would be its own test")
    recordings = [Recorded(program, bag, topics or ["*"]) for bag in bags]
    recorded = Definitions({})
    for recording in recordings:
        _check_same(program, recording, recorded)
        recorded = recorded.extended(recording.definitions)
    definitions = standard_definitions().extended(recorded)
    total = sum(recording.message_count for recording in recordings)
    try:
        with progress("learning", lambda: 2 * total, shares_screen=out is None) as told:
            learnt = learn(recordings, definitions, hold_out, told)
    except LearningError as error:
        raise program.usage_error(str(error)) from error
    if out is not None:
        _write(program, out, learnt, recorded)
    if as_json:
        _say_rows(learnt)
    elif out is None:
        sys.stdout.write(learnt.text)
    else:
        conditions, names = counted(len(learnt.candidates), "condition"), set(learnt.names.values())
        say(f"{conditions} in {counted(len(names), 'specification')}: {out}")
        widened = sum(1 for candidate in learnt.candidates if candidate.widened)
        if learnt.held_out:
            say(f"alarms on what was held out: {widened} widened, {len(learnt.left_out)} left out")


def _check_same(program: Program, recording: Recorded, others: Definitions) -> None:
    """A type has one definition in all recordings, or their messages would be read wrongly."""
    for kind in set(recording.topics.values()) & set(recording.definitions.message_types):
        if kind in others.message_types and others.md5sum(kind) != recording.definitions.md5sum(kind):
            raise program.usage_error(
                f"{recording.name} has another definition of {kind} than the recordings before it"
            )


def _say_rows(learnt: Learnt) -> None:
    for result, rows in (("kept", learnt.candidates), ("left out", learnt.left_out)):
        for candidate in rows:
            say_json({
                "specification": learnt.names.get(candidate.key, ""), "topic": candidate.topic, "kind": candidate.kind,
                "field": candidate.place, "says": candidate.says, "seen": candidate.seen,
                "support": asdict(candidate.support), "held_out_alarms": candidate.alarms,
                "result": "widened" if candidate.widened else result,
            })  # fmt: skip


def _write(program: Program, out: Path, learnt: Learnt, recorded: Definitions) -> None:
    """The text, and beside it the definitions that are not ROS's own."""
    files = {out: learnt.text}
    for name in _needed(learnt, recorded):
        path = out.parent / BESIDE / f"{name}.msg"
        text = recorded.message(name).text
        if path.exists() and program.read_text(path) != text:
            raise program.usage_error(f"{path} is there already and is another than the recordings have")
        files[path] = text
    try:
        for path, text in files.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            program.write(path, text.encode("utf-8", "surrogateescape"))
    except OSError as error:
        raise program.usage_error(f"cannot write {out}: {error.strerror}") from error


def _needed(learnt: Learnt, recorded: Definitions) -> list[str]:
    """The types of the specifications, and those that they are made of, that `check` would not know."""
    own = standard_definitions()
    waiting = [learnt.types[topic] for candidate in learnt.candidates for topic in candidate.topics]
    found: set[str] = set()
    while waiting:
        name = waiting.pop()
        if name in found or name in BUILTINS:
            continue
        try:
            if own.md5sum(name) == recorded.md5sum(name):
                continue
        except DefinitionError:
            pass  # not one of ROS's own
        found.add(name)
        waiting += [field.type for field in recorded.message(name).fields]
    return sorted(found)
