import pytest

from appliance.api.front.problems import ProblemError
from appliance.features.tunnels.routes import _Patience


def test_hosts_that_send_wrong_tokens_have_to_wait() -> None:
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


def test_wrong_tokens_from_many_addresses_lock_nothing_out() -> None:
    patience = _Patience(per_minute=10)
    for number in range(1000):
        patience.failed(f"10.0.{number // 250}.{number % 250}")
    patience.require("10.9.9.9")
