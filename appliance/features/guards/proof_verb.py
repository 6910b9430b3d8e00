"""The command `rosrv guard test`."""

from typing import Annotated

import typer

from appliance.cli import completion
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.output import say_json
from appliance.features.guards.guard_answers import ProofTest
from appliance.features.guards.requests import GuardsWanted, GuardTest
from rosmop.tool.terminal import say


@speaks
def test(
    appliance: Appliance,
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="GUARD",
            help="Names as in `rosrv guard list` (default: all guards in force)",
            autocompletion=completion.monitors,
            show_default=False,
        ),
    ] = None,
) -> None:
    """Test guards while the robot stands still: a synthetic fault on a copy of each, and its stop to the driver.

    The guard in force, and its state, stay as they are, and no motion is sent. If the copy acts, one stop is written to
    the connection of the base driver. It is printed when its socket has accepted the bytes, and when the TCP of its
    host has acknowledged them; not whether the driver obeys. Rejected while a node drives. Exit status: 0 each copy
    acted and each stop arrived, 1 not, or no guard is in force.

    Example: rosrv guard test estop
    """
    rows = appliance.ask_or_exit(GuardsWanted(presets=False)).guards
    wanted = names or [row.name for row in rows if row.state not in ("off", "shadow", "broken")]
    if not wanted:
        typer.echo("no guard is in force, so none was tested: rosrv guard list", err=True)
    proved = bool(wanted)
    for name in wanted:
        try:
            found = appliance.ask_or_exit(GuardTest(name))
        except typer.Exit as end:
            if end.exit_code != 1:
                raise
            proved = False
            continue
        proved = proved and found.proved
        if appliance.as_json:
            say_json({"guard": name, "test": found, "proved": found.proved})
        else:
            _say(name, found)
    raise typer.Exit(0 if proved else 1)


def _say(name: str, found: ProofTest) -> None:
    say(f"{name}: {found.in_words()}", "green" if found.proved else "red")
    if found.not_sent:
        say(f"    no stop was sent to the driver: {found.not_sent}", "yellow")
    elif found.outcome not in ("passed", "undecided") and not any(one.driver for one in found.reached):
        say("    no driver is connected to the appliance on this topic", "red")
    for one in found.reached:
        who = f"{one.node} on {one.host}{'' if one.driver else ' (listens only)'}"
        say(f"    {who}: {_arrival(one.accepted, 'accepted by the socket')}"
            f", {_arrival(one.acknowledged, 'acknowledged by TCP')}")  # fmt: skip


def _arrival(seconds: float | None, what: str) -> str:
    return f"not {what} within a second" if seconds is None else f"{what} after {seconds * 1e3:.1f} ms"
