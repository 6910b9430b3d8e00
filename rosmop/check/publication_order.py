"""Warn of monitors that act on a topic, but do not see messages that another monitor publishes there.

A published message only goes through the monitors after its publisher in the order of all specifications.
"""

from collections.abc import Iterator, Mapping, Sequence

from rosmop.form import nodes
from rosmop.form.compiled import Publication, SpecificationCode
from rosmop.form.findings import Diagnostic


def bypassing(
    specifications: Sequence[SpecificationCode],
    publications: Sequence[Publication],
    functions: Mapping[str, nodes.Function],
) -> Iterator[Diagnostic]:
    places = {one.name: place for place, one in enumerate(specifications)}
    seen: set[tuple[str, str, str]] = set()
    for publication in publications:
        if publication.safe:
            continue
        for earlier in specifications[: places.get(publication.specification, 0)]:
            pair = publication.specification, earlier.name, publication.topic
            if pair in seen or not _acts_on(earlier, publication.topic, functions):
                continue
            seen.add(pair)
            name, topic = publication.specification, publication.topic
            text = (
                f"{name} publishes {topic}, but {earlier.name}, which drops or changes messages there, comes before"
                f" {name} and does not see them: write `order {name} < {earlier.name};`"
            )
            yield Diagnostic(publication.position, "warning", text)


def _acts_on(code: SpecificationCode, topic: str, functions: Mapping[str, nodes.Function]) -> bool:
    events = [event.function for event in code.events if event.topic == topic and event.part is None]
    handlers = [name for each in code.properties for name in each.handlers.values()] if events else []
    return any(
        isinstance(node, nodes.Drop | nodes.StopMessage)
        or (isinstance(node, nodes.WriteBack) and node.writes)
        for name in (*events, *handlers)
        for node in nodes.walk(functions[name])
    )
