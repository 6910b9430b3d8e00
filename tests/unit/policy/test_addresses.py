import ipaddress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.policy.host_sets import HostSets
from appliance.policy.model import address_of
from appliance.policy.policy_compiler import compile_policy


@given(address=st.ip_addresses())
def test_addresses_equal_those_of_ipaddress(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> None:
    ours = address_of(str(address))
    assert ours == address and hash(ours) == hash(address) and str(ours) == str(address) and repr(ours)
    assert {address: 1}[ours] == {ours: 1}[address] == 1
    assert ours in ipaddress.ip_network(address)
    assert ours is address_of(str(address))
    assert int(ours) == int(address)


@pytest.mark.parametrize("text", ["", "host", "10.0.0", "10.0.0.1/8", "1", "::g", "10.0.0.1:1"])
def test_an_invalid_address_is_refused(text: str) -> None:
    for _ in range(2):
        with pytest.raises(ValueError, match=r"\S"):
            address_of(text)


HOSTS = ("10.1.2.3", "10.1.9.9", "::ffff:10.1.2.3", "10.2.0.1", "10.2.0.2")


def test_the_narrowest_network_names_a_host() -> None:
    table = HostSets()
    for text in ("10.1.0.0/16", "10.1.2.0/24"):
        table.network(ipaddress.ip_network(text))
    hosts = ("10.1.2.3", "10.1.9.9", "::ffff:10.1.2.3", "10.2.0.1")
    assert [str(table.narrowest(address_of(host))) for host in hosts] == [
        "10.1.2.0/24", "10.1.0.0/16", "10.1.2.0/24", "None",
    ]  # fmt: skip


def test_hosts_that_are_named_alike() -> None:
    policy = compile_policy("[Nodes]\n/** = 10.1.0.0/16\ndefault = *\n", file="a.ini")
    alike, names = ({host: ask(address_of(host)) for host in HOSTS} for ask in (policy.alike, policy.names))
    assert list(alike.values()) == ["10.1.0.0/16", "10.1.0.0/16", "10.1.0.0/16", "10.2.0.1/32", "10.2.0.2/32"]
    assert list(names.values()) == [True, True, True, False, False]
