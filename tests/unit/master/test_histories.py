"""RVMaster keeps its promises in random histories, each made from a seed (`tests/support/histories.py`)."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.nightly


def said(*arguments: str) -> list[str]:
    """Return the output of a history in a separate process, in which a seed always gives the same history."""
    command = [sys.executable, "-m", "tests.support.histories", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()


def test_histories() -> None:
    """No address bypasses the relay, no grant violates the policy, and each subscriber receives its publishers."""
    assert said("--many", "60") == []


def test_a_node_that_hung_during_two_reloads_connects_again() -> None:
    """The node already knows the list that it receives, and the control that revoked its grant has ended."""
    assert any(line.endswith("no faults any more") for line in said("1811"))


def test_a_seed_always_gives_the_same_history() -> None:
    """The output of a seed is the same each time."""
    assert said("7") == said("7")
