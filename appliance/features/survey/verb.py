"""The command `rosrv survey`."""

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from appliance.base.counted import counted
from appliance.base.input_files import names_of_hosts
from appliance.cli.durations import bounded_span
from appliance.cli.output import OR_STANDARD, STANDARD_OUTPUT, Json, say_json, usage_error, write_new
from appliance.features.survey.draft import DraftError, PolicyDraft, draft
from appliance.formats.html_page import Cells, head, lines, section, text
from appliance.policy.policy_findings import PolicyError
from appliance.rpc.graph_inventory import (
    GraphInventory,
    SurveyedTopic,
    acting_services,
    exposure,
    moving_topics,
    problems,
    telling_parameters,
)
from appliance.rpc.graph_reader import SurveyError, SurveyLimits
from appliance.rpc.graph_reader import survey as read_graph
from rosmop.tool.terminal import say

_PROTECTED = "an appliance answers as the master; its policy decides for each host: rosrv policy who-may"

# Make the HTML page and the text of an inventory. The page has no scripts, and all that robots wrote is escaped.


def page(inventory: GraphInventory, draft: PolicyDraft | None) -> str:
    parts = [
        head("Survey of a ROS graph"),
        f"<h1>The graph of {text(inventory.master)}</h1>\n",
        f"<p>{text(summary(inventory))}</p>\n",
    ]
    parts += [f"<p>Not complete: {text(reason)}.</p>\n" for reason in inventory.left_out]
    if inventory.protected:
        parts.append(f"<p>{text(_PROTECTED)}.</p>\n")
    else:
        parts += section("Any host that reaches the master may today", (), exposure(inventory).items())
    parts += section(
        "Ports that answered", ("host", "port", "what is usually there"),
        [(listener.host, listener.port, listener.what) for listener in inventory.listeners],
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
        [(service.name, _on(inventory, service.providers)) for service in acting_services(inventory)],
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
        [(service.name, _on(inventory, service.providers)) for service in inventory.services],
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
    if inventory.protected:
        yield _PROTECTED
    else:
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


_VERB = "rosrv survey"


def survey(
    master: Annotated[
        str, typer.Option(metavar="URI", envvar="ROS_MASTER_URI", help="The robot's ROS master")
    ] = "http://localhost:11311",
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help=f"File for one HTML page; must not exist; {OR_STANDARD}"),
    ] = None,
    policy: Annotated[
        Path | None,
        typer.Option(help="File for a draft policy, and FILE.tests.yaml for its tests; both must not exist"),
    ] = None,
    within: Annotated[str, typer.Option(help="The longest time of the survey, 1s to 10m")] = "1m",
    as_json: Json = False,
) -> None:
    """List the hosts, nodes, topics and services of a robot, and what looks wrong. Nothing is registered or changed.

    It asks the ROS master and each node with calls that only read, and connects to ports 11311, 9090 and 8765 of hosts
    where these answer. It needs no appliance: run it on the robot, or on a computer of its network. Exit status 1 if
    the master does not answer.

    Example: rosrv survey --output survey.html --policy draft.ini
    """
    seconds = bounded_span("--within", within, "1s", "10m", _VERB)
    tests = None if policy is None else policy.with_name(f"{policy.name}.tests.yaml")
    for file in filter(None, (output, policy, tests)):
        if file != STANDARD_OUTPUT and file.exists():
            raise usage_error(f"{file} exists already: give the name of a new file", verb=_VERB)
    try:
        inventory = asyncio.run(read_graph(master, SurveyLimits(whole=seconds)))
    except SurveyError as error:
        typer.echo(f"rosrv survey: {error}", err=True)
        raise typer.Exit(1) from None
    drafted = _draft(inventory, required=policy is not None) if output or policy else None
    if output is not None:
        write_new(output, page(inventory, drafted), verb=_VERB)
    if policy is not None and tests is not None and drafted is not None:
        write_new(policy, drafted.text, verb=_VERB)
        write_new(tests, drafted.tests, verb=_VERB)
    if as_json:
        say_json({**msgspec.to_builtins(inventory), "problems": list(problems(inventory))})
        return
    for line in report(inventory):
        say(line)
    for file in filter(None, (output, policy, tests)):
        say(f"wrote {file}")
    for name in drafted.left_out if drafted else ():
        typer.echo(f"rosrv survey: no rule can be written for {name!r}", err=True)


def _draft(inventory: GraphInventory, *, required: bool) -> PolicyDraft | None:
    try:
        return draft(inventory, names_of_hosts())
    except (DraftError, PolicyError) as error:
        typer.echo(f"rosrv survey: no draft policy: {error}", err=True)
        if required:
            raise typer.Exit(1) from None
        return None
