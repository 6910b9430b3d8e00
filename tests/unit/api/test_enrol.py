"""Tests of how enrolment by one-time tokens bears wrong ones."""

import pytest

from appliance.api.enrol import _Patience
from appliance.api.problems import ProblemError


def test_who_brings_wrong_tokens_has_to_wait() -> None:
    """One host after so many; and any host that brought one already, while all together bring too many."""
    patience = _Patience(per_minute=10)
    for _ in range(10):
        patience.require("10.0.0.1")
        patience.failed("10.0.0.1")
    with pytest.raises(ProblemError) as refused:
        patience.require("10.0.0.1")
    assert refused.value.status == 429
    for number in range(60):
        patience.failed(f"10.0.1.{number}")
    with pytest.raises(ProblemError):
        patience.require("10.0.1.7")


def test_a_stranger_with_many_addresses_keeps_nobody_out() -> None:
    """However many wrong tokens others brought, a host that brought none is looked at."""
    patience = _Patience(per_minute=10)
    for number in range(1000):
        patience.failed(f"10.0.{number // 250}.{number % 250}")
    patience.require("10.9.9.9")
