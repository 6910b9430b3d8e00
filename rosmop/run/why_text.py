"""Formats the events of an explanation (`explanations.why_of`), one line each."""

from collections.abc import Iterator, Mapping
from typing import Any


def lines_of_why(why: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each event of an explanation, and a line that says how far the events explain the verdict."""
    events = list_of(why.get("events"))
    if not why:
        return
    if not events:
        yield "because: no event was needed: time has passed"
    between = why.get("left_out")
    for number, event in enumerate(events):
        if between and number == len(events) // 2:
            yield f"because: … {between} more …"
        yield f"because: {named(mapping_of(event))}"
    if "since" in why:
        yield (
            f"but: this is enough only for the property as it was at {why['since']}; earlier events are not kept"
        )
    if why.get("fewest") is False:
        yield "but: fewer of them might suffice"
    for part in list_of(why.get("decided")):
        yield f"so: {part}"


def named(event: Mapping[str, Any]) -> str:
    """Return one event: name, time, sender, and the state after it."""
    index = f" #{event['index']}" if "index" in event else ""
    seq = f" seq {event['seq']}" if "seq" in event else ""
    who = "".join(
        f", {word} {event[name]}"
        for name, word in (("on", "on"), ("node", "by"), ("host", "on"))
        if event.get(name)
    )
    state = f" -> {event['state']}" if event.get("state") else ""
    return f"{event.get('event')}{index} at {event.get('time')}{who}{seq}{state}"


def mapping_of(value: object) -> Mapping[str, Any]:
    """Return the value if it is a mapping, otherwise an empty mapping."""
    return value if isinstance(value, dict) else {}


def list_of(value: object) -> list[Any]:
    """Return the value if it is a list, otherwise an empty list."""
    return value if isinstance(value, list) else []
