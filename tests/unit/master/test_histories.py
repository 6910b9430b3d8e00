"""RVMaster keeps its promises in histories by seed (`tests/support/histories.py`)."""

import subprocess
import sys


def said(*arguments: str) -> list[str]:
    """What the program writes, in a process of its own: there a seed is always the same history."""
    command = [sys.executable, "-m", "tests.support.histories", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()


def test_histories() -> None:
    """Nobody is told a way past the relay, nothing is granted against the policy, and everybody hears whom he may."""
    assert said("--many", "60") == []


def test_who_hung_while_its_topic_was_taken_and_given_back_connects_again() -> None:
    """It knows the list that it is told, and the control that took its grant is no more."""
    assert any(line.endswith("no faults any more") for line in said("1811"))


def test_a_seed_is_one_history() -> None:
    """What it says is the same each time."""
    assert said("7") == said("7")
