import subprocess
import sys

import pytest

from tests.support.stated import stated
from tests.unit.relay.monitors.quiet import QuietMonitors

TEXT = "m() { event e(bool x) /t std_msgs/Bool '{data:x}' { } }"
PROGRAM = """
import gc, sys
from appliance.channel.messages import SpecificationsStated
from appliance.relay.monitors.loader import Loader
monitors = Loader.load(SpecificationsStated(1, bytes.fromhex(sys.argv[1]), {"m": True}, False), lambda _: None)
assert monitors.monitors, monitors
written = tuple(f"rosmop.fast.{name}" for name in ("build", "batch_codegen", "codegen", "memory_layout"))
compiler = ("lark", "rosmop.text", "rosmop.check.", *written)
assert not [name for name in sys.modules if name.startswith(compiler)]
gc.collect()
print(len(gc.get_objects()))
"""


@pytest.mark.nightly
def test_the_garbage_collector_looks_at_the_specifications_and_not_at_what_compiles_them() -> None:
    data = stated(1, [("m.rv", TEXT)]).part
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, data.hex()], capture_output=True, text=True, check=True
    )
    assert int(done.stdout) < 5_000


def test_specifications_that_are_being_loaded_are_discarded_when_the_relay_ends() -> None:
    monitors = QuietMonitors()
    monitors.interceptor.state(stated(1, [("m.rv", TEXT)]))
    monitors.interceptor.close()
    monitors.loop.finish()
    assert (monitors.interceptor.monitors, monitors.reports.sent) == (None, [])
