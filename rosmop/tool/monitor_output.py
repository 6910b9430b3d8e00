"""Print findings, and the outcome of every message of a recording."""

from collections.abc import Iterator
from dataclasses import asdict

from rosmop.batch.replay_job import because, place_of
from rosmop.form.findings import Diagnostic
from rosmop.run.monitor import MonitorInstance
from rosmop.run.outcomes import Fault, Outcome, binding, why_of
from rosmop.tool.terminal import say, say_json

BILLION = 1_000_000_000


def say_finding(finding: Diagnostic, *, as_json: bool) -> None:
    if not as_json:
        say(str(finding), "red" if finding.severity == "error" else "yellow")
        return
    say_json({**asdict(finding.position), "severity": finding.severity, "text": finding.text})


def record(
    outcome: Outcome, index: int | None = None, topic: str | None = None, publisher: str = ""
) -> dict[str, object]:
    head: dict[str, object] = {"timer": outcome.timer}
    if topic is not None:
        head = {"publisher": publisher, "topic": topic} if publisher else {"index": index, "topic": topic}
    head["time"] = outcome.time / BILLION
    head["outcome"] = outcome.result
    return head | {
        "events": list(outcome.events),
        "verdicts": [
            {
                "monitor": verdict.monitor,
                "property": verdict.property,
                "logic": verdict.logic,
                "category": verdict.category,
                **({"binding": dict(verdict.binding)} if verdict.binding else {}),
                **why_of(verdict, place_of),
            }
            for verdict in outcome.verdicts
        ],
        "published": [
            {"service" if message.is_call else "topic": message.topic, "type": message.type}
            for message in outcome.published
        ],
        "log": [{"level": line.level, "text": line.text, "monitor": line.monitor} for line in outcome.log],
        "faults": [_fault(fault) for fault in outcome.faults],
    }


def explain(monitor: MonitorInstance) -> Iterator[str]:
    slices, slicing = monitor.slices, monitor.code.slicing
    if slices is None or slicing is None:
        return
    for number, (name, _, kind) in enumerate(slicing.parameters):
        events = [event.name for event in monitor.code.events if number in event.binds]
        yield f"parameter {name} ({kind}), bound by {', '.join(events)}"
    begins = ", ".join(event.name for event in monitor.code.events if event.creates)
    names = ", ".join(name for name, _, _ in slicing.parameters)
    yield f"a slice for each {names}, begun by {begins}; at most {slices.limit} at a time"


def _fault(fault: Fault) -> dict[str, object]:
    return {**asdict(fault.position), "text": fault.text, "values": dict(fault.values)}


def lines(
    outcome: Outcome, index: int | None = None, topic: str | None = None, publisher: str = ""
) -> Iterator[str]:
    seconds = f"{outcome.time / BILLION:.3f}"
    number = f"published by {publisher}:" if publisher else f"#{index}"
    head = f"{seconds} {outcome.timer}" if topic is None else f"{seconds} {number} {topic}"
    if topic is not None and outcome.result != "passed":
        yield f"{head}: {outcome.result}" + (f" ({outcome.reason})" if outcome.reason else "")
    for verdict in outcome.verdicts:
        name = f"{verdict.monitor} ({verdict.logic} property {verdict.property})"
        yield f"{head}: {verdict.category} of {name}{binding(verdict)}"
        yield from (f"{head}:   {line}" for line in because(verdict))
    for message in outcome.published:
        yield f"{head}: {'called' if message.is_call else 'published'} {message.topic} {message.type}"
    for line in outcome.log:
        yield f"{head}: {line.level} {line.monitor}: {line.text}"
    for fault in outcome.faults:
        values = ", ".join(f"{name} = {value}" for name, value in fault.values.items())
        yield f"{head}: fault at {fault.position}: {fault.text}" + (f" ({values})" if values else "")
