"""Why what a record tells happened, in a few lines for people: who, which events, which values, which line."""

from collections.abc import Iterator, Mapping
from typing import Any

from appliance.audit.record import Record
from appliance.audit.record_format import rule_text


def lines_of(record: Record) -> Iterator[str]:
    """The lines; strangers' text is in them as it is."""
    detail = record.detail
    yield record.reason or record.event
    sent = [f"{name} {detail[name]}" for name in ("number", "seq") if name in detail]
    who = [part for part in (record.caller_id, record.host and f"on {record.host}") if part]
    if who or sent:
        message = f"message {', '.join(sent)} of " if sent else ""
        yield f"by: {message}{' '.join(who) or 'nobody'}"
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
    if "withheld" in detail:
        yield "what messages said is not for this role"
        return
    yield from lines_of_why(_mapping(detail.get("why")))
    is_verdict = record.event == "monitor verdict" or detail.get("would") == "verdict" or "handler" in detail
    if is_verdict and "why" not in detail and "count" not in detail:
        yield "because: which events made it so is not known any more, or too many verdicts were told in that second"


def lines_of_why(why: Mapping[str, Any]) -> Iterator[str]:
    """The events of an explanation, and how far they explain it."""
    events = _list(why.get("events"))
    if not why:
        return
    if not events:
        yield "because: no event was needed: time has passed"
    between = why.get("left_out")
    for number, event in enumerate(events):
        if between and number == len(events) // 2:
            yield f"because: … {between} more …"
        yield f"because: {named(_mapping(event))}"
    if "since" in why:
        yield (
            f"but: this is enough only for the property as it was at {why['since']}; what came before is not kept"
        )
    if why.get("fewest") is False:
        yield "but: fewer of them might do"
    for part in _list(why.get("decided")):
        yield f"so: {part}"


def named(event: Mapping[str, Any]) -> str:
    """One event: what, when, whose message, and the state that it led to."""
    index = f" #{event['index']}" if "index" in event else ""
    seq = f" seq {event['seq']}" if "seq" in event else ""
    who = "".join(
        f", {word} {event[name]}"
        for name, word in (("on", "on"), ("node", "by"), ("host", "on"))
        if event.get(name)
    )
    state = f" -> {event['state']}" if event.get("state") else ""
    return f"{event.get('event')}{index} at {event.get('time')}{who}{seq}{state}"


def _valued(values: object) -> str:
    return "".join(f", {name} = {value}" for name, value in _mapping(values).items())


def _mapping(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else {}


def _list(value: object) -> list[Any]:
    return value if isinstance(value, list) else []
