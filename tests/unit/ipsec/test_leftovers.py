import subprocess

import pytest

from appliance.ipsec import leftovers
from appliance.ipsec.leftovers import LeftoversError, clear_leftovers, policy_orders, state_orders

STATES = """\
src 10.88.0.2 dst 10.88.0.20
\tproto esp spi 0xcc1b8f7c reqid 2 mode tunnel
\treplay-window 0 flag af-unspec
\tencap type espinudp sport 4500 dport 40123 addr 0.0.0.0
\tanti-replay context: seq 0x0, oseq 0x0, bitmap 0x00000000
src 10.88.0.20 dst 10.88.0.2
\tproto esp spi 0x0814b96a reqid 2 mode tunnel
\tencap type espinudp sport 40123 dport 4500 addr 0.0.0.0
src 172.16.0.1 dst 172.16.0.2
\tproto esp spi 0x00000101 reqid 7 mode transport
src 172.16.0.1 dst 172.16.0.3
\tproto esp spi 0x00000102 reqid 7 mode tunnel
\tencap type espinudp sport 9999 dport 9998 addr 0.0.0.0
"""
POLICIES = """\
src 10.113.11.1/32 dst 10.113.11.2/32\x20
\tdir out priority 367231 ptype main\x20
\ttmpl src 10.88.0.2 dst 10.88.0.20
\t\tproto esp spi 0xc56462a9 reqid 1 mode tunnel
src 10.113.11.2/32 dst 10.113.11.1/32\x20
\tdir fwd priority 367231 ptype main\x20
src 10.113.11.2/32 dst 10.113.11.1/32\x20
\tdir in priority 367231 ptype main\x20
src 172.16.0.0/24 dst 10.113.11.1/24\x20
\tdir in priority 1 ptype main\x20
src 0.0.0.0/0 dst 0.0.0.0/0\x20
\tsocket in priority 0 ptype main\x20
"""


def test_only_states_of_charon_are_found() -> None:
    assert state_orders(STATES) == [
        "xfrm state delete src 10.88.0.2 dst 10.88.0.20 proto esp spi 0xcc1b8f7c",
        "xfrm state delete src 10.88.0.20 dst 10.88.0.2 proto esp spi 0x0814b96a",
    ]
    assert state_orders("") == []


def test_policies_of_the_tunnels_and_no_others() -> None:
    assert policy_orders(POLICIES, "10.113.11.1") == [
        "xfrm policy delete src 10.113.11.1/32 dst 10.113.11.2/32 dir out",
        "xfrm policy delete src 10.113.11.2/32 dst 10.113.11.1/32 dir fwd",
        "xfrm policy delete src 10.113.11.2/32 dst 10.113.11.1/32 dir in",
    ]
    assert policy_orders(POLICIES, "10.113.11.9") == []


def test_a_remaining_state_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leftovers, "_ip", lambda *words, text="": STATES if "state" in words else "")
    with pytest.raises(LeftoversError, match="0xcc1b8f7c"):
        clear_leftovers("10.113.11.1")


@pytest.mark.parametrize(
    ("complaint", "known"),
    [
        ("RTNETLINK answers: Operation not permitted", False),
        ("Cannot open netlink socket: Protocol not supported", True),
    ],
)
def test_a_kernel_that_lists_nothing(monkeypatch: pytest.MonkeyPatch, complaint: str, known: bool) -> None:
    def run(*_arguments: object, **_options: object) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess([], 1, "", complaint)

    monkeypatch.setattr(subprocess, "run", run)
    if known:
        assert clear_leftovers("10.113.11.1") == 0
    else:
        with pytest.raises(LeftoversError, match="not permitted"):
            clear_leftovers("10.113.11.1")
