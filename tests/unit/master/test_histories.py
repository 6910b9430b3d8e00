"""RVMaster keeps its promises in histories by seed (`tests/support/histories.py`)."""

import subprocess
import sys


def said(*arguments: str) -> list[str]:
    """Return the output of the program in its own process, where a seed always gives the same history."""
    command = [sys.executable, "-m", "tests.support.histories", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()


def test_histories() -> None:
    """No address bypasses the relay, no grant violates the policy, and each subscriber hears its publishers."""
    assert said("--many", "60") == []


def test_a_node_that_hung_during_two_reloads_connects_again() -> None:
    """It already knows the list that it receives, and the control that revoked its grant has ended."""
    assert any(line.endswith("no faults any more") for line in said("1811"))


def test_a_seed_always_gives_the_same_history() -> None:
    """Its output is the same each time."""
    assert said("7") == said("7")
