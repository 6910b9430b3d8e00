"""`rosrv monitor`, as the command of the monitor language knows it."""

from appliance.base.input_files import open_given, read_given
from appliance.cli.output import write_told
from rosmop.tool.program import Program

MONITOR = Program("rosrv monitor", "rosrv-appliance", read_given, open_given, write_told)
