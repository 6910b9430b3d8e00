"""Learn specifications from recordings of normal operation."""

import os
import sys
from dataclasses import asdict
from pathlib import Path

from rosmop.learn.learner import LearningError, LearningResult, learn
from rosmop.tool.bag import RecordedBag
from rosmop.tool.command_context import CommandContext
from rosmop.tool.progress_bar import progress
from rosmop.tool.specification_input import BESIDE
from rosmop.tool.terminal import counted, say, say_json
from roswire.definitions import Definitions
from roswire.errors import DefinitionError
from roswire.message_text import BUILTINS
from roswire.standard import standard_definitions


def learn_monitors(
    program: CommandContext,
    bags: list[Path],
    topics: list[str],
    out: Path | None,
    *,
    hold_out: float,
    as_json: bool,
) -> None:
    """Propose specifications from the recordings, and print or write them."""
    if out is not None and out.exists():
        raise program.usage_error(f"{out} already exists")
    if len({os.path.realpath(bag) for bag in bags}) < len(bags):
        raise program.usage_error("a recording is given twice: it would test itself")
    recordings = [RecordedBag(program, bag, topics or ["*"]) for bag in bags]
    recorded = Definitions({})
    for recording in recordings:
        _check_same(program, recording, recorded)
        recorded = recorded.extended(recording.definitions)
    definitions = standard_definitions().extended(recorded)
    total = sum(recording.message_count for recording in recordings)
    try:
        with progress("learning", lambda: 2 * total, shares_screen=out is None) as advance:
            learnt = learn(recordings, definitions, hold_out, advance)
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
            say(f"alarms on the held-out part: {widened} widened, {len(learnt.left_out)} left out")


def _check_same(program: CommandContext, recording: RecordedBag, others: Definitions) -> None:
    """Reject recordings with different definitions of one type."""
    for kind in set(recording.topics.values()) & set(recording.definitions.message_types):
        if kind in others.message_types and others.md5sum(kind) != recording.definitions.md5sum(kind):
            raise program.usage_error(
                f"{recording.name} has a different definition of {kind} than the recordings before it"
            )


def _say_rows(learnt: LearningResult) -> None:
    for result, rows in (("kept", learnt.candidates), ("left out", learnt.left_out)):
        for candidate in rows:
            say_json({
                "specification": learnt.names.get(candidate.key, ""), "topic": candidate.topic, "kind": candidate.kind,
                "field": candidate.place, "says": candidate.says, "seen": candidate.seen,
                "support": asdict(candidate.support), "held_out_alarms": candidate.alarms,
                "result": "widened" if candidate.widened else result,
            })  # fmt: skip


def _write(program: CommandContext, out: Path, learnt: LearningResult, recorded: Definitions) -> None:
    """Write the specification, and beside it the definitions that are not part of ROS."""
    files = {out: learnt.text}
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
    """Return the message types of the specifications, and of their fields, that `check` would not know."""
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
            pass  # not a type of ROS itself
        found.add(name)
        waiting += [field.type for field in recorded.message(name).fields]
    return sorted(found)
