"""The command `rosrv host authority rotate`."""

import typer

from appliance.backup.contents import BackupError
from appliance.cli.connection.target import DEFAULT_STATE, State
from appliance.cli.output import Json, say_json
from appliance.cli.typed_confirmation import Yes, confirm_state
from appliance.features.tunnels.rotate_authority import rotate_authority
from rosmop.tool.terminal import refused, say


def rotate(
    context: typer.Context,
    state: State = DEFAULT_STATE,
    *,
    yes: Yes = False,  # noqa: ARG001  `confirm_state` reads it
    as_json: Json = False,
) -> None:
    """Erase the key of the hosts' authority; the next start makes a new one. Stop the appliance first.

    Certificates of the earlier authority are then rejected: all tunnels stay closed until each host has a new
    kit.

    Example: rosrv host authority rotate --state /var/lib/rosrv
    """
    confirm_state(
        context, state, "This erases the key of the hosts' authority; all hosts need new kits afterwards"
    )
    try:
        rotate_authority(state)
    except BackupError as error:
        raise refused([f"rosrv: {error}"]) from None
    if as_json:
        say_json({"state": str(state)})
        return
    say(
        "The key is erased. Start the appliance, which makes another; then, for each host of `rosrv host list`:"
    )
    say("    rosrv host kit NAME --token")
