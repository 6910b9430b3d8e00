"""Read presets (the reviewed texts in `monitors/guards`) with their parameters, and make guards from them.

The first line of a guard names the preset, its version, the topics and their types.
"""

import functools
import operator
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from ipaddress import ip_network
from pathlib import Path

from appliance.base.shipped import SHIPPED
from appliance.base.user_errors import UserError
from appliance.features.guards import message_types as types
from appliance.features.guards.message_types import TypeRow, text_for
from appliance.features.guards.polygons import fault_of

FOLDER = SHIPPED / "monitors" / "guards"

_GIVEN = re.compile(
    r"^    (?P<kind>double|int|bool|topic) (?P<name>\w+) = (?P<default>[^ ;]+)"
    r"(?: (?P<unit>[\w/]+))?(?: in (?P<least>[-\d.]+?)\.\.(?P<most>[-\d.]+))?;[ ]*"
    r"(?:// (?P<remark>.*?)(?:; safe: (?P<safe>(?:[<>]=?|==) \S+))?)?$",
    re.MULTILINE,
)
_HEAD = re.compile(r"^((?:begin |hold )?)(\w+)\(", re.MULTILINE)
_FIRST_LINE = re.compile(r"// preset (?P<preset>\w+) (?P<version>\d+):.*\n")
_NAME = re.compile(r"[A-Za-z_]\w{0,63}", re.ASCII)
_TABLE = re.compile(r"(\b(\w+)\[\] = \{)[^}]*")
_TOPIC = re.compile(r"/[A-Za-z]\w*+(?:/[A-Za-z]\w*+)*+", re.ASCII)
_NUMBER = r"[-+]?(?:\d++(?:\.\d*+)?|\.\d++)(?:[eE][-+]?\d++)?"
_WHOLE = re.compile(r"[-+]?\d++", re.ASCII)
_DECIMAL = re.compile(_NUMBER, re.ASCII)
_CORNER = rf"{_NUMBER}\s*+,\s*+{_NUMBER}"
_CORNERS = re.compile(rf"\s*+{_CORNER}(?:\s++{_CORNER}){{2,99}}+\s*+", re.ASCII)
_JOINT = rf"[\w/]++:{_NUMBER}\.\.{_NUMBER}"
_JOINTS = re.compile(rf"\s*+{_JOINT}(?:\s++{_JOINT})*+\s*+", re.ASCII)
_TIMEOUT = re.compile(r"(timeout )(\d+(?:\.\d+)?m?s)")
_HOSTS = re.compile(r"(\bwithhold \w+ from )([^;]+?)(?= while )")
_SPAN = re.compile(r"(\d++(?:\.\d++)?)(ms|s)", re.ASCII)


class GuardError(UserError):
    """A guard cannot be made or changed; the message says what to do."""


@dataclass(frozen=True)
class Parameter:
    """A value that operators set."""

    name: str
    kind: str
    default: str
    unit: str = ""
    least: str = ""
    most: str = ""
    what: str = ""
    loads: bool = False
    """Whether it is part of the text, so that a new value loads the guard again."""
    safe: str = ""
    """The values that the standard or good practice asks for, such as `>= 1.6`, or empty if any value is as safe."""

    def falls_below(self, value: str) -> bool:
        """Return whether a value is less safe than `safe`."""
        if not self.safe:
            return False
        sign, bound = self.safe.split(" ")
        if self.kind == "bool":
            return value != bound
        return not _COMPARISONS[sign](float(value), float(bound))

    def checked(self, value: str) -> str:
        if self.kind == "bool":
            if value not in {"true", "false"}:
                raise GuardError(f"{self.name}={value}: write {self.name}=true or {self.name}=false")
            return value
        if self.kind == "hosts":
            return " ".join(_network(self.name, one) for one in value.split() or [value])
        form = _TABLES.get(self.kind)
        if form is not None:
            if not form.fullmatch(value):
                raise GuardError(f"{self.name}={value}: write it like {self.name}='{self.default}'")
            if self.kind == "corners" and (fault := fault_of(_corners(value))):
                raise GuardError(f"{self.name}={value}: {fault}; give the corners in order along the edge")
            return " ".join(value.split())
        if not (_WHOLE if self.kind == "int" else _DECIMAL).fullmatch(value):
            noun = "a whole number" if self.kind == "int" else "a number"
            raise GuardError(f"{self.name}={value}: give {noun}{f', in {self.unit}' if self.unit else ''}")
        if not float(self.least) <= float(value) <= float(self.most):
            unit = f" {self.unit}" if self.unit else ""
            raise GuardError(
                f"{self.name}={value} is outside of {self.least}..{self.most}{unit}: give a number in this range"
            )
        return value


