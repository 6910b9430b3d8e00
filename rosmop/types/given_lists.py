"""Read the values of given lists: corners of a polygon, limits of joints, names of entries, hosts, and times.

An invalid value raises `ValueError` with the reason, which may be empty.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from ipaddress import ip_network
from itertools import combinations, pairwise
from types import MappingProxyType

# Check that the corners of a fence enclose one area: with crossing edges, a part inside would count as outside.

Corner = tuple[float, float]


def fault_of(corners: Sequence[Corner]) -> str:
    edges = [edge for edge in pairwise([*corners, corners[0]]) if edge[0] != edge[1]]
    if not edges or all(_turn(*edges[0], corner) == 0 for corner in corners):
        return "the corners are on one line"
    if any(_cross(*edge, *other) for edge, other in combinations(edges, 2)):
        return "edges cross"
    return ""


def _turn(a: Corner, b: Corner, c: Corner) -> int:
    """Return 1 if `c` is to the left of the line from `a` to `b`, -1 if it is to the right, 0 if it is on it."""
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    return (area > 0) - (area < 0)


def _cross(a: Corner, b: Corner, c: Corner, d: Corner) -> bool:
    """Return whether two edges cross. Edges that only touch, as neighbours do, do not cross."""
    return _turn(a, b, c) * _turn(a, b, d) < 0 and _turn(c, d, a) * _turn(c, d, b) < 0


EXAMPLES: Mapping[str, str] = MappingProxyType(
    {
        "corners": "-2,-2 2,-2 2,2 -2,2",
        "joints": "elbow:-1.5..1.5",
        "entries": "Battery, Laser: *, hardware_id:0815",
        "time": "120s",
        "hosts": "10.0.0.7 10.8.0.0/16",
    }
)
"""An example for each kind of list."""
NO_JOINTS = "none"
_MAX_CORNERS = 100
_NUMBER = re.compile(r"[-+]?(?:\d++(?:\.\d*+)?|\.\d++)(?:[eE][-+]?\d++)?", re.ASCII)
_JOINT = re.compile(r"[\w/]++", re.ASCII)
_ENTRY = re.compile(r"(hardware_id:)?([^;={},\"\\\x00-\x1f*]{0,200})(\*?)")
_MAX_ENTRIES = 16
_SPAN = re.compile(r"(\d{1,9}+(?:\.\d{1,9}+)?)(ms|s)", re.ASCII)


def corners(value: str) -> tuple[tuple[str, str], ...]:
    """Return x and y of each corner, as numbers of the language."""
    pairs = [word.split(",") for word in value.replace(" ,", ",").replace(", ", ",").split()]
    if not 3 <= len(pairs) <= _MAX_CORNERS or any(len(pair) != 2 for pair in pairs):
        raise ValueError
    found = tuple((number(x), number(y)) for x, y in pairs)
    if fault := fault_of([(float(x), float(y)) for x, y in found]):
        raise ValueError(f"{fault}; give the corners in order along the edge")
    return found


def joints(value: str) -> tuple[tuple[str, str, str], ...]:
    """Return name, lower and upper limit of each joint."""
    if value == NO_JOINTS:
        return ()
    rows: list[tuple[str, str, str]] = []
    for word in value.split():
        name, _, limits = word.partition(":")
        low, dots, high = limits.partition("..")
        if not dots or not _JOINT.fullmatch(name):
            raise ValueError
        if any(name == row[0] for row in rows):
            raise ValueError(f"{name} occurs twice")
        if float(number(low)) > float(number(high)):
            raise ValueError(f"the lower limit of {name} is above the upper one")
        rows.append((name, low, high))
    if not rows:
        raise ValueError
    return tuple(rows)


def entries(value: str) -> tuple[tuple[str, str], ...]:
    """Return each text, and where entries have it: 0: name, 1: its beginning, 2: hardware_id, 3: its beginning."""
    rows: list[tuple[str, str]] = []
    for word in value.split(","):
        match = _ENTRY.fullmatch(word.strip())
        if match is None or not match[2] + match[3] or "//" in match[2] or "/*" in match[2]:
            raise ValueError
        rows.append((match[2], str(2 * bool(match[1]) + bool(match[3]))))
    if len(rows) > _MAX_ENTRIES:
        raise ValueError(f"at most {_MAX_ENTRIES} entries can be named")
    return tuple(rows)


def hosts(value: str) -> tuple[str, ...]:
    """Return the networks; an address is one too."""
    if not value.split():
        raise ValueError
    return tuple(str(ip_network(word)) for word in value.split())


def nanoseconds(value: str) -> int:
    span = _SPAN.fullmatch(value)
    time = Fraction(span[1]) * (10**6 if span[2] == "ms" else 10**9) if span else Fraction()
    if time.denominator != 1 or time <= 0:
        raise ValueError
    return int(time)


def number(text: str) -> str:
    """Return the text of a finite number."""
    if not _NUMBER.fullmatch(text) or not math.isfinite(float(text)):
        raise ValueError
    return text


_READERS: Mapping[str, Callable[[str], object]] = {
    "corners": corners,
    "joints": joints,
    "entries": entries,
    "time": nanoseconds,
    "hosts": hosts,
}


def normalise(kind: str, value: str) -> str:
    """Return the value in one form. Raises `ValueError` if it is not one of the kind."""
    _READERS[kind](value)
    if kind == "hosts":
        return " ".join(hosts(value))
    if kind == "corners":
        return " ".join(",".join(corner) for corner in corners(value))
    return " ".join(value.split())


def without_unit(kind: str, text: str) -> tuple[str, str]:
    """Return the value and the unit of a default, such as `-2,-2 2,-2 2,2 m`."""
    value, _, unit = text.rpartition(" ")
    if kind in ("corners", "joints") and value and unit.isalpha():
        return value.strip(), unit
    return text, ""
