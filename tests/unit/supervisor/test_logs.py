import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.nightly

_PROGRAM = """
import logging, structlog, sys
from appliance.supervisor.logs import configure_logs, write_line

configure_logs("tester")
write_line("Nodes may connect", sys.stdout)

def fail(token):
    raise ValueError("odd")

try:
    fail("sesame" + "-42")
except ValueError:
    structlog.get_logger().exception("own", host="10.0.0.1")
    logging.getLogger("library").exception("foreign")
"""


def test_lines_are_json_without_secrets() -> None:
    done = subprocess.run([sys.executable, "-c", _PROGRAM], capture_output=True, text=True, check=True)
    own, foreign = map(json.loads, done.stderr.splitlines())
    assert (own["event"], own["host"], foreign["event"]) == ("own", "10.0.0.1", "foreign")
    for line in (own, foreign):
        assert line["process"] == "tester"
        assert line["level"] == "error"
        assert line["timestamp"].endswith("Z")
        assert line["exception"][0]["exc_type"] == "ValueError"
        assert [frame["name"] for frame in line["exception"][0]["frames"]] == ["<module>", "fail"]
    assert "sesame-42" not in done.stderr
    announced = json.loads(done.stdout)
    assert (announced["event"], announced["process"]) == ("Nodes may connect", "tester")


_LOGS = {
    "appliance": "from appliance.supervisor.logs import configure_logs; configure_logs('tester')",
    "collector": "from rosrv_fleet.output import configure_log; configure_log()",
    "witness": (
        "import time; from appliance.features.standby.witness.enforcement import BoundedLog, write_error;"
        " BoundedLog(write_error, time.monotonic).add('no firewall')"
    ),
}
_REPORTS = """
import logging, threading, warnings, structlog
structlog.get_logger().error("own")
logging.getLogger("library").error("foreign")
warnings.warn("odd")
thread = threading.Thread(target=lambda: 1 / 0)
thread.start()
thread.join()
print("goes on")
"""


@pytest.mark.parametrize("program", _LOGS)
def test_nothing_that_reports_fails_without_room(program: str) -> None:
    reports = _REPORTS if program != "witness" else 'print("goes on")'
    with Path("/dev/full").open("w", encoding="utf-8") as full:
        done = subprocess.run(
            [sys.executable, "-c", f"{_LOGS[program]}\n{reports}"],
            stdout=subprocess.PIPE, stderr=full, text=True, check=False,
        )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, "goes on\n")