def _corners(value: str) -> list[tuple[float, float]]:
    numbers = [float(number) for number in re.split(r"[\s,]+", value.strip())]
    return list(zip(numbers[::2], numbers[1::2], strict=True))


def _network(name: str, value: str) -> str:
    try:
        return str(ip_network(value))
    except ValueError as error:
        raise GuardError(
            f"{name}={value}: {error}; write it like {name}='10.0.0.7 10.8.0.0/16' (rosrv host list)"
        ) from error


_COMPARISONS = {"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge, "==": operator.eq}
_TABLES = {"corners": _CORNERS, "joints": _JOINTS, "time": _SPAN}
_POLYGON = Parameter(
    "polygon", "corners", "-2,-2 2,-2 2,2 -2,2", "m", what="x and y of each corner", loads=True
)
_ZONE = Parameter(
    "polygon",
    "corners",
    "0.1,-0.4 1,-0.4 1,0.4 0.1,0.4",
    "m",
    what="x and y of each corner, before the scanner",
    loads=True,
)
_LIMITS = Parameter(
    "limits",
    "joints",
    "elbow:-1.5..1.5",
    "rad",
    what="the limits of each joint; default: low and high",
    loads=True,
)
_DEADLINE = Parameter("limit", "time", "120s", what="from a goal to its result", loads=True)
_FROM = Parameter(
    "hosts", "hosts", "0.0.0.0/0 ::/0", what="addresses or networks of hosts; default: all hosts", loads=True
)


@dataclass(frozen=True)
class Preset:
    """A reviewed text in `FOLDER`."""

    name: str
    topics: Mapping[str, Mapping[str, TypeRow]]
    """The rows of each topic with several types."""
    further: tuple[Parameter, ...] = ()
    """The parameters that are part of the text."""
    source: str = field(default="", repr=False)
    """A text of another version, or that of a guard, instead of the present one."""

    @functools.cached_property
    def text(self) -> str:
        return self.source or (FOLDER / f"{self.name}.rv").read_text(encoding="utf-8")

    @property
    def version(self) -> int:
        found = _FIRST_LINE.match(self.text)
        assert found is not None, self.name  # noqa: S101  a test reads every preset
        return int(found["version"])

    @property
    def what(self) -> str:
        return self.text.split("\n", 2)[1].removeprefix("// ")

    @functools.cached_property
    def _given(self) -> "list[re.Match[str]]":
        block, brace, _rest = self.text.partition("\n} {\n")
        return [*_GIVEN.finditer(block)] if brace else []

    @functools.cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        given = (
            Parameter(one["name"], one["kind"], one["default"], one["unit"] or "", one["least"] or "",
                      one["most"] or "", one["remark"] or "", safe=one["safe"] or "")
            for one in self._given if one["kind"] != "topic"
        )  # fmt: skip
        return (*given, *(one for one in self.further if _in_text(self.text, one) is not None))

    @property
    def given_topics(self) -> dict[str, str]:
        return {one["name"]: one["default"] for one in self._given if one["kind"] == "topic"}

    def parameter(self, name: str) -> Parameter:
        for one in self.parameters:
            if one.name == name:
                return one
        known = ", ".join(one.name for one in self.parameters) or "it has none"
        raise GuardError(f"{self.name} has no parameter {name!r}; use one of: {known}")


_MOVES = {"command": types.VELOCITIES}
_ANY = {"command": types.COMMANDS}

PRESETS = {
    one.name: one
    for one in (
        Preset("deadman", _MOVES),
        Preset("speed", _MOVES),
        Preset("separation", {**_MOVES, "by": types.SCANS}),
        Preset("fence", {**_MOVES, "by": types.POSITIONS}, (_POLYGON,)),
        Preset("sensor", {**_ANY, "by": types.SENSORS}),
        Preset("estop", _ANY),
        Preset("arm", {**_ANY, "by": types.BATTERIES}),
        Preset("answer", {"command": types.GOALS, "by": types.RESULTS}, (_DEADLINE,)),
        Preset("joints", {"command": types.TRAJECTORIES, "state": types.JOINTS}, (_LIMITS,)),
        Preset("rate", _MOVES),
        Preset("agree", {**_MOVES, "by": types.MOTIONS, "other": types.MOTIONS}),
        Preset("sane", _MOVES),
        Preset("enable", {**_ANY, "by": types.ENABLERS}),
        Preset("mode", {**_MOVES, "by": types.MODES}),
        Preset("overspeed", {**_MOVES, "by": types.MOTIONS}),
        Preset("standstill", {**_MOVES, "by": types.MOTIONS}),
        Preset("zone", {**_MOVES, "by": types.SCANS}, (_ZONE,)),
        Preset("withhold", {"command": types.PRIVATE, "by": types.SWITCHES}, (_FROM,)),
    )
}

DRIVER_CHECK = Preset("driver_check", {**_MOVES, "by": types.MOTIONS})
"""The monitor that `rosrv guard check-driver` loads for a short time; not a guard."""


@dataclass(frozen=True)
class Guard:
    """A guard to make."""

    name: str
    preset: Preset
    topics: Mapping[str, str] = field(default_factory=dict)
    """The given topics, by the preset's names for them. `types` has the types of their messages."""
    types: Mapping[str, str] = field(default_factory=dict)
    values: Mapping[str, str] = field(default_factory=dict)


def preset_named(name: str) -> Preset:
    if name not in PRESETS:
        raise GuardError(f"there is no preset {name!r}; use one of: {', '.join(PRESETS)}")
    return PRESETS[name]


def text_of(guard: Guard) -> str:
    preset = guard.preset
    if not _NAME.fullmatch(guard.name):
        raise GuardError(f"{guard.name!r} is not a name of a monitor: use letters, digits and _")
    text = preset.text
    for name, topic in guard.topics.items():
        text = _with_topic(preset, text, name, topic)
    for name, kind in guard.types.items():
        row = types.row_of(preset.topics.get(name, {}), kind)
        if row is not None:
            text = text_for(text, name, kind, row)
        elif name in preset.topics:
            raise GuardError(
                f"{guard.topics.get(name, name)} has the type {kind}; {preset.name} works with"
                f" {types.works_with(preset.topics[name])}"
            )
    for name, value in guard.values.items():
        parameter = preset.parameter(name)
        text = _with_value(text, parameter, parameter.checked(value))
    text = _HEAD.sub(rf"\g<1>{guard.name}(", text, count=1)
    return _FIRST_LINE.sub(_first_line(guard), text, count=1)


def below_the_standard(preset: Preset, values: Mapping[str, str]) -> list[str]:
    """Return a sentence for each of the values, by parameter, that is less safe than the preset's standard asks for.

    Parameters without a value have their default, which is safe.
    """
    return [
        f"{one.name}={values[one.name]} is below the standard: {one.safe.removeprefix('== ')}"
        for one in preset.parameters
        if one.name in values and one.falls_below(values[one.name])
    ]


def preset_of(text: str) -> Preset | None:
    """Return the preset of a guard, with the parameters of the guard's own text."""
    found = _FIRST_LINE.match(text)
    preset = PRESETS.get(found["preset"]) if found else None
    return None if preset is None else replace(preset, source=text)


def described(text: str) -> str:
    return text.split("\n", 1)[0].removeprefix("// ")


def topics_in(text: str) -> dict[str, str]:
    return {name: topic for name, topic, _kind in _made_for(text)}


def types_in(text: str) -> dict[str, str]:
    return {name: kind for name, _topic, kind in _made_for(text) if kind}


def _made_for(text: str) -> Iterator[tuple[str, str, str]]:
    for one in described(text).partition(": ")[2].split(", "):
        name, _, rest = one.partition("=")
        topic, _, kind = rest.partition(" ")
        yield name, topic, kind


def loaded_values(text: str) -> dict[str, str]:
    """Return the values of the parameters that are part of the text."""
    preset = preset_of(text)
    return {one.name: _in_text(text, one) or "" for one in (preset.parameters if preset else ()) if one.loads}


def values_in(text: str) -> dict[str, str]:
    """Return all values of a guard's text, except limits of joints that it does not have."""
    preset = preset_of(text)
    given = {one.name: one.default for one in (preset.parameters if preset else ()) if not one.loads}
    return given | {name: value for name, value in loaded_values(text).items() if value}


def name_in(text: str) -> str:
    found = _HEAD.search(text)
    return found[2] if found else ""


def _in_text(text: str, parameter: Parameter) -> str | None:
    """Return the value of a parameter that is part of the text, or null if the text does not have it."""
    tables = {found[2]: found[0].partition("{")[2].split(", ") for found in _TABLE.finditer(text)}
    match parameter.kind:
        case "corners":
            cells = tables.get("POLYGON")
            if cells is None:
                return None
            return " ".join(f"{x},{y}" for x, y in zip(cells[::2], cells[1::2], strict=False))
        case "joints":
            if not tables.keys() >= {"NAMES", "LOW", "HIGH"}:
                return None
            rows = zip(tables["NAMES"], tables["LOW"], tables["HIGH"], strict=False)
            return " ".join(
                f"{joint.strip(chr(34))}:{low}..{high}" for joint, low, high in rows if joint != '""'
            )
        case "hosts":
            hosts = _HOSTS.search(text)
            return hosts and hosts[2].replace('"', "").replace(",", "")
    found = _TIMEOUT.search(text)
    return found and found[2]


def plain(text: str, base: Preset) -> str:
    """Return a guard's text with the name, topics and values of a version of its preset, and without its first line.

    Raises `GuardError` for a value or topic that the version does not allow, or that is not the same everywhere.
    """
    topics, values = topics_in(text), values_in(text)
    given = (preset_of(text) or base).given_topics
    if any(given.get(name) != topic or not _TOPIC.fullmatch(topic) for name, topic in topics.items()):
        raise GuardError("the first line names other topics than the text")
    known = (
        base.given_topics | {"cancel": f"{topics.get('command', '').removesuffix('/goal')}/cancel"} | topics
    )
    if any(known.get(name) != topic for name, topic in given.items()):
        raise GuardError("the text has further topics")
    checked = {name: base.parameter(name).checked(value) for name, value in values.items()}
    if with_values(text, checked) != text:
        raise GuardError("a value is not the same everywhere")
    for name, topic in base.given_topics.items():
        text = _given(text, "topic", name, topic)
    text = _given(text, "topic", "cancel", "/cancel")
    for name, value in (
        {one.name: one.default for one in base.parameters} | loaded_values(base.text)
    ).items():
        text = _with_value(text, base.parameter(name), value)
    text = _HEAD.sub(rf"\g<1>{base.name}(", text, count=1)
    return text.partition("\n")[2]


def with_values(text: str, values: Mapping[str, str]) -> str:
    preset = preset_of(text)
    if preset is None:
        raise GuardError(
            "it was not made from a preset; change its text, and load it with rosrv monitor load"
        )
    for name, value in values.items():
        parameter = preset.parameter(name)
        text = _with_value(text, parameter, parameter.checked(value))
    return text


def _first_line(guard: Guard) -> str:
    topics = ", ".join(
        f"{name}={topic} {guard.types[name]}" if name in guard.types else f"{name}={topic}"
        for name, topic in (guard.preset.given_topics | dict(guard.topics)).items()
    )
    return f"// preset {guard.preset.name} {guard.preset.version}: {topics}\n"


def _with_topic(preset: Preset, text: str, name: str, topic: str) -> str:
    if name not in preset.given_topics:
        known = ", ".join(preset.given_topics)
        raise GuardError(f"no topic {name!r} is given to {preset.name}; there are: {known}")
    if not _TOPIC.fullmatch(topic):
        raise GuardError(f"{topic!r} is not the name of a topic; write it like /cmd_vel")
    return _given(text, "topic", name, topic)


def _with_value(text: str, parameter: Parameter, value: str) -> str:
    match parameter.kind:
        case "corners":
            return _with_table(text, "POLYGON", re.split("[ ,]+", value))
        case "hosts":
            networks = ", ".join(f'"{one}"' for one in value.split())
            return _HOSTS.sub(lambda found: found[1] + networks, text)
        case "time":
            return _TIMEOUT.sub(rf"\g<1>{value}", text)
        case "joints":
            rows = [re.split(r":|\.\.", row) for row in value.split()]
            for table, place in (("NAMES", 0), ("LOW", 1), ("HIGH", 2)):
                cells = [f'"{row[place]}"' if place == 0 else row[place] for row in rows]
                text = _with_table(text, table, cells)
            return text
    return _given(text, parameter.kind, parameter.name, value)


def _given(text: str, kind: str, name: str, value: str) -> str:
    return _value_of(kind, name).sub(lambda found: found[1] + value, text)


@functools.cache
def _value_of(kind: str, name: str) -> re.Pattern[str]:
    """Return the pattern of one value: that of all values takes a millisecond for a text, and a guard has twenty."""
    return re.compile(rf"(\b{kind} {name} = )[^ ;]+")


def _with_table(text: str, name: str, cells: Sequence[str]) -> str:
    return _TABLE.sub(lambda found: found[1] + ", ".join(cells) if found[2] == name else found[0], text)


def file_of(name: str, folder: Path) -> Path:
    return folder / f"{name}.rv"
