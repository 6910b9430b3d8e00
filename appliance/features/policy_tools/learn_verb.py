"""The command `rosrv policy learn`."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from appliance.audit.search.filter_options import Since
from appliance.base.counted import counted
from appliance.base.input_files import names_of_hosts
from appliance.base.user_errors import with_remedy
from appliance.cli.connection.admin_client import NotRunningError
from appliance.cli.connection.target import Appliance, speaks_with
from appliance.cli.output import say_json
from appliance.features.policy_tools.ask_rights import ask_rights
from appliance.features.policy_tools.learn import LearnedPolicy, Observation, covered, learn
from appliance.features.policy_tools.policy_input import (
    Robot,
    networks_of,
    recorded_period,
    running_robot,
    usage_error,
)
from appliance.policy.cases import run_cases
from appliance.policy.host_sets import Network
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.policy_findings import PolicyError
from rosmop.tool.terminal import refused

_SHOWN_NODES = 5


@speaks_with("One JSON object: the policy, and the number of requests it is based on")
def learn_policy(
    appliance: Appliance,
    *,
    since: Since = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="File (default: standard output); must not exist, except with --ask, which continues it",
        ),
    ] = None,
    tests: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="File for test cases of the used rights; must not exist"),
    ] = None,
    ask: Annotated[
        bool, typer.Option("--ask", help="Ask about each kind of right that the policy does not grant yet")
    ] = False,
    with_start: Annotated[
        bool,
        typer.Option(
            "--with-start",
            help="To nodes whose start is not in the log, also grant the rights that a start needs",
        ),
    ] = False,
    robot: Robot = None,
) -> None:
    """Write a policy that grants the requests in the audit log and no others.

    First run the robot with `audit-only = all` below [Options], and start its nodes once in that time. Exit status 1
    if the log has no requests, or if the log lacks the start of nodes that were adopted (see --with-start). Hosts get
    their names from /etc/hosts, and the hosts of the running appliance's robot become the group `robot`.

    --ask needs --output. It starts with the policy in force, asks on the terminal, and writes the changed policy with
    its tests.

    Example: rosrv policy learn --state /var/lib/rosrv --output learned.ini
    """
    if ask:
        if tests is not None or with_start or robot or output is None:
            raise usage_error("--ask needs --output FILE, and has none of --tests, --with-start and --robot")
        raise typer.Exit(ask_rights(appliance, recorded_period(appliance, since), output))
    members = _members(appliance, networks_of(robot))
    learned = learn(_observations(appliance, since), members, names_of_hosts(), with_start=with_start)
    if not learned.requests:
        start = f" since {since}" if since is not None else ""
        hint = "run the robot with `audit-only = all` below [Options] first"
        raise refused([f"rosrv: the audit log has no allowed requests{start}: {hint}"])
    if learned.unstarted and not with_start:
        raise refused([_not_started(learned)])
    _check(learned, members)
    for file, text in ((output, learned.text), (tests, learned.tests)):
        if file is not None:
            _write(file, text)
    if appliance.as_json:
        counts = {"requests": learned.requests, "left_out": learned.left_out}
        say_json(
            {**counts, "text": learned.text, "tests": learned.tests, "unstarted": list(learned.unstarted)}
        )
        return
    if output is None:
        sys.stdout.write(learned.text)
    summary = f"rosrv: learned from {counted(learned.requests, 'request')}"
    if learned.left_out:
        summary += f"; left out {counted(learned.left_out, 'request')} that no rule can grant"
    typer.echo(summary, err=True)


def _observations(appliance: Appliance, since: str | None) -> Iterator[Observation]:
    for request in recorded_period(appliance, since).requests():
        if not request.repeated:
            yield request.observation


def _not_started(learned: LearnedPolicy) -> str:
    nodes = learned.unstarted
    more = f" and {len(nodes) - _SHOWN_NODES} more" if len(nodes) > _SHOWN_NODES else ""
    return (
        f"rosrv: {counted(len(nodes), 'node')} ran already when the appliance took over, so the log lacks what their"
        f" start needs, and a policy learned from it would deny the next start: {', '.join(nodes[:_SHOWN_NODES])}{more}"
        "; start the robot once in audit-only mode, or add --with-start"
    )


def _members(appliance: Appliance, robot: list[Network]) -> list[Network]:
    try:
        own = running_robot(appliance)
    except NotRunningError:
        return robot
    members = [given for given in robot if covered(given, own)]
    group = ", ".join(map(_shown, own)) or "empty"
    for other in robot:
        if other not in members:
            text = f"rosrv: {_shown(other)} stays an address: the group robot of this appliance is {group}"
            typer.echo(text, err=True)
    return members if robot else own


def _shown(place: Network) -> str:
    return str(place.network_address) if place.num_addresses == 1 else str(place)


def _check(learned: LearnedPolicy, robot: list[Network]) -> None:
    try:
        policy = compile_policy(learned.text, file="learned", robot=robot)
        results = run_cases(policy, learned.tests, "learned.tests.yaml")
    except PolicyError as error:
        what = "rosrv: the learned policy is invalid (see above): write rules for these names by hand"
        raise refused([*error.findings, what]) from error
    failed = [result for result in results if not result.passed]
    if failed:
        raise refused([*failed, "rosrv: the learned policy does not grant what was used (see above)"])


def _write(output: Path, text: str) -> None:
    try:
        descriptor = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
    except OSError as error:
        raise usage_error(with_remedy(error, output)) from error
    with os.fdopen(descriptor, "w", encoding="ascii") as file:
        file.write(text)
