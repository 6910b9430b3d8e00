"""What compiles specifications beside the relay's loop."""

import subprocess
import sys

PROGRAM = """
import gc
from appliance.channel.messages import SpecificationsStated
from appliance.relay.monitors.compiler import Compiler
text = "m() { event e(bool x) /t std_msgs/Bool '{data:x}' { } }"
monitors = Compiler.compile(SpecificationsStated(1, [("m.rv", text)], {}, {}, False))
assert monitors.monitors, monitors
gc.collect()
print(len(gc.get_objects()))
"""


def test_the_garbage_collector_looks_at_the_specifications_and_not_at_what_compiles_them() -> None:
    """Parser, definitions and libraries stay: a hundred thousand objects, through which it would hold up messages."""
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 5_000
