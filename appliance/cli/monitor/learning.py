"""`rosrv monitor learn`: specifications out of recordings of a robot that behaves."""

import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from appliance.base.input_files import read_given_text
from appliance.cli.monitor.bag import Recorded
from appliance.cli.monitor.monitor_program import MONITOR
from appliance.cli.output import Json, say_json, write_told
from appliance.cli.progress_bar import progress
from rosmop.learn.learner import LearningError, Learnt, learn
from rosmop.tool.options import Bags
from rosmop.tool.specification_input import BESIDE
from rosmop.tool.terminal import counted, say
from roswire.definitions import Definitions
from roswire.errors import DefinitionError
from roswire.message_text import BUILTINS
from roswire.standard import standard_definitions


def learn_monitors(
    bags: Bags,
    topics: Annotated[
        list[str] | None,
        typer.Option("--topic", metavar="PATTERN", help="Only such topics, as /arm/* (repeatable)"),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.rv", help="Write it here (must not exist), definitions into msg/ beside it"
        ),
    ] = None,
    hold_out: Annotated[
        float, typer.Option(min=0.0, max=0.9, help="The share of the recordings that is its test")
    ] = 0.3,
    as_json: Json = False,
) -> None:
    """Propose specifications out of recordings of a robot that behaves, for a person to edit.

    Example: rosrv monitor learn --bag monday.bag --bag tuesday.bag --out learnt.rv
    """
    if out is not None and out.exists():
        raise MONITOR.usage_error(f"{out} is there already")
    if len({os.path.realpath(bag) for bag in bags}) < len(bags):
        raise MONITOR.usage_error("a recording is given twice: it would be its own test")
    recordings = [Recorded(bag, topics or ["*"]) for bag in bags]
    recorded = Definitions({})
    for recording in recordings:
        _check_same(recording, recorded)
        recorded = recorded.extended(recording.definitions)
    definitions = standard_definitions().extended(recorded)
    total = sum(recording.message_count for recording in recordings)
    try:
        with progress("learning", lambda: 2 * total, shares_screen=out is None) as told:
            learnt = learn(recordings, definitions, hold_out, told)
    except LearningError as error:
        raise MONITOR.usage_error(str(error)) from error
    if out is not None:
        _write(out, learnt, recorded)
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


def _check_same(recording: Recorded, others: Definitions) -> None:
    """A type has one definition in all recordings, or their messages would be read wrongly."""
    for kind in set(recording.topics.values()) & set(recording.definitions.message_types):
        if kind in others.message_types and others.md5sum(kind) != recording.definitions.md5sum(kind):
            raise MONITOR.usage_error(
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


def _write(out: Path, learnt: Learnt, recorded: Definitions) -> None:
    """The text, and beside it the definitions that are not ROS's own."""
    files = {out: learnt.text}
    for name in _needed(learnt, recorded):
        path = out.parent / BESIDE / f"{name}.msg"
        text = recorded.message(name).text
        if path.exists() and read_given_text(path, errors="surrogateescape") != text:
            raise MONITOR.usage_error(f"{path} is there already and is another than the recordings have")
        files[path] = text
    try:
        for path, text in files.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_told(path, text.encode("utf-8", "surrogateescape"))
    except OSError as error:
        raise MONITOR.usage_error(f"cannot write {out}: {error.strerror}") from error


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
