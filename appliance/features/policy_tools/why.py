"""Explain a record in a few lines: author, events, values, location in the specification, recording."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from appliance.audit.log.events import MONITOR_ACTIONS
from appliance.audit.log.record import AuditRecord
from appliance.audit.log.record_format import LogEntry, rfc3339, rule_text
from appliance.base.actors import actor
from appliance.base.counted import counted
from rosmop.run.why_lines import lines_of_why

_TALLIES = ("reasons", "hosts", "callers", "resources", "calls")
"""The counts by name in a summary of repetitions (`repetition.py`)."""


def lines_of(
    record: AuditRecord, in_full: LogEntry | None = None, host_in_words: Callable[[str], str] = str
) -> Iterator[str]:
    """The caller must escape untrusted text. `in_full` is the first event, if this record counts repetitions."""
    yield from _own_lines(record, host_in_words)
    yield from _counted(record.detail, host_in_words)
    if in_full is not None:
        yield f"the first, in full: record {in_full.sequence}, {rfc3339(in_full.record.time)}"
        yield from (f"  {line}" for line in lines_of(in_full.record, None, host_in_words))


def _counted(detail: Mapping[str, Any], host_in_words: Callable[[str], str]) -> Iterator[str]:
    if "count" not in detail:
        return
    if "monitor" in detail:
        yield f"monitor: {detail['monitor']}"
    times = [
        rfc3339(time) for name in ("first_time", "last_time") if isinstance(time := detail.get(name), int)
    ]
    yield f"counted: {detail['count']}{f', {times[0]} to {times[-1]}' if times else ''}"
    for what in _TALLIES:
        if found := _mapping(detail.get(what)):
            names = {
                host_in_words(name) if what == "hosts" else name: number for name, number in found.items()
            }
            tallies = [f"{name} ({counted(number, 'time')})" for name, number in names.items()]
            yield f"{what}: {', '.join(tallies)}"
    texts = dict.fromkeys(str(detail[name]) for name in ("first_text", "last_text") if name in detail)
    if texts:
        yield f"from first to last: {' … '.join(texts)}"


def _own_lines(record: AuditRecord, host_in_words: Callable[[str], str]) -> Iterator[str]:
    detail = record.detail
    yield record.reason or record.event
    sent = [f"{name} {detail[name]}" for name in ("number", "seq") if name in detail]
    author = detail.get("who")
    by = author and actor(str(author))
    who = [
        str(part)
        for part in (record.caller_id, by, record.host and f"on {host_in_words(record.host)}")
        if part
    ]
    if who or sent:
        message = f"message {', '.join(sent)} of " if sent else ""
        when = f", {rfc3339(record.time)}" if author else ""
        yield f"by: {message}{' '.join(who) or 'unknown'}{when}"
    yield from _of_stop(detail)
    if record.rule is not None:
        yield f"rule: {rule_text(record.rule)}"
    places = _list(detail.get("at"))
    if places:
        yield f"at: {', '.join(map(str, places))}"
    if "timer" in detail:
        yield f"timer: {detail['timer']}"
    events = _list(detail.get("events"))
    if events:
        yield f"events: {', '.join(map(str, events))}"
    for place, values in _mapping(detail.get("conditions")).items():
        yield f"where: {place}{_valued(values)}"
    if values := _valued(detail.get("values")):
        yield f"with: {values.removeprefix(', ')}"
    if "handler" in detail:
        yield f"in the handler of: {detail['handler']}"
    yield from _recorded(record)
    if "withheld" in detail:
        yield "this role may not read contents of messages"
        return
    if "why" in detail:
        yield from lines_of_why(_mapping(detail["why"]))
    is_verdict = record.event == "monitor verdict" or detail.get("would") == "verdict" or "handler" in detail
    if is_verdict and "why" not in detail and "count" not in detail:
        yield "because: the causing events are no longer known, or that second had too many verdicts to record them"


def _of_stop(detail: Mapping[str, Any]) -> Iterator[str]:
    if "cause" in detail:
        yield f"cause: {detail['cause']}"
    for publisher in map(_mapping, _list(detail.get("publishers"))):
        yield f"published by: {publisher.get('node')} on {publisher.get('host')}"


def _recorded(record: AuditRecord) -> Iterator[str]:
    detail = record.detail
    if "not_recorded" in detail:
        yield f"not recorded: {detail['not_recorded']}"
    elif "recording" in detail and "charged_to" in detail and not record.event.startswith("recording "):
        recording = detail["recording"]
        yield f"recorded: in {recording}; rosrv record messages {recording} --at {record.id}"
    elif record.event in MONITOR_ACTIONS:
        yield "not recorded: recorder.triggers did not list this kind of event"


def _valued(values: object) -> str:
    return "".join(f", {name} = {value}" for name, value in _mapping(values).items())


def _mapping(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else {}


def _list(value: object) -> list[Any]:
    return value if isinstance(value, list) else []
