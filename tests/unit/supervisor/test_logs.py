import json
import subprocess
import sys

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
