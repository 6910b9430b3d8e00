"""`rosrv monitor check|run|learn|coverage`: the commands of the monitor language, without an appliance.

Exit status: 0 valid (also with warnings and verdicts), 1 a specification with errors, 2 usage.
"""

from appliance.cli.monitor_program import MONITOR
from rosmop.tool.command import commands_of

check, run, learn, coverage = commands_of(MONITOR).values()
