import subprocess
import sys

import pytest

pytestmark = pytest.mark.nightly

PROGRAM = """
from rosmop.tool.batch_session import progress
with progress("working", lambda: 10, shares_screen={shares}) as told:
    for done in range(11):
        told(done)
print("end")
"""


def test_a_pipe_has_no_bar() -> None:
    command = [sys.executable, "-c", PROGRAM.format(shares=False)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("end\n", "")
