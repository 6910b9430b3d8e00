"""`rosrv version`: show the installed version, or that of a running appliance."""

from appliance.channel.admin import InventoryWanted
from appliance.cli.connection.target import Appliance, speaks
from appliance.cli.output import say_json
from appliance.configuration.inventory import inventory
from rosmop.tool.terminal import say


@speaks
def version(appliance: Appliance) -> None:
    """Show the version of rosrv, Python and the system.

    With --state or --api, show the versions of the running appliance instead.

    Example: rosrv version --json
    """
    facts = appliance.ask_or_exit(InventoryWanted()) if appliance.said else inventory()
    if appliance.as_json:
        say_json(facts)
        return
    say(f"rosrv {facts.version}")
    say(f"Python {facts.python}, {facts.system} ({facts.machine})")
