"""Make the HTML page and the text of an inventory. The page has no scripts, and all that robots wrote is escaped."""

import html
from collections.abc import Iterable, Iterator, Sequence

from appliance.audit.log.record_format import printable
from appliance.base.counted import counted
from appliance.features.survey.draft import PolicyDraft
from appliance.features.survey.inventory import (
    GraphInventory,
    SurveyedTopic,
    acting_services,
    exposure,
    moving_topics,
    problems,
    telling_parameters,
)

_HEAD = """\
<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; style-src 'unsafe-inline'">
<meta name="viewport" content="width=device-width">
<title>Survey of a ROS graph</title>
<style>
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 75rem; padding: 0 1rem;
  color-scheme: light dark }
table { border-collapse: collapse; width: 100% }
td, th { text-align: left; vertical-align: top; padding: .15rem .6rem .15rem 0 }
tr { border-top: 1px solid #8884 }
td { overflow-wrap: anywhere }
td.number { text-align: right; white-space: nowrap }
pre, code { font-family: ui-monospace, monospace }
pre { overflow-x: auto; border: 1px solid #8884; padding: .6rem }
</style>
"""

Cells = Sequence[object]


def page(inventory: GraphInventory, draft: PolicyDraft | None) -> str:
    parts = [
        _HEAD,
        f"<h1>The graph of {_text(inventory.master)}</h1>\n",
        f"<p>{_text(summary(inventory))}</p>\n",
    ]
    parts += [f"<p>Not complete: {_text(text)}.</p>\n" for text in inventory.left_out]
    parts += _section("Any host that reaches the master may today", (), exposure(inventory).items())
    parts += _section(
        "Ports that answered", ("host", "port", "what is usually there"),
        [(each.host, each.port, each.what) for each in inventory.listeners],
    )  # fmt: skip
    wrong = [(text,) for text in problems(inventory)]
    parts += _section("Faults", (), wrong)
    parts += _section("Hosts", ("host", "nodes"), _hosts(inventory))
    parts += _section(
        "Topics that move something",
        ("topic", "type", "publishers", "subscribers", "messages a second"),
        [_topic(inventory, topic) for topic in moving_topics(inventory)],
    )
    parts += _section(
        "Services that start, stop or reset something", ("service", "provider"),
        [(one.name, _on(inventory, one.providers)) for one in acting_services(inventory)],
    )  # fmt: skip
    parts += _section(
        "Parameters with the name of a secret (not read)",
        (),
        [(name,) for name in telling_parameters(inventory)],
    )
    parts += _section(
        "Topics",
        ("topic", "type", "publishers", "subscribers", "messages a second"),
        [_topic(inventory, topic) for topic in inventory.topics],
    )
    parts += _section(
        "Services",
        ("service", "provider"),
        [(one.name, _on(inventory, one.providers)) for one in inventory.services],
    )
    parts += _section("Connections", ("node", "topic", "with", "transport"), _connections(inventory))
    if draft is not None:
        parts.append(
            f"<h2>A draft policy</h2>\n<p>Review it before you load it.</p>\n<pre>{_lines(draft.text)}</pre>\n"
        )
    return "".join(parts)


def summary(inventory: GraphInventory) -> str:
    hosts = {node.host for node in inventory.nodes if node.host}
    return (
        f"{counted(len(inventory.nodes), 'node')} on {counted(len(hosts), 'host')},"
        f" {counted(len(inventory.topics), 'topic')}, {counted(len(inventory.services), 'service')},"
        f" {counted(len(inventory.parameters), 'parameter')};"
        f" read with {counted(inventory.calls, 'call')} in {inventory.seconds:.1f} s, nothing was registered"
    )


def report(inventory: GraphInventory) -> Iterator[str]:
    """Yield the lines for a terminal: the same in the order of what a reader asks first."""
    yield summary(inventory)
    yield from (f"not complete: {text}" for text in inventory.left_out)
    yield "any host that reaches the master may today:"
    yield from (f"  {what}: {number}" for what, number in exposure(inventory).items())
    yield from (f"open: {each.host}:{each.port} ({each.what})" for each in inventory.listeners)
    yield from (f"wrong: {text}" for text in problems(inventory))
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


def _section(title: str, columns: Sequence[str], rows: Iterable[Cells]) -> Iterator[str]:
    table = list(rows)
    if not table:
        return
    yield f"<h2>{title}</h2>\n<table>\n"
    if columns:
        yield f"<tr>{''.join(f'<th>{column}' for column in columns)}\n"
    for row in table:
        yield (
            "<tr>"
            + "".join(
                f'<td class="number">{cell:,}' if isinstance(cell, int | float) else f"<td>{_text(str(cell))}"
                for cell in row
            )
            + "\n"
        )
    yield "</table>\n"


def _text(text: str) -> str:
    return html.escape(printable(text).encode("utf-8", "replace").decode())


def _lines(text: str) -> str:
    return "\n".join(map(_text, text.split("\n")))
