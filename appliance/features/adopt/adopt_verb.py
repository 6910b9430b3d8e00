"""The command `rosrv adopt`."""

import asyncio
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from appliance.base import clock
from appliance.base.counted import counted
from appliance.channel.admin import PolicyReload
from appliance.cli.connection.admin_client import NotRunningError
from appliance.cli.connection.target import Appliance, speaks_here
from appliance.cli.output import say_json, say_row, usage_error
from appliance.cli.standing import (
    WITHIN,
    NotStandingError,
    WhenStanding,
    Within,
    link_address,
    wait_until_robot_stands,
    wait_until_standing,
)
from appliance.features.adopt.adopt_answers import AdoptState, TakeOverReport
from appliance.features.adopt.adopt_check import CheckedRobot, CheckLine, check_lines
from appliance.features.adopt.adopt_record import Phase, load_record, save_record
from appliance.features.adopt.machine_side import wanted_record
from appliance.features.adopt.operator_orders import ADOPT, show_order
from appliance.features.adopt.requests import AdoptOrder, AdoptStatus
from appliance.features.adopt.robot_side import (
    WAITS,
    make_audit_only,
    robot_state,
    running_settings,
    write_drop_in,
    write_policy,
)
from appliance.network.namespaces import Namespace, NetworkError
from rosmop.tool.terminal import printable, say

_VERB = "rosrv adopt"
_START_SECONDS = 180.0
_LOOK_SECONDS = 0.5
_SHOWN = 20  # nodes that are not adopted


@speaks_here
def adopt(
    appliance: Appliance,
    *,
    check: Annotated[
        bool, typer.Option("--check", help="Only show the changes, and what prevents them")
    ] = False,
    status: Annotated[
        bool,
        typer.Option(
            "--status", help="Show whether the graph is adopted, since when, and which nodes are not"
        ),
    ] = False,
    audit_only: Annotated[
        bool,
        typer.Option(
            "--audit-only",
            help="Deny nothing: the policy must have `audit-only = all`. It is added to the shipped policy, and to no"
            " other",
        ),
    ] = False,
    when_standing: WhenStanding = False,
    within: Within = WITHIN,
) -> None:
    """Take over the graph of a running robot from its own ROS master, without restarting a node. Needs root.

    The robot's nodes are registered with the appliance, and their connections are cut, so that they connect again
    through it. Each later start of the appliance does this again; `rosrv release` gives the graph back. Exit status 1
    if something prevents it.

    Example: rosrv adopt --check
    """
    state = appliance.state_here(_VERB)
    if os.geteuid() != 0:
        raise usage_error("the rules and sockets of this machine need root: run it with sudo", verb=_VERB)
    try:
        if status:
            _show_status(appliance)
            return
        settings = running_settings(state)
        if settings is not None and settings.isolation != "netns":
            raise usage_error("it needs `isolation: netns`, on the robot's own computer", verb=_VERB)
        robot = robot_state(state, settings)
        lines = check_lines(robot, Namespace.own())
        stopped = any(line.level == "stop" for line in lines)
        if check or stopped:
            _show_lines(lines, as_json=appliance.as_json)
            raise typer.Exit(1 if stopped else 0)
        if when_standing:
            _wait(appliance, state, robot, within)
        policy = None if settings is None else settings.policy
        with _first_audit_only(appliance, robot, policy) if audit_only else nullcontext():
            show = _adopt(appliance, state)
        write_drop_in(load_record(state))
        show()
    except NetworkError as error:
        typer.echo(f"{_VERB}: {error}", err=True)
        raise typer.Exit(1) from None


@contextmanager
def _first_audit_only(appliance: Appliance, robot: CheckedRobot, policy: Path | None) -> Iterator[None]:
    """Make the policy audit-only for an adoption; if that fails, the policy is as before."""
    if robot.policy is not None and robot.policy.all_audit_only:
        yield
        return
    if policy is None:
        raise usage_error(
            "the policy is not known: start the appliance first (systemctl start rosrv)", verb=_VERB
        )
    try:
        before = policy.read_bytes()
        lowered = make_audit_only(policy)
    except OSError as error:
        raise usage_error(f"{policy} cannot be changed: {error.strerror}", verb=_VERB) from None
    if not lowered:
        text = (
            f"{policy} is not the shipped policy, and is never weakened: put `audit-only = all` below [Options] in"
            " it, or leave out --audit-only"
        )
        raise usage_error(text, verb=_VERB)
    try:
        _reload(appliance)
        say(f"{policy} now has `audit-only = all`: denials are recorded and pass; an alarm reminds you")
        yield
    except NetworkError:
        write_policy(policy, before)
        say(f"{policy} is as before")
        _reload(appliance)
        raise


def _reload(appliance: Appliance) -> None:
    try:
        answer = appliance.ask(PolicyReload())
    except NotRunningError:
        return
    if not answer.ok and not answer.error.startswith(WAITS):
        raise NetworkError(answer.error)


