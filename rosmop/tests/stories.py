"""Stories about specifications: messages and other steps, each with its outcome.

    # The title of a story, which names its test
    % on_fault=pass shadows=a slices=2        how the set is made
    a() { … }                                the specifications; `--- b.rv` begins another file
    > start                                  the outcome of the start, if the story lists it
    > 1s /t data=5 header.seq=1              a message: its time, its topic, and its fields that are not zero
    > 1s request /set data=True              a request, or a response
    > 1500ms                                 time passes without a message
    > 2s switch a off | 2s resume a | 2s restart | value a n | due | give | 2s shadows
    > 2s load                                the set is replaced by the following lines with `+`
    + a() { … }

The lines of its outcome (`lines_of`) follow each step. Interpreter, engine and module must have the same outcome.
"""

import ast
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import pytest

from rosmop.check.sources import compiled_from
from rosmop.run.engine import MonitorSet
from rosmop.run.outcomes import Outcome, binding
from rosmop.tests import acting
from rosmop.tests.interpreted import beside
from rosmop.tests.on_module import on_module
from rosmop.tests.random_specifications import definitions

UNITS = {"s": 10**9, "ms": 10**6, "ns": 1}


@dataclass(frozen=True)
class Step:
    words: str
    loaded: str
    expected: tuple[str, ...]


@dataclass(frozen=True)
class Story:
    title: str
    options: dict[str, str]
    text: str
    steps: tuple[Step, ...]


