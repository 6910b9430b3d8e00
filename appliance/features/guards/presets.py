"""Read presets, the typed specifications in `monitors/guards`, and make guards from them.

A guard's file begins with a `preset` statement: the preset and its version, the guard's name, topics, types and values.
The text of the preset follows it, unchanged.
"""

import functools
import operator
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from pathlib import Path

from appliance.base.shipped import SHIPPED
from appliance.base.user_errors import UserError
from appliance.base.validation_messages import meant
from appliance.channel.rest_bodies import NOTE_LENGTH
from rosmop.form.switch_words import Word
from rosmop.types import given_lists
from rosmop.types.roles import ANY_TYPE, types_of_roles

FOLDER = SHIPPED / "monitors" / "guards"

_NAME = re.compile(r"[A-Za-z_]\w{0,63}", re.ASCII)
_TOPIC = re.compile(r"(?:/\w++)++", re.ASCII)
_TYPE = re.compile(r"[A-Za-z]\w*+/[A-Za-z]\w*+", re.ASCII)
_WHOLE = re.compile(r"[-+]?\d++", re.ASCII)
_DECIMAL = re.compile(r"[-+]?(?:\d++(?:\.\d*+)?|\.\d++)(?:[eE][-+]?\d++)?", re.ASCII)
_COMPARISONS = {"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge, "==": operator.eq}


@dataclass(frozen=True)
class Head:
    """The `preset` statement of a guard. Topics with their types, and values, are its `settings`."""

    preset: str
    version: int
    name: str
    settings: Mapping[str, str]
    switch: str = ""
    """`on`, `shadow`, `off` or empty."""


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
    safe: str = ""
    """The values that the standard or good practice asks for, such as `>= 1.6`, or empty if any value is as safe."""

    @property
    def loads(self) -> bool:
        """Whether it is a value of the guard's file, so that another one loads the file again."""
        return self.kind in given_lists.EXAMPLES

    def falls_below(self, value: str) -> bool:
        """Return whether a value is less safe than `safe`."""
        if not self.safe:
            return False
        sign, bound = self.safe.split(" ")
        if self.kind == "bool":
            return value != bound
        return not _COMPARISONS[sign](float(value), float(bound))

    def check(self, value: str) -> str:
        if self.kind == "bool":
            if value not in {"true", "false"}:
                raise GuardError(f"{self.name}={value}: write {self.name}=true or {self.name}=false")
            return value
        if self.loads:
            try:
                return given_lists.normalise(self.kind, value)
            except ValueError as error:
                why = f"{error}; " if str(error) else ""
                example = f"write it like {self.name}='{given_lists.EXAMPLES[self.kind]}'"
                raise GuardError(f"{self.name}={value}: {why}{example}") from error
        if not (_WHOLE if self.kind == "int" else _DECIMAL).fullmatch(value):
            noun = "a whole number" if self.kind == "int" else "a number"
            raise GuardError(f"{self.name}={value}: give {noun}{f', in {self.unit}' if self.unit else ''}")
        if not float(self.least) <= float(value) <= float(self.most):
            unit = f" {self.unit}" if self.unit else ""
            raise GuardError(
                f"{self.name}={value} is outside of {self.least}..{self.most}{unit}: give a number in this range"
            )
        return value


@dataclass(frozen=True)
class Preset:
    """A typed specification in `FOLDER`."""

    name: str
    source: str = field(default="", repr=False)
    """A text of another version, or that of a guard, instead of the present one."""

    @functools.cached_property
    def text(self) -> str:
        return self.source or (FOLDER / f"{self.name}.rv").read_text(encoding="utf-8")

    @property
    def body(self) -> str:
        """The text behind its `preset` statement."""
        return body_of(self.text)

    @property
    def version(self) -> int:
        head = head_of(self.text)
        assert head is not None, self.name  # noqa: S101  a test reads every preset
        return head.version

    @property
    def what(self) -> str:
        return self.body.split("\n", 1)[0].removeprefix("// ")

    @functools.cached_property
    def _given(self) -> "tuple[tuple[str, Parameter], ...]":
        """The role, or nothing, and the parameter or topic of each line of `given`."""
        block, brace, _rest = self.body.partition("\n} {\n")
        lines = block.partition(" given {\n")[2].split("\n") if brace else []
        return tuple(given for given in map(_read_given, lines) if given is not None)

    @functools.cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(given for _role, given in self._given if given.kind != "topic")

    @property
    def given_topics(self) -> dict[str, str]:
        return {given.name: given.default for _role, given in self._given if given.kind == "topic"}

    @functools.cached_property
    def topics(self) -> Mapping[str, tuple[str, ...]]:
        """The types of each topic that has a role, the default first."""
        return {given.name: types_of_roles()[role] for role, given in self._given if role}

    def parameter(self, name: str) -> Parameter:
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        known = ", ".join(parameter.name for parameter in self.parameters) or "it has none"
        raise GuardError(f"{self.name} has no parameter {name!r}; use one of: {known}")


def _read_given(line: str) -> tuple[str, Parameter] | None:
    """Return the role and the parameter or topic of a line, or nothing for a line that is written in another way."""
    code, _, remark = line.partition("//")
    what, _, safe = remark.strip().partition("; safe: ")
    declared, _, value = code.strip().removesuffix(";").partition(" = ")
    match declared.replace(" : ", " ").split():
        case ["topic", name, *role] if value:
            return "".join(role), Parameter(name, "topic", value)
        case [kind, name] if kind in given_lists.EXAMPLES and value:
            return "", Parameter(name, kind, *given_lists.without_unit(kind, value), what=what)
        case ["bool", name]:
            return "", Parameter(name, "bool", value, what=what, safe=safe)
        case ["double" | "int" as kind, name]:
            default, _, bounds = value.partition(" in ")
            number, _, unit = default.partition(" ")
            least, _, most = bounds.partition("..")
            if all(map(_DECIMAL.fullmatch, (number, least, most))):
                return "", Parameter(name, kind, number, unit, least, most, what, safe)
    return None


PRESETS = {
    name: Preset(name)
    for name in (
        "deadman", "speed", "separation", "fence", "sensor", "estop", "ready", "answer", "joints", "rate", "agree",
        "sane", "hold_to_run", "mode", "overspeed", "standstill", "zone", "diagnostics", "withhold",
    )
}  # fmt: skip

RENAMED = {"arm": "ready", "enable": "hold_to_run"}
"""The presets that were called otherwise up to 0.4: texts with the old names are guards still."""

DRIVER_CHECK = Preset("driver_check")
"""The monitor that `rosrv guard check-driver` loads for a short time; not a guard."""


@dataclass(frozen=True)
class Guard:
    name: str
    preset: Preset
    topics: Mapping[str, str] = field(default_factory=dict)
    """The given topics, by the preset's names for them. `types` has the types of their messages."""
    types: Mapping[str, str] = field(default_factory=dict)
    values: Mapping[str, str] = field(default_factory=dict)
    switch: Word | None = None
    """How it begins on an appliance that does not know it; without it, as the setting `enable` says."""


def is_former(text: str) -> bool:
    """Return whether `rosrv guard` of a release before 0.4 made it: it is a monitor now, not a guard."""
    return text.startswith("// preset ")


def former_guard(name: str, file: str) -> str:
    return (
        f"{name} is a guard of a release before 0.4: it stays in force as a monitor, which no verb of guards changes;"
        f" make a guard of another --name in its place (rosrv guard new), then remove it (rosrv monitor remove {file})"
    )


def unknown_guard(name: str, guards: Collection[str]) -> str:
    known = f"the guards are: {', '.join(guards)}" if guards else "none is loaded: see rosrv guard suggest"
    return f"no guard is named {name[:80]}{meant(name, guards)}; {known}"


def preset_named(name: str) -> Preset:
    name = RENAMED.get(name, name)
    if name not in PRESETS:
        raise GuardError(
            f"there is no preset {name!r}{meant(name, PRESETS)}; use one of: {', '.join(PRESETS)}"
        )
    return PRESETS[name]


def works_with(types: tuple[str, ...]) -> str:
    return ", ".join("any other type by its silence alone" if kind == ANY_TYPE else kind for kind in types)


def text_of(guard: Guard) -> str:
    """Return the text of a guard's file. Raises `GuardError` for a name, topic, type or value that is not allowed."""
    preset = guard.preset
    if not _NAME.fullmatch(guard.name):
        raise GuardError(f"{guard.name!r} is not a name of a monitor: use letters, digits and _")
    topics = preset.given_topics | dict(guard.topics)
    for name, topic in topics.items():
        _require_topic(preset, name, topic)
        if same := [other for other in topics if topics[other] == topic and other != name]:
            raise GuardError(
                f"{preset.name} needs two topics for {name} and {same[0]}, and {topic} is given for both"
            )
    types = {name: types[0] for name, types in preset.topics.items()}
    for name, kind in guard.types.items():
        if name in types:
            _require_type(preset, name, kind, topics[name])
            types[name] = kind
    settings = {name: f"{topic} {types[name]}" if name in types else topic for name, topic in topics.items()}
    settings |= {name: preset.parameter(name).check(value) for name, value in guard.values.items()}
    head = head_of(preset.text)
    assert head is not None  # noqa: S101  a test reads every preset
    return _write(replace(head, name=guard.name, settings=settings, switch=guard.switch or ""), preset.body)


def _require_topic(preset: Preset, name: str, topic: str) -> None:
    if name not in preset.given_topics:
        known = ", ".join(preset.given_topics)
        raise GuardError(f"no topic {name!r} is given to {preset.name}; there are: {known}")
    if not _TOPIC.fullmatch(topic):
        raise GuardError(f"{topic!r} is not the name of a topic; write it like /cmd_vel")


def _require_type(preset: Preset, name: str, kind: str, topic: str) -> None:
    types = preset.topics[name]
    if kind not in types and not (ANY_TYPE in types and _TYPE.fullmatch(kind)):
        near = get_close_matches(kind, types, 1, 0.8)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise GuardError(f"{topic} has the type {kind}; {preset.name} works with {works_with(types)}{hint}")


def _write(head: Head, body: str) -> str:
    settings = "".join(f"    {name} = {value};\n" for name, value in head.settings.items())
    switch = f" {head.switch}" if head.switch else ""
    return f"preset {head.preset} {head.version} as {head.name}{switch} {{\n{settings}}}\n{body}"


def head_of(text: str) -> Head | None:
    """Return what the `preset` statement of a text says, or nothing if the text does not begin with one."""
    statement, _rest = _divide(text)
    words = statement.partition("{")[0].rstrip("; ").split()
    if words[:1] != ["preset"] or len(words) < 3 or not words[2].isdecimal():
        return None
    if words[3:4] != ["as"]:
        return Head(words[1], int(words[2]), words[1], {})
    settings = {}
    for setting in statement.partition("{")[2].split(";"):
        name, sign, value = setting.partition("=")
        if sign:
            settings[name.strip()] = " ".join(value.split())
    return Head(words[1], int(words[2]), "".join(words[4:5]), settings, "".join(words[5:6]))


def body_of(text: str) -> str:
    """Return the text behind its `preset` statement."""
    return _divide(text)[1]


def _divide(text: str) -> tuple[str, str]:
    """Return the `preset` statement without remarks and its end, or the first line; and the text behind it."""
    first, _, rest = text.partition("\n")
    if not first.startswith("preset ") or " as " not in first.partition("//")[0]:
        return first.partition("//")[0], rest
    statement, end = "", 0
    for line in text.split("\n"):
        code, brace, _ = line.partition("//")[0].partition("}")
        statement += f"{code} "
        if brace:
            return statement, text[end + len(code) + 1 :].removeprefix("\n")
        end += len(line) + 1
    return statement, ""


def preset_of(text: str) -> Preset | None:
    """Return the preset of a guard, with the parameters of the guard's own text."""
    head = head_of(text)
    preset = PRESETS.get(RENAMED.get(head.preset, head.preset)) if head else None
    return None if preset is None else replace(preset, source=text)


def below_the_standard(preset: Preset, values: Mapping[str, str]) -> list[str]:
    """Return a sentence for each of the values, by parameter, that is less safe than the preset's standard asks for.

    Parameters without a value have their default, which is safe.
    """
    return [
        f"{one.name}={values[one.name]} is below the standard: {one.safe.removeprefix('== ')}"
        for one in preset.parameters
        if one.name in values and one.falls_below(values[one.name])
    ]


def description_of(text: str) -> str:
    head = head_of(text)
    if head is None:
        return ""
    topics, types = topics_in(text), types_in(text)
    made_for = ", ".join(f"{name}={topic} {types.get(name, '')}".rstrip() for name, topic in topics.items())
    return f"preset {head.preset} {head.version}: {made_for}"[:NOTE_LENGTH]


def topics_in(text: str) -> dict[str, str]:
    return {name: topic for name, (topic, _type) in _made_for(text).items()}


def types_in(text: str) -> dict[str, str]:
    return {name: kind for name, (_topic, kind) in _made_for(text).items() if kind}


def _made_for(text: str) -> dict[str, tuple[str, str]]:
    head = head_of(text)
    if head is None:
        return {}
    default = {}
    if (preset := preset_of(text)) is not None:
        default = {
            name: f"{topic} {preset.topics.get(name, ('',))[0]}"
            for name, topic in preset.given_topics.items()
        }
    settings = {name: value for name, value in head.settings.items() if value.startswith("/")}
    named = default.keys() or settings.keys()  # names of entries may also begin with /
    pairs = ((name, value.partition(" ")) for name, value in (default | settings).items() if name in named)
    return {name: (topic, kind) for name, (topic, _, kind) in pairs}


def loaded_values(text: str) -> dict[str, str]:
    """Return the values of the parameters that another load of the file changes."""
    preset, head = preset_of(text), head_of(text)
    if preset is None or head is None:
        return {}
    return {one.name: head.settings.get(one.name, one.default) for one in preset.parameters if one.loads}


def values_in(text: str) -> dict[str, str]:
    """Return all values of a guard's text."""
    preset, head = preset_of(text), head_of(text)
    if preset is None or head is None:
        return {}
    return {one.name: head.settings.get(one.name, one.default) for one in preset.parameters}


def name_in(text: str) -> str:
    head = head_of(text)
    return head.name if head else ""


def with_values(text: str, values: Mapping[str, str]) -> str:
    preset, head = preset_of(text), head_of(text)
    if preset is None or head is None:
        raise GuardError(
            "it was not made from a preset; change its source, and load it with rosrv monitor load"
        )
    checked = {name: preset.parameter(name).check(value) for name, value in values.items()}
    return _write(replace(head, settings={**head.settings, **checked}), body_of(text))


def keeps_state(text: str, names: Collection[str]) -> bool:
    """Whether a guard keeps its state when these parameters are set."""
    preset = preset_of(text)
    kinds = {preset.parameter(name).kind for name in names} if preset else set()
    return kinds.isdisjoint({"joints", "time", "entries"})


def file_of(name: str, folder: Path) -> Path:
    return folder / f"{name}.rv"
