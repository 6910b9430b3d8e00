"""`rosrv monitor`, as the command of the monitor language knows it."""

from appliance.base.input_files import read_given
from rosmop.tool.program import Program

MONITOR = Program("rosrv monitor", "rosrv-appliance", read_given)
