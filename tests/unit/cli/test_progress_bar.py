"""Tests of `rosmop.tool.progress_bar`: a bar on terminals, nothing for programs."""

import os
import pty
import subprocess
import sys

import pytest

pytestmark = pytest.mark.nightly

PROGRAM = """
from rosmop.tool.progress_bar import progress
with progress("working", lambda: 10, shares_screen={shares}) as told:
    for done in range(11):
        told(done)
print("end")
"""


def said(shares: bool, *, screen: bool) -> tuple[str, str]:
    """Return the text on standard output, and the text on standard error, which is a terminal or a pipe."""
    near, far = pty.openpty()
    command = [sys.executable, "-c", PROGRAM.format(shares=shares)]
    process = subprocess.Popen(
        command,
        stdout=far if screen else subprocess.PIPE,
        stderr=far,
        text=True,
        env=os.environ | {"TERM": "xterm"},
    )
    os.close(far)
    shown = bytearray()
    try:
        while piece := os.read(near, 65_536):
            shown += piece
    except OSError:
        pass  # the terminal's other end is closed
    output = "" if process.stdout is None else process.stdout.read()
    assert process.wait() == 0
    if process.stdout is not None:
        process.stdout.close()
    os.close(near)
    return output, shown.decode(errors="replace")


def test_a_terminal_has_a_bar() -> None:
    output, shown = said(shares=False, screen=False)
    assert output == "end\n"
    assert "working" in shown
    assert "100%" in shown


def test_output_on_the_same_terminal_has_no_bar() -> None:
    """A bar would break the lines of the output; if the output goes to a file, the bar is shown."""
    assert "working" not in said(shares=True, screen=True)[1]
    assert "working" in said(shares=True, screen=False)[1]


def test_a_pipe_has_no_bar() -> None:
    command = [sys.executable, "-c", PROGRAM.format(shares=False)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("end\n", "")
