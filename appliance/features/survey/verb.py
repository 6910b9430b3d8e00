"""The command `rosrv survey`."""

import asyncio
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from appliance.base.input_files import names_of_hosts
from appliance.cli.durations import bounded_span
from appliance.cli.output import Json, say_json, usage_error, write_new
from appliance.features.survey.draft import DraftError, PolicyDraft, draft
from appliance.features.survey.page import page, report
from appliance.policy.policy_findings import PolicyError
from appliance.rpc.graph_inventory import GraphInventory, problems
from appliance.rpc.graph_reader import SurveyError, SurveyLimits
from appliance.rpc.graph_reader import survey as read_graph
from rosmop.tool.terminal import say

_VERB = "rosrv survey"


def survey(
    master: Annotated[
        str, typer.Option(metavar="URI", envvar="ROS_MASTER_URI", help="The robot's ROS master")
    ] = "http://localhost:11311",
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="File for one HTML page; must not exist")
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
        if file.exists():
            raise usage_error(f"{file} exists already: give the name of a new file", verb=_VERB)
    try:
        inventory = asyncio.run(read_graph(master, SurveyLimits(whole=seconds)))
    except SurveyError as error:
        typer.echo(f"rosrv survey: {error}", err=True)
        raise typer.Exit(1) from None
    drafted = _drafted(inventory, required=policy is not None) if output or policy else None
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


def _drafted(inventory: GraphInventory, *, required: bool) -> PolicyDraft | None:
    try:
        return draft(inventory, names_of_hosts())
    except (DraftError, PolicyError) as error:
        typer.echo(f"rosrv survey: no draft policy: {error}", err=True)
        if required:
            raise typer.Exit(1) from None
        return None
