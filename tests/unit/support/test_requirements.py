"""Tests of the requirements that a test may place on the machine."""

import pytest

from tests.support.requirements import needs


def test_a_met_requirement_lets_the_test_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """A condition that holds has no effect, in CI or elsewhere."""
    monkeypatch.setenv("CI", "true")
    needs(True, "nothing")


def test_an_unmet_requirement_skips_on_a_laptop(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without CI the test is skipped with the reason."""
    monkeypatch.delenv("CI", raising=False)
    with pytest.raises(pytest.skip.Exception, match="needs a robot"):
        needs(False, "a robot")


def test_an_unmet_requirement_fails_in_ci(monkeypatch: pytest.MonkeyPatch) -> None:
    """With CI=true the test fails with the reason."""
    monkeypatch.setenv("CI", "true")
    with pytest.raises(pytest.fail.Exception, match="needs a robot"):
        needs(False, "a robot")
