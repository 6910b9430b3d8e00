"""The command `rosrv release`."""

import asyncio
import os
import sys
from pathlib import Path
from typing import Annotated

import msgspec
import structlog
import typer

from appliance.base.counted import counted
from appliance.channel.admin import StatusWanted
from appliance.cli.connection.admin_client import AdminSocket, NotRunningError
from appliance.cli.connection.target import Appliance, speaks_here
from appliance.cli.output import say_json, usage_error
from appliance.cli.standing import (
    WITHIN,
    NotStandingError,
    longest_wait,
    wait_until_robot_stands,
)
from appliance.features.adopt.adopt_answers import GiveBackReport
from appliance.features.adopt.dead_release import release_dead
from appliance.features.adopt.operator_orders import RELEASE, ordered
from appliance.features.adopt.requests import ReleaseOrder
from appliance.features.adopt.robot_side import remove_drop_ins
from appliance.network.namespaces import NetworkError
from rosmop.tool.terminal import printable, say

_VERB = "rosrv release"


@speaks_here
def release(
    appliance: Appliance,
    *,
    dead: Annotated[
        bool,
        typer.Option(
            "--dead",
            help="The appliance has crashed and stays off: give the graph back from its stored state",
        ),
    ] = False,
    force: Annotated[
        bool,
        typer.Option("--force", help="Release even if monitors are enabled and the robot may be moving"),
    ] = False,
    within: Annotated[float, longest_wait("until the robot stands still")] = WITHIN,
) -> None:
    """Give the graph of an adopted robot back to its own ROS master, without restarting a node. Needs root.

    The appliance runs on, but the robot's nodes no longer use it. While monitors are enabled, the command waits until
    the robot stands still, because guards end with the release. If the robot's own master no longer runs, another one
    is started.

    Example: rosrv release
    """
    state = appliance.state_here(_VERB)
    if os.geteuid() != 0:
        raise usage_error("the rules and sockets of this machine need root: run it with sudo", verb=_VERB)
    try:
        if dead:
            # A reader of standard output that has ended (head) must not end it between two steps.
            structlog.configure(logger_factory=structlog.PrintLoggerFactory(sys.stderr))
            report = asyncio.run(release_dead(state))
        else:
            if not force:
                _stand(appliance, within)
            report = _ordered(appliance, state)
        remove_drop_ins()
    except NetworkError as error:
        typer.echo(f"{_VERB}: {error}", err=True)
        raise typer.Exit(1) from None
    if appliance.as_json:
        say_json(msgspec.to_builtins(report))
        return
    if not report.nodes:
        say("nothing was adopted: the robot's nodes use their own master")
        return
    if report.withheld:
        withheld = counted(report.withheld, "registration")
        text = (
            f"{_VERB}: {counted(report.nodes, 'node')} keep their topics, but {withheld}"
            f" and the parameters are not given back: {report.withheld_from}. Stop that master, start the robot's own,"
            " and restart the robot's nodes"
        )
        typer.echo(printable(text), err=True)
        raise typer.Exit(1)
    say(
        f"released in {report.seconds:g} s: {counted(report.nodes, 'node')} use {report.master or 'their own master'}"
        f" again; {counted(report.given, 'registration')} given back, {report.ended} ended"
    )
    if report.started:
        say("the robot had no master of its own, so one was started: rosrv-left-master")
    for name in report.failed:
        say(f"not told: {name} did not answer")
    if not dead:
        say("The appliance runs on without them: sudo systemctl stop rosrv, or rosrv adopt")


def _ordered(appliance: Appliance, state: Path) -> GiveBackReport:
    try:
        with ordered(state, RELEASE):
            answer = appliance.ask(ReleaseOrder())
    except NotRunningError as error:
        raise NetworkError(f"{error}. After a crash: rosrv release --dead") from None
    if not answer.ok:
        raise NetworkError(answer.error)
    return answer.given()


def _stand(appliance: Appliance, within: float) -> None:
    try:
        answer = appliance.ask(StatusWanted())
    except NotRunningError:
        return
    if not answer.ok or not answer.given().monitors.enabled:
        return
    assert isinstance(appliance.way, AdminSocket)  # noqa: S101  the verb is given on this machine
    try:
        say(asyncio.run(wait_until_robot_stands(appliance, appliance.way.state, within)))
    except NotStandingError as error:
        raise NetworkError(
            f"monitors are enabled, and {error}. Nothing was changed; --force releases anyway"
        ) from None