def _wait(appliance: Appliance, state: Path, robot: CheckedRobot, within: float) -> None:
    try:
        if robot.record.phase is Phase.TAKEN:  # the port leads to RVMaster
            said = asyncio.run(wait_until_robot_stands(appliance, state, within))
        else:
            master, source = f"http://127.0.0.1:{robot.port}", link_address() or "127.0.0.1"
            said = asyncio.run(wait_until_standing(master, within, source))
        say(said)
    except NotStandingError as error:
        raise NetworkError(f"{error}. Nothing was changed") from None


def _adopt(appliance: Appliance, state: Path) -> Callable[[], None]:
    """Order the adoption, or note it for the start of an appliance; return what shows the outcome."""
    try:
        with show_order(state, ADOPT):
            answer = appliance.ask(AdoptOrder())
    except NotRunningError:
        _note(state)
        return partial(say, "noted: the next start takes the graph over: sudo systemctl start rosrv")
    if answer.ok:
        return partial(_show_report, answer.unwrap(), as_json=appliance.as_json)
    if not answer.error.startswith(WAITS):
        raise NetworkError(answer.error)
    _note(state)
    return lambda: _show_started(_await_start(appliance), as_json=appliance.as_json)


def _note(state: Path) -> None:
    """Write the record while no supervisor does."""
    robot = robot_state(state, running_settings(state))
    save_record(state, wanted_record(load_record(state), robot.master))


def _await_start(appliance: Appliance) -> AdoptState:
    until, last, pause = clock.now() + _START_SECONDS, "", threading.Event()
    while clock.now() < until:
        pause.wait(_LOOK_SECONDS)
        try:
            answer = appliance.ask(AdoptStatus())
        except NotRunningError as error:
            last = str(error)
            continue
        if answer.ok:
            found = answer.unwrap()
            if found.phase == "taken":
                return found
            last = found.obstacle or last
        else:
            last = answer.error
    raise NetworkError(f"noted, but not adopted within {_START_SECONDS:g} s: {last}. `rosrv adopt --status`")


def _show_lines(lines: list[CheckLine], *, as_json: bool) -> None:
    width = max(len(line.about) for line in lines)
    for line in lines:
        if as_json:
            say_json({"level": line.level, "about": line.about, "text": line.text})
        else:
            say_row([f"{line.level:<4}", f"{line.about:<{width}}", line.text])


def _show_report(report: TakeOverReport, *, as_json: bool) -> None:
    if as_json:
        say_json(msgspec.to_builtins(report))
        return
    say(
        f"adopted in {report.seconds:g} s: {counted(report.nodes, 'node')} of {counted(len(report.hosts), 'host')},"
        f" {counted(report.registrations, 'registration')}, {len(report.denied)} denied;"
        f" {counted(report.cut, 'connection')} cut"
    )
    _show_left(report)
    for left in report.left_out:
        say(printable(f"left out: {left}"))
    say("Next: rosrv status, and `rosrv protect` to close the nodes' own ports to other hosts")


def _show_started(state: AdoptState, *, as_json: bool) -> None:
    if as_json:
        say_json(msgspec.to_builtins(state))
        return
    say(f"adopted: {counted(state.nodes, 'node')} of {state.master}")
    _show_left(state)
    say("Next: rosrv status, and `rosrv protect` to close the nodes' own ports to other hosts")


def _show_left(found: TakeOverReport | AdoptState) -> None:
    for entry, why in found.denied.items():
        say(printable(f"denied: {entry}: {why}"))
    for name, why in [*found.missing.items()][:_SHOWN]:
        say(printable(f"not adopted: {name}: {why}"))
    if len(found.missing) > _SHOWN:
        say(f"not adopted: {len(found.missing) - _SHOWN} more nodes: --json lists them")
    for port, process in found.not_cut.items():
        say(printable(f"not cut: {port}: {process}"))
    if found.not_cut:
        say("Restart these programs: what they publish may bypass the appliance")


def _show_status(appliance: Appliance) -> None:
    found = appliance.answer_or_exit(AdoptStatus())
    if not found.wanted and found.phase == "free":
        say("nothing is adopted: the robot's nodes use their own master, or were started with the appliance")
        return
    words = {
        "taken": "the robot's nodes use the appliance",
        "free": "the robot's nodes use their own master",
        "taking": "the graph is being taken over",
        "giving": "the graph is being given back",
        "given": "the graph is being given back",
    }
    left = len(found.missing) + len(found.not_cut)
    but = f", but not all: {left} below" if left and found.phase == "taken" else ""
    say(f"{words[found.phase]}{but}; adopted since {found.since_utc}")
    away = "" if found.present else ", away: a release starts another master"
    say(f"own master: {found.master}{away}")
    say(f"{counted(found.nodes, 'node')}, of which {found.not_started} were never seen to start")
    if found.obstacle:
        say(f"not as wanted: {found.obstacle}")
    _show_left(found)
