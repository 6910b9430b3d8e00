"""The command `rosrv fleet take`."""

from msgspec.structs import asdict

from appliance.channel.admin import StatusWanted
from appliance.cli.connection.target import Appliance, speaks_here
from appliance.cli.output import say_json
from appliance.cli.standing import WITHIN, WhenStanding, Within, stand_or_exit
from appliance.features.fleet.requests import BundleTake
from appliance.features.fleet.view import BundlesState
from rosmop.tool.terminal import printable, refusal, say

_VERB = "rosrv fleet"


@speaks_here
def take(appliance: Appliance, *, when_standing: WhenStanding = False, within: Within = WITHIN) -> None:
    """Bring the bundle that waits for this order into force. Exit status 1 if none waits.

    Bundles wait with the setting `fleet.bundles.wait_for_order`. The bundle is rolled back if the robot is not
    healthy with it. With --when-standing, it comes into force only when the robot stands still. `rosrv status` shows
    the result.

    Example: sudo rosrv fleet take --when-standing --within 10m
    """
    state: BundlesState | None = asdict(appliance.ask_or_exit(StatusWanted())).get("bundles")
    if state is None or not state.for_order:
        why = "" if state is None or not state.trouble else f": {state.trouble}"
        raise refusal([printable(f"{_VERB}: no bundle waits for an order{why}")])
    if when_standing:
        stand_or_exit(appliance, within, _VERB)
    body = appliance.ask_or_exit(BundleTake(state.for_order))
    if appliance.as_json:
        say_json(body)
        return
    healthy = f"stays if the robot is healthy for {body.confirm_seconds:g} s"
    say(printable(f"{body.path} is checked again and tried, and {healthy}"))
    say("rosrv status shows whether it is in force, or why not")
