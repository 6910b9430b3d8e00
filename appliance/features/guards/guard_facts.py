"""Convert between the graph, presets and the rows of answers, for control and for `rosrv guard`."""

from collections.abc import Iterable

from appliance.channel.answers.graph_answers import Graph
from appliance.channel.answers.monitor_answers import GivenState
from appliance.features.guards.guard_answers import PresetParameter, PresetRow
from appliance.features.guards.presets import Preset
from appliance.features.guards.robot_graph import TopicFacts


def facts_of(graph: Graph) -> list[TopicFacts]:
    hosts = {node.name: node.host for node in graph.nodes}
    found = []
    for one in graph.topics:
        publishers, subscribers = tuple(each.node for each in one.publishers), tuple(one.subscribers)
        ends = tuple(sorted({hosts[node] for node in (*publishers, *subscribers) if node in hosts}))
        rates = tuple(each.messages_per_second for each in one.publishers)
        found.append(TopicFacts(one.name, one.type, publishers, subscribers, sum(rates), ends, rates))
    return found


def preset_row(preset: Preset) -> PresetRow:
    return PresetRow(
        preset.name,
        preset.version,
        preset.what,
        preset.given_topics,
        {given: [*types] for given, types in preset.topics.items()},
        [PresetParameter(one.name, one.kind, one.default, one.unit, one.least, one.most, one.what, one.loads,
                         one.safe)
         for one in preset.parameters],
    )  # fmt: skip


def values_of(given: Iterable[GivenState]) -> dict[str, str]:
    """Return the constants that a monitor has, as text."""
    return {
        one.name: str(one.value).lower() if isinstance(one.value, bool) else f"{one.value!r}"
        for one in given
        if one.kind != "topic"
    }
