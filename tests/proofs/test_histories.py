"""A thousand histories of RVMaster with faults: the program keeps the promises of the model of the insertion."""

import pytest

from tests.support.histories import MUTANTS
from tests.unit.master.test_histories import said


@pytest.mark.timeout(1200)
def test_many_histories() -> None:
    """No history breaks a promise; its seed reproduces a failing one."""
    assert said("--many", "1000") == []


def test_faults_of_the_core_are_found() -> None:
    """A thousand histories find each fault, mostly within the first ones."""
    found = dict(line.rsplit(": ", 1) for line in said("--mutants", "1200"))
    assert set(found) == set(MUTANTS)
    assert "None" not in found.values()
