"""Write the causes of a verdict, as records have them, for people. It imports nothing that runs specifications."""

from collections.abc import Iterator, Mapping


def lines_of_why(why: Mapping[str, object]) -> Iterator[str]:
    events = _list(why.get("events"))
    if not why:
        return
    if not events:
        yield "because: no event was needed: time has passed"
    between = why.get("left_out")
    for number, event in enumerate(events):
        if between and number == len(events) // 2:
            yield f"because: … {between} more …"
        yield f"because: {_named(event if isinstance(event, dict) else {})}"
    if "since" in why:
        yield (
            f"but: this is enough only for the property as it was at {why['since']}; earlier events are not kept"
        )
    if why.get("fewest") is False:
        yield "but: fewer of them might suffice"
    for part in _list(why.get("decided")):
        yield f"so: {part}"


def _named(event: Mapping[str, object]) -> str:
    index = f" #{event['index']}" if "index" in event else ""
    seq = f" seq {event['seq']}" if "seq" in event else ""
    who = "".join(
        f", {word} {event[name]}"
        for name, word in (("on", "on"), ("node", "by"), ("host", "on"))
        if event.get(name)
    )
    state = f" -> {event['state']}" if event.get("state") else ""
    return f"{event.get('event')}{index} at {event.get('time')}{who}{seq}{state}"


def _list(value: object) -> list[object]:
    return value if isinstance(value, list) else []
