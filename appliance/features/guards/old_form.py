"""Read guards of releases before 0.4, which have their types and values all over their texts.

They keep working, and `rosrv guard upgrade` makes them again with a `preset` statement. This module, its uses, and the
table `released/texts.sha256` go with 0.5.
"""

from collections.abc import Mapping
from dataclasses import dataclass

_FIRST = "// preset "
_LISTS = {
    "fence": ("corners", "polygon"),
    "joints": ("joints", "limits"),
    "answer": ("time", "limit"),
    "withhold": ("hosts", "hosts"),
}
"""The kind and the name of the list of a preset."""
_TABLES = ("NAMES[] = {", "LOW[] = {", "HIGH[] = {")
_POLYGON = "POLYGON[] = {"
_TIMEOUT, _LATE = "timeout ", " ->"
_FROM, _WHILE = "withhold command from ", " while "


@dataclass(frozen=True)
class Head:
    """The `preset` statement of a guard. Topics with their types, and values, are its `settings`."""

    preset: str
    version: int
    name: str
    settings: Mapping[str, str]
    switch: str = ""
    """`on`, `shadow`, `off` or empty."""


def head_of(text: str) -> Head | None:
    """Return the head of a guard whose first line is `// preset NAME VERSION: topic=/name type, …`."""
    line, _, rest = text.partition("\n")
    words, colon, topics = line.removeprefix(_FIRST).partition(": ")
    preset, _, version = words.partition(" ")
    if not line.startswith(_FIRST) or not colon or not version.isdecimal():
        return None
    settings = dict(pair.split("=", 1) for pair in topics.split(", ") if "=" in pair)
    code = (one for one in rest.split("\n") if one and not one.startswith("//"))
    name = next(code, "").partition("(")[0].split()
    value = list_in(text, preset)
    if value is not None:
        settings[_LISTS[preset][1]] = value
    return Head(preset, int(version), name[-1] if name else "", settings)


def list_of(preset: str) -> tuple[str, str] | None:
    return _LISTS.get(preset)


def list_in(text: str, preset: str) -> str | None:
    """Return the polygon, joints, deadline or hosts in a source, as `rosrv guard set` takes them now; None without."""
    match _LISTS.get(preset, ("", ""))[0]:
        case "corners":
            cells = _between(text, _POLYGON, "}").split(", ")
            return " ".join(f"{x},{y}" for x, y in zip(cells[::2], cells[1::2], strict=False))
        case "joints":
            names, lows, highs = (_between(text, table, "}").split(", ") for table in _TABLES)
            rows = zip(names, lows, highs, strict=False)
            return (
                " ".join(f"{name.strip(chr(34))}:{low}..{high}" for name, low, high in rows if name != '""')
                or "none"
            )
        case "time":
            return _between(text, _TIMEOUT, _LATE)
        case "hosts":
            return _between(text, _FROM, _WHILE).replace('"', "").replace(",", "")
    return None


def with_values(text: str, values: Mapping[str, str]) -> str:
    """Return the text with other values, which are valid."""
    head = head_of(text)
    kind, name = _LISTS.get(head.preset, ("", "")) if head else ("", "")
    for each, value in values.items():
        text = _with_list(text, kind, value) if each == name else _with_constant(text, each, value)
    return text


def with_topic(text: str, name: str, topic: str) -> str:
    return _with_constant(text, name, topic) if f" topic {name} = " in text else text


def with_name(text: str, name: str) -> str:
    head = head_of(text)
    return text.replace(f"{head.name}(", f"{name}(", 1) if head else text


def _with_list(text: str, kind: str, value: str) -> str:
    match kind:
        case "corners":
            return _put(text, _POLYGON, "}", value.replace(",", " ").replace(" ", ", "))
        case "joints":
            words = ":0..0" if value == "none" else value
            rows = [row.replace("..", ":").split(":") for row in words.split()]
            for place, table in enumerate(_TABLES):
                cells = [f'"{row[place]}"' if place == 0 else row[place] for row in rows]
                text = _put(text, table, "}", ", ".join(cells))
            return text
        case "time":
            return _put(text, _TIMEOUT, _LATE, value)
    return _put(text, _FROM, _WHILE, ", ".join(f'"{one}"' for one in value.split()))


def _with_constant(text: str, name: str, value: str) -> str:
    sign = f" {name} = "
    _before, _, after = text.partition(" given {")[2].partition(sign)
    present = after.partition(";")[0].partition(" ")[0]
    return text.replace(f"{sign}{present}", f"{sign}{value}", 1)


def _between(text: str, begin: str, end: str) -> str:
    return text.partition(begin)[2].partition(end)[0]


def _put(text: str, begin: str, end: str, value: str) -> str:
    before, sign, after = text.partition(begin)
    return f"{before}{sign}{value}{end}{after.partition(end)[2]}" if sign else text
