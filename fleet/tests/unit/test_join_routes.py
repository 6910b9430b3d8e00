import pytest
from fastapi import HTTPException
from rosrv_fleet.app import WrongTokens

from tests.support.virtual_clock import let_time_pass


@pytest.mark.parametrize(
    ("senders", "same", "other"),
    [
        (["192.0.2.7"], "192.0.2.7", "192.0.2.8"),
        ([f"2001:db8::{host:x}" for host in range(1, 31)], "2001:db8::ffff:1", "2001:db8:0:1::1"),
    ],
    ids=["address", "IPv6 network"],
)
def test_a_sender_of_wrong_tokens_waits_a_minute(senders: list[str], same: str, other: str) -> None:
    wrong = WrongTokens()
    for number in range(30):
        wrong.require_patience(same)
        wrong.add(senders[number % len(senders)])
    with pytest.raises(HTTPException) as denied:
        wrong.require_patience(same)
    assert (denied.value.status_code, denied.value.headers) == (429, {"Retry-After": "60"})
    wrong.require_patience(other)
    let_time_pass(61)
    wrong.require_patience(same)
