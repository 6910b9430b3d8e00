"""Tests of `rosmop.tool.progress_bar`: a bar for people, nothing for programs."""

import os
import pty
import subprocess
import sys

PROGRAM = """
from rosmop.tool.progress_bar import progress
with progress("working", lambda: 10, shares_screen={shares}) as told:
    for done in range(11):
        told(done)
print("end")
"""


def said(shares: bool, *, screen: bool) -> tuple[str, str]:
    """Standard output, and what was said on the terminal or pipe of standard error."""
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


def test_on_a_terminal_there_is_a_bar() -> None:
    """It shows what is done and how much of it."""
    output, shown = said(shares=False, screen=False)
    assert output == "end\n"
    assert "working" in shown
    assert "100%" in shown


def test_where_the_work_itself_is_shown_there_is_none() -> None:
    """Lines on the same terminal are not torn apart by a bar; with the lines in a file there is one."""
    assert "working" not in said(shares=True, screen=True)[1]
    assert "working" in said(shares=True, screen=False)[1]


def test_in_a_pipe_there_is_nothing() -> None:
    """Programs read what was asked for and nothing else."""
    command = [sys.executable, "-c", PROGRAM.format(shares=False)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("end\n", "")
