"""RVMaster keeps its promises in histories by seed (`tests/support/histories.py`); with a fault put in it does not."""

import subprocess
import sys

from tests.support.histories import MUTANTS


def said(*arguments: str) -> list[str]:
    """What the program writes, in a process of its own: there a seed is always the same history."""
    command = [sys.executable, "-m", "tests.support.histories", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()


def test_histories() -> None:
    """Nobody is told a way past the relay, nothing is granted against the policy, and everybody hears whom he may."""
    assert said("--many", "60") == []


def test_faults_of_the_core_are_found() -> None:
    """Each by one of some hundred histories, most by one of the first."""
    found = dict(line.rsplit(": ", 1) for line in said("--mutants", "400"))
    assert set(found) == set(MUTANTS)
    assert "None" not in found.values()


def test_a_seed_is_one_history() -> None:
    """What it says is the same each time."""
    assert said("7") == said("7") != said("8")
