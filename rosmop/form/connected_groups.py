"""What belongs together, however indirectly."""

from collections.abc import Collection, Iterable, Mapping, Sequence


def sharing(uses: Mapping[str, Collection[str]]) -> list[set[str]]:
    """Specifications by those that share variables, however indirectly; `uses` says whose each one uses."""
    names = list(uses)
    return [
        {names[number] for number in group} for group in connected([(name, *uses[name]) for name in names])
    ]


def connected(keys: Sequence[Iterable[object]]) -> Iterable[Sequence[int]]:
    """The numbers of what has keys in common, however indirectly, in order."""
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


def way_of(service: str, part: str) -> str:
    """What stands for the `request` or `response` (the `part`) of a service where topics stand: none has a blank."""
    return f"{service} {part}"
