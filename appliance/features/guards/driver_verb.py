"""The command `rosrv guard check-driver`."""

import sys
from typing import Annotated

import typer

from appliance.cli import completion
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.durations import bounded_span
from appliance.cli.output import say_json, usage_error
from appliance.features.guards.driver_outcomes import CONSENT, QUESTION, REQUEST, RESTARTED, status_of
from appliance.features.guards.guard_answers import DriverCheck
from appliance.features.guards.presets import DRIVER_CHECK
from appliance.features.guards.requests import DriverCheckBegin, DriverCheckWanted
from appliance.features.guards.verbs import CommandTopic
from rosmop.tool.terminal import say

_VERB = "rosrv guard check-driver"


@speaks
def check_driver(
    appliance: Appliance,
    topic: CommandTopic,
    *,
    by: Annotated[
        str,
        typer.Option("--by", metavar="TOPIC", help="Topic of the odometry", autocompletion=completion.topics),
    ],
    longest: Annotated[
        str, typer.Option("--for", help="How long motion commands are withheld, at most 10s")
    ] = "2s",
    within: Annotated[
        str, typer.Option("--within", help="The longest wait for slow motion, at most 5m")
    ] = "30s",
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask; needed without a terminal")] = False,
) -> None:
    """Measure whether the base driver stops the base when commands end, as if the appliance's machine had died.

    Drive the base slowly, at most 0.3 m/s and 0.6 rad/s, with its wheels raised or in free space. After one second of
    such motion, the appliance withholds the motion commands of this topic, at most for the time of --for, and watches
    the odometry. Stop commands pass, and guards stay in force. Then all commands pass again. Exit status: 0 the base
    driver stopped the base, 1 the base still moved, 2 not measured.

    Example: rosrv guard check-driver /cmd_vel --by /odom
    """
    seconds = _bounded("--for", "longest", longest)
    request = DriverCheckBegin(topic, by, seconds, _bounded("--within", "patience", within))
    _require_consent(seconds, yes=yes)
    check = appliance.ask_or_exit(request)
    if not appliance.as_json:
        say(REQUEST, "yellow")
    while check.command and not check.outcome:
        check = appliance.ask_or_exit(DriverCheckWanted())
    _say_outcome(check, seconds, as_json=appliance.as_json)
    raise typer.Exit(status_of(check.outcome))


def _bounded(option: str, name: str, text: str) -> float:
    bounds = DRIVER_CHECK.parameter(name)
    return bounded_span(option, text, f"{bounds.least}s", f"{bounds.most}s", _VERB)


def _require_consent(seconds: float, *, yes: bool) -> None:
    typer.echo(CONSENT.format(seconds), err=True)
    if yes:
        return
    if not sys.stdin.isatty():
        raise usage_error("without a terminal, agree with --yes", _VERB)
    if not typer.confirm(QUESTION, err=True):
        raise usage_error("nothing was changed", _VERB)


def _say_outcome(check: DriverCheck, seconds: float, *, as_json: bool) -> None:
    if as_json:
        say_json(check)
    elif not check.command:
        say(RESTARTED.format(seconds), "yellow")
    else:
        say(f"{check.command}: {check.text}", {0: "green", 1: "red"}.get(status_of(check.outcome), "yellow"))
