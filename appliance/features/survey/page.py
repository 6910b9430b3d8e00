"""Make the HTML page and the text of an inventory. The page has no scripts, and all that robots wrote is escaped."""

from collections.abc import Iterator

from appliance.base.counted import counted
from appliance.features.survey.draft import PolicyDraft
from appliance.formats.html_page import Cells, head, lines, section, text
from appliance.rpc.graph_inventory import (
    GraphInventory,
    SurveyedTopic,
    acting_services,
    exposure,
    moving_topics,
    problems,
    telling_parameters,
)


def page(inventory: GraphInventory, draft: PolicyDraft | None) -> str:
    parts = [
        head("Survey of a ROS graph"),
        f"<h1>The graph of {text(inventory.master)}</h1>\n",
        f"<p>{text(summary(inventory))}</p>\n",
    ]
    parts += [f"<p>Not complete: {text(reason)}.</p>\n" for reason in inventory.left_out]
    parts += section("Any host that reaches the master may today", (), exposure(inventory).items())
    parts += section(
        "Ports that answered", ("host", "port", "what is usually there"),
        [(each.host, each.port, each.what) for each in inventory.listeners],
    )  # fmt: skip
    wrong = [(fault,) for fault in problems(inventory)]
    parts += section("Faults", (), wrong)
    parts += section("Hosts", ("host", "nodes"), _hosts(inventory))
    parts += section(
        "Topics that move something",
        ("topic", "type", "publishers", "subscribers", "messages a second"),
        [_topic(inventory, topic) for topic in moving_topics(inventory)],
    )
    parts += section(
        "Services that start, stop or reset something", ("service", "provider"),
        [(one.name, _on(inventory, one.providers)) for one in acting_services(inventory)],
    )  # fmt: skip
    parts += section(
        "Parameters with the name of a secret (not read)",
        (),
        [(name,) for name in telling_parameters(inventory)],
    )
    parts += section(
        "Topics",
        ("topic", "type", "publishers", "subscribers", "messages a second"),
        [_topic(inventory, topic) for topic in inventory.topics],
    )
    parts += section(
        "Services",
        ("service", "provider"),
        [(one.name, _on(inventory, one.providers)) for one in inventory.services],
    )
    parts += section("Connections", ("node", "topic", "with", "transport"), _connections(inventory))
    if draft is not None:
        parts.append(
            f"<h2>A draft policy</h2>\n<p>Review it before you load it.</p>\n<pre>{lines(draft.text)}</pre>\n"
        )
    return "".join(parts)


def summary(inventory: GraphInventory) -> str:
    hosts = inventory.hosts_of(tuple(inventory.hosts))
    return (
        f"{counted(len(inventory.nodes), 'node')} on {counted(len(hosts), 'host')},"
        f" {counted(len(inventory.topics), 'topic')}, {counted(len(inventory.services), 'service')},"
        f" {counted(len(inventory.parameters), 'parameter')};"
        f" read with {counted(inventory.calls, 'call')} in {inventory.seconds:.1f} s, nothing was registered"
    )


def report(inventory: GraphInventory) -> Iterator[str]:
    """Yield the lines for a terminal: the same in the order of what a reader asks first."""
    yield summary(inventory)
    yield from (f"not complete: {reason}" for reason in inventory.left_out)
    yield "any host that reaches the master may today:"
    yield from (f"  {what}: {number}" for what, number in exposure(inventory).items())
    yield from (f"open: {each.host}:{each.port} ({each.what})" for each in inventory.listeners)
    yield from (f"wrong: {fault}" for fault in problems(inventory))
    yield from (f"host {host}: {nodes}" for host, nodes in _hosts(inventory))
    for topic in moving_topics(inventory):
        yield f"moves: {topic.name} ({topic.type}) from {_on(inventory, topic.publishers) or 'no publisher'}"
    yield from (
        f"acts: {each.name} of {_on(inventory, each.providers)}" for each in acting_services(inventory)
    )
    yield from (f"named like a secret: {name}" for name in telling_parameters(inventory))


def _topic(inventory: GraphInventory, topic: SurveyedTopic) -> Cells:
    nodes = (_on(inventory, topic.publishers), _on(inventory, topic.subscribers))
    return (topic.name, topic.type, *nodes, "" if topic.rate is None else topic.rate)


def _hosts(inventory: GraphInventory) -> list[tuple[str, str]]:
    rows: dict[str, list[str]] = {}
    for node in inventory.nodes:
        rows.setdefault(node.host or "unknown", []).append(node.name)
    return [(host, ", ".join(names)) for host, names in sorted(rows.items())]


def _on(inventory: GraphInventory, nodes: tuple[str, ...]) -> str:
    return ", ".join(f"{node} ({inventory.host_of(node) or 'unknown host'})" for node in nodes)


def _connections(inventory: GraphInventory) -> list[Cells]:
    return [
        (node.name, row.topic, row.peer, row.transport)
        for node in inventory.nodes
        for row in node.connections
        if row.direction == "i"
    ]
