"""Tests of the scripts of a kit as they are shipped: any /bin/sh runs them, and no Python."""

import re
import subprocess
from pathlib import Path

import pytest

import appliance.ipsec

FOLDER = Path(appliance.ipsec.__file__).parent / "kit_files"
SCRIPTS = sorted(FOLDER.glob("*.sh"))


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.name)
def test_it_is_for_the_plainest_shell(script: Path) -> None:
    """It is read by dash, as /bin/sh is on Debian and Ubuntu, and uses nothing of bash."""
    text = script.read_text()
    assert text.startswith("#!/bin/sh\n")
    done = subprocess.run(["/bin/dash", "-n", str(script)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert re.findall(r"\[\[|\bfunction\b|<\(|\blocal -|\$'", text) == []


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.name)
def test_it_needs_no_python(script: Path) -> None:
    """A robot with Python 3.8, or none, can be enrolled."""
    assert re.findall(r"python|perl|ruby", script.read_text(), re.IGNORECASE) == []
