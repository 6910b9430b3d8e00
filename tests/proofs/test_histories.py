"""A thousand histories of RVMaster with faults: the promises of the model of the insertion, kept by the program."""

import pytest

from tests.support.histories import MUTANTS
from tests.unit.master.test_histories import said


@pytest.mark.timeout(1200)
def test_many_histories() -> None:
    """None breaks a promise; one that did is had again by its seed."""
    assert said("--many", "1000") == []


def test_faults_of_the_core_are_found() -> None:
    """Each by one of some hundred histories, most by one of the first."""
    found = dict(line.rsplit(": ", 1) for line in said("--mutants", "400"))
    assert set(found) == set(MUTANTS)
    assert "None" not in found.values()