def stories(path: Path) -> pytest.MarkDecorator:
    found = [
        _story(text) for text in re.split(r"^# ", path.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    ]
    return pytest.mark.parametrize("story", found, ids=lambda story: story.title)


def _story(text: str) -> Story:
    title, _, rest = text.partition("\n")
    before, *steps = re.split(r"^> ", rest, flags=re.MULTILINE)
    lines = before.strip("\n").split("\n")
    given = " ".join(line[2:] for line in lines if line.startswith("% "))
    return Story(
        title,
        dict(option.split("=") for option in given.split()),
        "\n".join(line for line in lines if not line.startswith("% ")),
        tuple(map(_step, steps)),
    )


def _step(text: str) -> Step:
    words, *lines = text.strip("\n").split("\n")
    loaded = [line[2:] for line in lines if line.startswith("+ ")]
    return Step(words, "\n".join(loaded), tuple(line for line in lines if not line.startswith("+ ")))


def files_of(text: str) -> dict[str, str]:
    first, *others = re.split(r"^--- (.*)\n", text, flags=re.MULTILINE)
    return {"x.rv": first, **dict(zip(others[::2], others[1::2], strict=True))}


def tell(story: Story) -> Iterator[tuple[Step, list[str]]]:
    options = story.options
    compiled = compiled_from(files_of(story.text), definitions())
    on_fault: Any = options.get("on_fault", "drop")
    shadows = [options["shadows"]] if "shadows" in options else []
    limits: dict[str, Any] = {"slices": int(options["slices"])} if "slices" in options else {}
    sets = [MonitorSet.of(compiled, on_fault, shadows=shadows, **limits)]
    if not shadows and not limits:
        sets += [beside(sets[0]), on_module(compiled, on_fault)]
    began = [lines_of(one.start(0), one) for one in sets]
    for step in story.steps:
        found = began if step.words == "start" else []
        if step.words != "start":
            for place, one in enumerate(sets):
                sets[place], lines = _done(one, step, judged=place == 2)
                found.append(lines)
        assert all(_without_places(lines) == _without_places(found[0]) for lines in found), (step, found)
        yield step, found[0]


def _without_places(lines: Sequence[str]) -> list[str]:
    return [re.sub(r" at \d\S*", "", line) for line in lines]


def _done(monitors: MonitorSet, step: Step, *, judged: bool) -> tuple[MonitorSet, list[str]]:
    first, *words = step.words.split(" ")
    outcomes: Sequence[Outcome] = ()
    kind = ""
    match first, *words[:1]:
        case "value", monitor:
            return monitors, [repr(monitors.value(monitor, words[1]))]
        case "due", *_:
            return monitors, ["-" if monitors.next_due is None else shown(monitors.next_due)]
        case "give", *_:
            tapped, monitors.tapped[:] = list(monitors.tapped), []
            kinds = [monitors.type_of(one.resource, shadowed=True) or "" for one in tapped]
            told = [lines_of(one.give(), monitors, kind) for one, kind in zip(tapped, kinds, strict=True)]
            return monitors, [line for lines in told for line in lines]
        case time, "restart":
            outcomes = [monitors.start(nanoseconds(time), restarted=True)]
        case time, "resume":
            monitors.resume(words[1])
        case time, "switch":
            monitors.switch({words[1]: words[2] == "on"}, nanoseconds(time))
        case time, "load":
            following = MonitorSet.of(compiled_from(files_of(step.loaded), definitions()), monitors.on_fault)
            outcomes = [following.succeed(monitors, nanoseconds(time))]
            monitors = following
        case time, "shadows":
            outcomes = [each for shadow in monitors.shadows for each in shadow.advance(nanoseconds(time))]
        case time, "request" | "response" as part:
            kind = f"{monitors.service_type_of(words[1], shadowed=True)} {part}"
            body = body_of(kind, words[2:])
            outcomes = [monitors.process_service(words[1], part, body, nanoseconds(time))]
        case time, topic:
            kind = monitors.type_of(topic, shadowed=True) or "std_msgs/Empty"
            process = monitors.judge if judged else monitors.process
            outcomes = [process(topic, bytearray(body_of(kind, words[1:])), nanoseconds(time))]
        case (time,):
            outcomes = monitors.advance(nanoseconds(time))
    return monitors, [line for outcome in outcomes for line in lines_of(outcome, monitors, kind)]


def body_of(kind: str, given: Sequence[str]) -> bytes:
    pairs = [field.split("=", 1) for field in given]
    if pairs and pairs[0][0] == "hex":
        return bytes.fromhex(pairs[0][1])
    return acting.message(kind, **{path.replace(".", "__"): _read(value) for path, value in pairs})


def _read(value: str) -> object:
    try:
        return ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return value.replace("␠", " ")


def fields_of(kind: str, data: bytes) -> str:
    """Return the fields that are not zero, by another library's decoder, and check its encoder.

    A space in a string is `␠`. Parts of services are in bytes.
    """
    if " " in kind:
        return f"hex={data.hex()}"
    value = acting.fields(kind, data)
    package, _, name = kind.partition("/")
    assert bytes(acting.STORE.serialize_ros1(value, f"{package}/msg/{name}")) == data
    return " ".join(_fields("", value)) or "(zero)"


def _fields(path: str, value: Any) -> Iterator[str]:
    if is_dataclass(value):
        for field in fields(value):
            if field.name.startswith("__") or field.name.isupper():  # the type, and constants
                continue
            yield from _fields(f"{path}.{field.name}" if path else field.name, getattr(value, field.name))
    elif hasattr(value, "tolist") or isinstance(value, list):
        items = value.tolist() if hasattr(value, "tolist") else value
        if items and is_dataclass(items[0]):
            for place, item in enumerate(items):
                yield f"{path}[{place}]"
                yield from _fields(f"{path}[{place}]", item)
        elif any(items):
            yield f"{path}={items!r}".replace(" ", "")
    elif value:
        yield f"{path}={value}".replace(" ", "␠")


def lines_of(outcome: Outcome, monitors: MonitorSet, kind: str = "") -> list[str]:
    lines = [line for one in outcome.before for line in lines_of(one, monitors)]
    head: str = outcome.result
    if outcome.result == "changed":
        head += f" {fields_of(kind, bytes(outcome.buffer))} by {', '.join(outcome.changed_by)}"
        head += f" at {','.join(f'{position.line}:{position.column}' for position in outcome.changed_at)}"
    if outcome.result == "dropped":
        head += f" by {outcome.dropped_by}"
        head += f" at {outcome.dropped_at.line}:{outcome.dropped_at.column}" if outcome.dropped_at else ""
    if outcome.timer:
        head = f"{shown(outcome.time)} {outcome.timer}"
    head += f": {' '.join(outcome.events)}" if outcome.events else ""
    head += f" ({outcome.reason})" if outcome.reason else ""
    lines += [head] * bool(kind or outcome.timer)
    lines += [
        f"    {verdict.monitor} {verdict.property + 1} {verdict.logic}{binding(verdict)}: {verdict.category}"
        for verdict in outcome.verdicts
    ]
    lines += [f"    {one.level} {one.monitor}: {one.text}" for one in outcome.log]
    lines += [
        f"    {one.monitor} calls {one.topic} {one.type} hex={one.data.hex()}"
        if one.is_call
        else f"    {one.monitor} publishes {one.topic} {one.type} {fields_of(one.type, one.data)}"
        for one in outcome.published
    ]
    return lines + [
        f"    fault of {fault.monitor} at {fault.position.line}:{fault.position.column}: {fault.text}"
        f" {' '.join(f'{name}={value}' for name, value in fault.values.items())}".rstrip()
        for fault in outcome.faults
    ]


def nanoseconds(text: str) -> int:
    number = text.rstrip("msn")
    return int(number) * UNITS[text.removeprefix(number)]


def shown(time: int) -> str:
    return next(f"{time // size}{unit}" for unit, size in UNITS.items() if time % size == 0)
