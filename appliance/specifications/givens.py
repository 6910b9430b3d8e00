"""Check and keep the values that operators gave to monitors: constants while they run, topics at a load. No I/O.

A value stays until its monitor is removed, or until a new text no longer declares it or its range.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from msgspec.structs import replace

from appliance.channel.answers.monitor_answers import GivenState
from appliance.channel.messages import GivenValue
from appliance.specifications.specification_files import CheckedSpecifications, SpecificationsRefusedError

Given = Mapping[str, Mapping[str, GivenValue]]

_TOPIC = "topic"
_NOT_DECLARED = "not declared"


class DroppedValue(NamedTuple):
    """A given value that the new file does not allow, and the default that applies instead."""

    monitor: str
    name: str
    value: GivenValue
    now: GivenValue

    @property
    def text(self) -> str:
        return (
            f"{self.monitor}: {self.name}={_shown(self.value)} no longer applies, because the source does not allow it:"
            f" the default of the source is in force; rosrv monitor set {self.monitor} prints it"
        )


@dataclass(frozen=True, slots=True)
class Givens:
    """The values given to monitors; `said` has them by monitor and name. Topics belong to a revision's sources."""

    said: Given = field(default_factory=dict)

    def giving(self, values: Given) -> "Givens":
        """Return these values with others in addition to them, or in place of those with the same name."""
        return Givens(
            {**self.said, **{name: {**self.said.get(name, {}), **new} for name, new in values.items()}}
        )

    def in_force(self, checked: CheckedSpecifications) -> dict[str, dict[str, GivenValue]]:
        found = {
            monitor: {
                one.name: values[one.name] for one in declared if one.name in values and _holds(one, values)
            }
            for monitor, declared in checked.givens.items()
            if (values := self.said.get(monitor, {}))
        }
        return {monitor: values for monitor, values in found.items() if values}

    def dropped_values(self, checked: CheckedSpecifications) -> list[DroppedValue]:
        kept = self.in_force(checked)
        own = {monitor: {row.name: row.value for row in rows} for monitor, rows in checked.givens.items()}
        return [
            DroppedValue(monitor, name, value, own.get(monitor, {}).get(name, _NOT_DECLARED))
            for monitor, values in self.said.items()
            for name, value in values.items()
            if monitor in checked.monitors and name not in kept.get(monitor, {})
        ]

    def states(self, checked: CheckedSpecifications, monitor: str) -> list[GivenState]:
        said = self.said.get(monitor, {})
        return [replace(one, value=said.get(one.name, one.value)) for one in checked.givens.get(monitor, ())]


def parse(
    declared: tuple[GivenState, ...], monitor: str, values: Mapping[str, GivenValue]
) -> dict[str, GivenValue]:
    """Return the values to set. Raises `SpecificationsRefusedError` with all errors."""
    known = {one.name: one for one in declared}
    found: dict[str, GivenValue] = {}
    findings = []
    for name, value in values.items():
        one = known.get(name)
        if one is None:
            names = (
                f"there are: {', '.join(known)}"
                if known
                else "it declares none (`given` in its specification)"
            )
            findings.append(f"{monitor} has no given {name}; {names}")
        elif one.kind == _TOPIC:
            text = f"{monitor}: {name} is a topic, which only a load can replace, because the state belongs to a topic"
            findings.append(f"{text}: rosrv monitor load FILE --set {monitor}.{name}={_shown(value)}")
        elif (number := _value(one, value)) is None:
            findings.append(f"{monitor}: {name}={_shown(value)} {_allowed(one)}")
        else:
            found[name] = number
    if findings:
        raise SpecificationsRefusedError(findings)
    return found


def split(given: Given) -> tuple[dict[str, dict[str, str]], dict[str, dict[str, GivenValue]]]:
    """Divide given values into constants and topics; a string that begins with `/` is a topic."""
    topics: dict[str, dict[str, str]] = {}
    constants: dict[str, dict[str, GivenValue]] = {}
    for monitor, values in given.items():
        for name, value in values.items():
            if isinstance(value, str) and value.startswith("/"):
                topics.setdefault(monitor, {})[name] = value
            else:
                constants.setdefault(monitor, {})[name] = value
    return topics, constants


def require_topics(topics: Mapping[str, Mapping[str, str]], checked: CheckedSpecifications) -> None:
    """Raise `SpecificationsRefusedError` for each topic that is given to no monitor, or under an unknown name."""
    findings = [
        f"no topic {name} is given to {monitor}, so {topic} replaces none; see rosrv monitor set {monitor}"
        for monitor, given in topics.items()
        for name, topic in given.items()
        if not any(one.kind == _TOPIC and one.name == name for one in checked.givens.get(monitor, ()))
    ]
    if findings:
        raise SpecificationsRefusedError(findings)


def _value(declared: GivenState, value: GivenValue) -> GivenValue | None:
    if declared.kind == "bool":
        words = {"true": True, "false": False}
        found = words.get(value) if isinstance(value, str) else value
        return found if isinstance(found, bool) else None
    if isinstance(value, bool):
        return None
    if isinstance(value, str):
        text = value.strip().removesuffix(declared.unit).strip()
        try:
            value = int(text)
        except ValueError:
            try:
                value = float(text)
            except ValueError:
                return None
    if not math.isfinite(value) or (declared.kind == "int" and value != int(value)):
        return None
    number = int(value) if declared.kind == "int" else float(value)
    least, most = declared.least, declared.most
    return number if least is not None and most is not None and least <= number <= most else None


def _holds(declared: GivenState, values: Mapping[str, GivenValue]) -> bool:
    return declared.kind != _TOPIC and _value(declared, values[declared.name]) is not None


def _allowed(declared: GivenState) -> str:
    unit = f" {declared.unit}" if declared.unit else ""
    if declared.kind == "bool":
        return "is not true or false"
    word = "a whole number" if declared.kind == "int" else "a number"
    return f"is outside of {_shown(declared.least)}..{_shown(declared.most)}{unit}: give {word} in this range"


def with_unit(value: GivenValue, unit: str) -> str:
    return f"{_shown(value)} {unit}".strip()


def _shown(value: GivenValue | None) -> str:
    return (
        str(value).lower()
        if isinstance(value, bool)
        else f"{value:g}"
        if isinstance(value, float)
        else str(value)
    )
