"""The command `rosrv policy learn`."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from appliance.audit.log.log_database import LogUnreadableError
from appliance.audit.log.record import AuditRecord
from appliance.audit.log.repetition import PARAMETERS
from appliance.audit.search.filter_options import Since
from appliance.audit.search.query import Filter, FilterError
from appliance.base import clock
from appliance.base.counted import counted
from appliance.base.timestamps import TimestampError, parse_timestamp
from appliance.cli.connection.admin_client import NotRunningError
from appliance.cli.connection.target import Appliance, speaks_with
from appliance.cli.output import say_json
from appliance.features.policy_tools.learn import LearnedPolicy, Observation, covered, learn
from appliance.features.policy_tools.policy_input import (
    Robot,
    networks_of,
    request_of,
    running_robot,
    usage_error,
)
from appliance.policy.host_sets import Network
from appliance.policy.model import Category
from appliance.policy.policy_compiler import compile_policy
from appliance.policy.policy_findings import PolicyError
from rosmop.tool.terminal import refused

_OWN_NODE = "the appliance's own node"


@speaks_with("One JSON object: the policy, and the number of requests it is based on")
def learn_policy(
    appliance: Appliance,
    *,
    since: Since = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="File, must not exist")] = None,
    robot: Robot = None,
) -> None:
    """Write a policy that grants the requests in the audit log and no others.

    Run the robot with `audit-only = all` below [Options] first. Exit status 1 if the log has no requests. An address
    given with --robot that is not the robot of the running appliance (`rosrv policy show`) is written as an address.

    Example: rosrv policy learn --state /var/lib/rosrv --output learned.ini
    """
    members = _members(appliance, networks_of(robot))
    learned = learn(_observations(appliance, since), members)
    if not learned.requests:
        start = f" since {since}" if since is not None else ""
        hint = "run the robot with `audit-only = all` below [Options] first"
        raise refused([f"rosrv: the audit log has no allowed requests{start}: {hint}"])
    _check(learned, members)
    if output is not None:
        _write(output, learned.text)
    if appliance.as_json:
        say_json({"requests": learned.requests, "left_out": learned.left_out, "text": learned.text})
        return
    if output is None:
        sys.stdout.write(learned.text)
    summary = f"rosrv: learned from {counted(learned.requests, 'request')}"
    if learned.left_out:
        summary += f"; left out {counted(learned.left_out, 'request')} that no rule can grant"
    typer.echo(summary, err=True)


def _observations(appliance: Appliance, since: str | None) -> Iterator[Observation]:
    try:
        start = None if since is None else parse_timestamp(since, clock.wall_ns())
        for event in ("decision", "repetitions folded"):
            passed = Filter(decision=("allow", "would deny"), event=event, since=start)
            for entry in appliance.audit().export(passed):
                yield from _of_record(entry.record)
    except (LogUnreadableError, NotRunningError, TimestampError, FilterError) as error:
        raise usage_error(str(error)) from error


def _of_record(record: AuditRecord) -> Iterator[Observation]:
    if record.reason == _OWN_NODE or record.host is None or record.category not in set(Category):
        return
    request = request_of(record.host, record.caller_id or "", str(record.category), record.resource or "")
    detail = record.detail
    call, approval = str(detail.get("call", "")), "approval" in detail
    if record.event == "decision":
        yield Observation(request, call, str(detail.get("key", "")), approval)
    for name in detail.get(PARAMETERS, ()):  # reads that this record only counts
        yield Observation(request, call, str(name), approval)


def _members(appliance: Appliance, robot: list[Network]) -> list[Network]:
    try:
        own = running_robot(appliance) if robot else []
    except NotRunningError:
        return robot
    members = [given for given in robot if covered(given, own)]
    group = ", ".join(map(_shown, own)) or "empty"
    for other in robot:
        if other not in members:
            text = f"rosrv: {_shown(other)} stays an address: the group robot of this appliance is {group}"
            typer.echo(text, err=True)
    return members


def _shown(place: Network) -> str:
    return str(place.network_address) if place.num_addresses == 1 else str(place)


def _check(learned: LearnedPolicy, robot: list[Network]) -> None:
    try:
        compile_policy(learned.text, file="learned", robot=robot)
    except PolicyError as error:
        what = "rosrv: the learned policy is invalid (see above): write rules for these names by hand"
        raise refused([*error.findings, what]) from error


def _write(output: Path, text: str) -> None:
    try:
        descriptor = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
    except OSError as error:
        raise usage_error(f"{output}: {error.strerror}") from error
    with os.fdopen(descriptor, "w", encoding="ascii") as file:
        file.write(text)
