"""Name `rosrv monitor` in the errors and help of the commands that it shares with `rosmop`."""

from appliance.cli.output import write_told
from rosmop.tool.command_context import CommandContext

MONITOR = CommandContext("rosrv monitor", write_told)
