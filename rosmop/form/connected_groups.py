"""Group items that are connected, directly or indirectly."""

from collections.abc import Collection, Iterable, Mapping, Sequence


def sharing(uses: Mapping[str, Collection[str]]) -> list[set[str]]:
    """Group specifications; `uses` maps each to those whose variables it uses."""
    names = list(uses)
    return [
        {names[number] for number in group} for group in connected([(name, *uses[name]) for name in names])
    ]


def connected(keys: Sequence[Iterable[object]]) -> Iterable[Sequence[int]]:
    owners: dict[object, int] = {}
    chief = list(range(len(keys)))

    def find(number: int) -> int:
        while chief[number] != number:
            chief[number] = number = chief[chief[number]]
        return number

    for number, own in enumerate(keys):
        for key in own:
            chief[find(number)] = find(owners.setdefault(key, number))
    together: dict[int, list[int]] = {}
    for number in range(len(keys)):
        together.setdefault(find(number), []).append(number)
    return together.values()


def channel_of(service: str, part: str) -> str:
    """Return the name of a part of a service in place of a topic. It contains a blank, which no topic does."""
    return f"{service} {part}"
