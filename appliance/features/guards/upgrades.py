"""Make a guard of an older version again from the present preset, with its topics and values."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from difflib import get_close_matches
from types import MappingProxyType

from appliance.features.guards.presets import (
    PRESETS,
    Guard,
    GuardError,
    Parameter,
    Preset,
    name_in,
    preset_of,
    text_of,
    topics_in,
    types_in,
    values_in,
    works_with,
)
from appliance.features.guards.released import order_of, origin_of, released_preset
from appliance.features.guards.robot_graph import MAX_TOPICS, VALUED, TopicFacts
from rosmop.form.switch_words import Word

# Choose topics and types for a new guard from the graph, and refuse a guard that the graph contradicts.

_UNKNOWN = "*"  # the type of a topic that has only subscribers which do not know it


def plan(  # noqa: PLR0917  one caller
    preset: Preset,
    name: str,
    topics: Mapping[str, str],
    graph: Iterable[TopicFacts],
    values: Mapping[str, str],
    kinds: Mapping[str, str],
) -> Guard:
    """Return the guard to make, or raise `GuardError`. `kinds` are the user's types for topics that no node has yet."""
    known = {one.name: one.type for one in graph if one.type != _UNKNOWN}
    given = preset.given_topics
    for each in kinds:
        if each not in preset.topics:
            why = "always has the same type" if each in given else "is not one of its topics"
            raise GuardError(f"{preset.name}: {each} {why}; give the type of {', '.join(preset.topics)}")
    chosen = dict(topics)
    if preset.name == "answer":
        before = topics["command"].removesuffix("/goal")
        chosen = {"by": f"{before}/result", "cancel": f"{before}/cancel"} | chosen
    types = {}
    for each, fitting in preset.topics.items():
        if each not in chosen and each in given and given[each] not in known:
            raise GuardError(_needed(preset, each, fitting, known))
        topic = chosen.setdefault(each, given[each])
        types[each] = _type_of(topic, each, known, kinds, fitting)
    return Guard(name, preset, chosen, types, _fitting(preset, types, values))


def _fitting(preset: Preset, types: Mapping[str, str], values: Mapping[str, str]) -> Mapping[str, str]:
    """Switch off the comparison of values for a type of which only the time of arrival is known."""
    if preset.name != "sensor" or types["by"] in VALUED:
        return values
    if values.get("frozen", "0") != "0":
        raise GuardError(
            f"of {types['by']} only the silence is judged: leave out frozen; a sensor that works with values has one"
            f" of the types {', '.join(VALUED)}"
        )
    return {"frozen": "0", **values}


def _type_of(
    topic: str, given: str, known: Mapping[str, str], kinds: Mapping[str, str], fitting: tuple[str, ...]
) -> str:
    if topic in known:
        if given in kinds and kinds[given] != known[topic]:
            raise GuardError(f"{topic} has the type {known[topic]} on this robot, not {kinds[given]}")
        return known[topic]
    if given in kinds:
        return kinds[given]
    there = [name for name, kind in known.items() if kind in fitting]
    close = get_close_matches(topic, there[:MAX_TOPICS], 1, 0.5)
    hint = f"; did you mean {close[0]}?" if close else "."
    option = f"{given}={fitting[0]}" if len(fitting) == 1 else f"{given}=TYPE, of {works_with(fitting)}"
    raise GuardError(
        f"no node has the topic {topic} now{hint} If it comes later, give its type: --type {option}"
    )


def _needed(preset: Preset, given: str, fitting: tuple[str, ...], known: Mapping[str, str]) -> str:
    option = "--by" if given == "by" else f"--topic {given}="
    there_are = sorted(name for name, kind in known.items() if kind in fitting)
    there = (
        f"this robot has {', '.join(there_are[:5])}"
        if there_are
        else f"no topic now has a type of {works_with(fitting)}"
    )
    return f"{preset.name} needs a topic for {given}: give {option}{'' if option.endswith('=') else ' '}TOPIC; {there}"


@dataclass(frozen=True)
class Upgrade:
    """The new text; `changed` has the values that differ, before and after, and `warnings` what to consider."""

    text: str
    changed: Mapping[str, list[str]]
    warnings: list[str]


def upgrade_of(
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
    before = released_preset(loaded.name, loaded.version)
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
        guard = plan(preset, name, {**topics_in(text), **topics}, graph, values, types)
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
        parameter.check(value)
    except GuardError as error:
        return f"does not allow it: {error}"
    return ""
