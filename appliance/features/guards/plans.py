"""Choose topics and types for a new guard from the graph, and refuse a guard that the graph contradicts."""

from collections.abc import Iterable, Mapping
from difflib import get_close_matches

from appliance.features.guards.message_types import VALUED
from appliance.features.guards.presets import Guard, GuardError, Preset, works_with
from appliance.features.guards.robot_graph import TopicFacts

_UNKNOWN = "*"  # the type of a topic that has only subscribers which do not know it


def planned(  # noqa: PLR0917  one caller
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
    close = get_close_matches(topic, [name for name, kind in known.items() if kind in fitting], 1, 0.5)
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
