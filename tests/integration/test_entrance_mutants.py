"""Each rule of an entrance is seen by a test of its cell: with the rule taken out, one of them turns red."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.entrances import CELLS, TakenOut, taken_out

ROOT = Path(__file__).parents[2]

_PYTEST = (
    *(sys.executable, "-m", "pytest", "-c", "pyproject.toml", "--rootdir=.", "-qx", "-n", "0"),
    *("-p", "tests.support.changed_module"),
)


@pytest.mark.parametrize("change", [*taken_out()], ids=lambda change: f"{change.entrance}, {change.rule}")
def test_a_missing_rule_is_seen(change: TakenOut) -> None:
    tests = [f"tests/{one}" for one in CELLS[change.entrance][change.rule].split()]
    changed = json.dumps([change.file, change.old, change.new])
    ran = subprocess.run(
        [*_PYTEST, *tests],
        cwd=ROOT,
        env=os.environ | {"CHANGED": changed},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,  # a test that hangs does not count as red
    )
    assert ran.returncode == 1, ran.stdout + ran.stderr
    assert "failed" in ran.stdout, ran.stdout
