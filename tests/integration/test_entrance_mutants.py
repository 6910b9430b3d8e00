"""Each rule of an entrance is seen by a test of its cell: with the rule taken out, one of them turns red."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.entrance_mutants import MUTANTS
from tests.support.entrances import CELLS

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(("entrance", "rule"), MUTANTS, ids=[f"{one}, {rule}" for one, rule in MUTANTS])
def test_a_missing_rule_is_seen(entrance: str, rule: str) -> None:
    tests = [f"tests/{one}" for one in CELLS[entrance][rule].split()]
    ran = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "tests.support.changed_module", *tests],
        cwd=ROOT,
        env=os.environ | {"CHANGED": json.dumps(MUTANTS[entrance, rule])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 1, ran.stdout + ran.stderr
    assert "failed" in ran.stdout, ran.stdout
