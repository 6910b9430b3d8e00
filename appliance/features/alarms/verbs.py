"""The commands `rosrv alarm list|acknowledge|silence`."""

from typing import Annotated

import typer

from appliance.base.timestamps import in_local_zone
from appliance.channel.alarms import AlarmList
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.durations import bounded_span
from appliance.cli.output import say_json, usage_error
from appliance.features.alarms.requests import (
    AlarmAcknowledge,
    AlarmSilence,
    AlarmsWanted,
)
from rosmop.tool.terminal import say

_STYLES = {"alarm": "bold red", "warning": "yellow", "notice": ""}
_Kind = Annotated[
    str, typer.Argument(help="Name of the alarm, as `rosrv alarm list` prints it", show_default=False)
]
_Note = Annotated[str, typer.Option(help="Why, for other operators")]


@speaks
def list_alarms(appliance: Appliance) -> None:
    """List the present alarms with their names, most severe first.

    Example: rosrv alarm list
    """
    _say(appliance.ask_or_exit(AlarmsWanted()), as_json=appliance.as_json)


@speaks
def acknowledge(appliance: Appliance, kind: _Kind, *, note: _Note = "") -> None:
    """Record that you take care of an alarm. It remains an alarm, with your name, until its condition ends.

    Example: rosrv alarm acknowledge audit-not-forwarded --note "new receiver"
    """
    _say(appliance.ask_or_exit(AlarmAcknowledge(kind, note)), as_json=appliance.as_json)


@speaks
def silence(
    appliance: Appliance,
    kind: _Kind,
    *,
    time: Annotated[
        str | None,
        typer.Option("--for", help="For this time: 30m, 12h; at most 7d", show_default=False),
    ] = None,
    end: Annotated[bool, typer.Option("--end", help="End the silence, or an acknowledgement, now")] = False,
    note: _Note = "",
) -> None:
    """Make an alarm a notice for some time, so that `rosrv status` exits with 0. Metrics do not change.

    Give --for or --end.

    Example: rosrv alarm silence audit-not-forwarded --for 2h
    """
    if (time is None) is not end:
        raise usage_error("give either --for TIME or --end", "rosrv alarm")
    seconds = None if time is None else bounded_span("--for", time, "1s", "7d", "rosrv alarm")
    _say(appliance.ask_or_exit(AlarmSilence(kind, seconds, note)), as_json=appliance.as_json)


def _say(body: AlarmList, *, as_json: bool) -> None:
    if body.robot and not as_json:
        say(f"robot  {body.robot}")
    for alarm in body.alarms:
        if as_json:
            say_json(alarm)
        else:
            say(f"{alarm.severity}  {alarm.kind}", _STYLES[alarm.severity])
            for line in in_local_zone(alarm.text).splitlines():
                say(f"    {line}")
    if not body.alarms and not as_json:
        say("no alarms")
