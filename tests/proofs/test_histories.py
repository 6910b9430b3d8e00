"""A thousand histories of RVMaster with faults: the promises of the model of the insertion, kept by the program."""

import pytest

from tests.unit.master.test_histories import said


@pytest.mark.timeout(1200)
def test_many_histories() -> None:
    """None breaks a promise; one that did is had again by its seed."""
    assert said("--many", "1000") == []
