"""The command `rosrv monitor load`."""

from pathlib import Path
from typing import Annotated

import typer

from appliance.channel import admin
from appliance.channel.admin import AdminAnswer
from appliance.cli.commit_confirm import ConfirmWithin, seconds_within
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.monitor_changes import say_replaced
from appliance.cli.standing import WITHIN, WhenStanding, Within, stand_or_exit
from appliance.features.monitor_tools.in_force import Force, Hold, Shadow, given_to_monitors
from appliance.features.monitor_tools.sources_to_send import read_to_send
from rosmop.form.findings import SpecificationError
from rosmop.tool.terminal import printable


@speaks
def load(
    appliance: Appliance,
    files: Annotated[
        list[Path],
        typer.Argument(readable=False, metavar="FILE", help="Specification files (.rv)", show_default=False),
    ],
    msg: Annotated[
        list[Path] | None,
        typer.Option("--msg", metavar="DIR", help="Folder of message definitions (repeatable)"),
    ] = None,
    *,
    note: Annotated[str, typer.Option(help="Reason, kept with the revision")] = "",
    confirm_within: ConfirmWithin = None,
    shadow: Shadow = False,
    force: Force = False,
    hold: Hold = False,
    given: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="MONITOR.NAME=VALUE",
            help="Constant or topic in the `given` of a specification (repeatable)",
        ),
    ] = None,
    when_standing: WhenStanding = False,
    within: Within = WITHIN,
) -> None:
    """Load specifications while the robot runs; files of the same name are replaced.

    They are compiled and compared with the robot's topics first. After an error nothing changes: exit status 1. A
    monitor whose source changes loses its state; if it then holds topics with traffic, the load needs --hold. With
    --shadow, monitors only record what they would have done. Message definitions come from `msg/` beside the files
    and from --msg.

    Example: rosrv monitor load safe_zone.rv --shadow
    """
    confirmed = seconds_within(confirm_within, "monitor")
    try:
        sent = read_to_send(files, msg or [])
    except SpecificationError as error:
        found = [printable(str(finding)) for finding in error.findings]
        appliance.body_or_exit(AdminAnswer(False, error="nothing was sent", findings=found))
        return
    order = admin.MonitorLoad(
        sent.files,
        sent.definitions,
        note,
        confirm_within=confirmed,
        signatures=sent.signatures,
        force=force,
        shadow=shadow,
        hold=hold,
        given=given_to_monitors(given or []),
    )
    if when_standing:
        stand_or_exit(appliance, within, "rosrv monitor")
    say_replaced(appliance.answer_or_exit(order))
