"""Make a guard of an older version again from the present preset, with its topics and values."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

from appliance.features.guards.plans import planned
from appliance.features.guards.presets import (
    PRESETS,
    GuardError,
    Parameter,
    name_in,
    preset_of,
    text_of,
    topics_in,
    types_in,
    values_in,
)
from appliance.features.guards.released import order_of, origin_of, released
from appliance.features.guards.robot_graph import TopicFacts
from rosmop.form.switch_words import Word


@dataclass(frozen=True)
class Upgrade:
    """The new text; `changed` has the values that differ, before and after, and `warnings` what to consider."""

    text: str
    changed: Mapping[str, list[str]]
    warnings: list[str]


def upgraded(
    text: str,
    in_force: Mapping[str, str],
    graph: Iterable[TopicFacts],
    topics: Mapping[str, str] = MappingProxyType({}),
    switch: Word | None = None,
) -> Upgrade:
    """Return the upgrade of a guard, whose constants have the values `in_force`; `topics` replace those that it has.

    `switch` is the word of its new file.

    Raises `GuardError` if the text is not that of an older version, or if a value that was set cannot be kept.
    """
    loaded, name = preset_of(text), name_in(text)
    origin = origin_of(text)
    if loaded is None or origin == "changed":
        raise GuardError(
            f"the text of {name} was changed after it was made, so its changes would be lost: compare it with the"
            f" preset; to replace it, remove it, and make it again"
        )
    preset = PRESETS[loaded.name]
    if origin == "current":
        raise GuardError(f"{name} has the present version of its preset: {preset.name} {preset.version}")
    before = released(loaded.name, loaded.version)
    standard = values_in(before.text)
    values, changed, warnings = {}, {}, []
    known = {parameter.name: parameter for parameter in preset.parameters}
    for each, value in {**values_in(text), **in_force}.items():
        was_set = not same(value, standard.get(each, ""))
        obstacle = _obstacle(known.get(each), value)
        if obstacle and was_set:
            raise GuardError(
                f"{name}: {each}={value} cannot be kept: {preset.name} {preset.version} {obstacle}; set it to its"
                f" default first: rosrv guard set {name} {each}={standard.get(each, '')}"
            )
        if obstacle:
            changed[each] = [value, known[each].default if each in known else ""]
            continue
        values[each] = value
        if not same(value, known[each].default):
            source = "" if was_set else ", the default of the older version"
            warnings.append(f"{each}={value} is kept{source}; the default is now {known[each].default}")
    for each, parameter in known.items():
        if each not in values and each not in changed:
            changed[each] = ["", parameter.default]
    try:
        types = {each: kind for each, kind in types_in(text).items() if each not in topics}
        only = {each: kinds[0] for each, kinds in preset.topics.items() if len(kinds) == 1}
        types = only | {each: kind for each, kind in types.items() if each in preset.topics}
        guard = planned(preset, name, {**topics_in(text), **topics}, graph, values, types)
        guard = replace(guard, switch=switch)
    except GuardError as error:
        raise GuardError(f"{name}: {error}; or remove it, and make it again") from error
    return Upgrade(text_of(guard) + order_of(text), changed, warnings)


def same(one: str, other: str) -> bool:
    try:
        return float(one) == float(other)
    except ValueError:
        return one == other


def _obstacle(parameter: Parameter | None, value: str) -> str:
    if parameter is None:
        return "has no such value"
    try:
        parameter.checked(value)
    except GuardError as error:
        return f"does not allow it: {error}"
    return ""
