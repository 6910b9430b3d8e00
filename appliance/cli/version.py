"""`rosrv version`: what is installed here, or what a running appliance is."""

from appliance.channel.admin import InventoryWanted
from appliance.cli.output import say_json
from appliance.cli.target import Appliance, speaks
from appliance.configuration.inventory import inventory
from rosmop.tool.terminal import say


@speaks
def version(appliance: Appliance) -> None:
    """Show which version this is, and what it stands on.

    With --state or --api: of the appliance that runs there.

    Example: rosrv version --json
    """
    facts = appliance.ask_or_exit(InventoryWanted()) if appliance.said else inventory()
    if appliance.as_json:
        say_json(facts)
        return
    say(f"rosrv {facts.version}")
    say(f"Python {facts.python}, {facts.system} ({facts.machine})")
