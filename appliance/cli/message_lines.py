"""Print the fields of a message as rostopic does."""

from collections.abc import Iterator, Mapping

from rosmop.tool.terminal import printable


def lines_of(value: object, depth: int) -> Iterator[str]:
    """Yield the lines of a value, without control characters."""
    indent = "  " * depth
    if isinstance(value, Mapping):
        for name, inner in value.items():
            if _is_deep(inner):
                yield f"{indent}{printable(str(name))}:"
                yield from lines_of(inner, depth + 1)
            else:
                yield f"{indent}{printable(str(name))}: {_plain(inner)}"
    elif isinstance(value, list) and _is_deep(value):
        for row in value:
            first, *rest = lines_of(row, 0)
            yield f"{indent}- {first}"
            yield from (f"{indent}  {line}" for line in rest)
    else:
        yield indent + _plain(value)


def _is_deep(value: object) -> bool:
    return isinstance(value, Mapping) or (isinstance(value, list) and any(map(_is_deep, value)))


def _plain(value: object) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_plain, value))}]"
    return printable(str(value))
