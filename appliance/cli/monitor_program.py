"""Define `rosrv monitor` as a program of the monitor language."""

from appliance.cli.output import write_told
from rosmop.tool.command_context import CommandContext

MONITOR = CommandContext("rosrv monitor", write_told)
