import ipaddress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.policy.host_sets import HostSets
from appliance.policy.model import address_of


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


def test_hosts_that_are_named_alike() -> None:
    table = HostSets()
    table.network(ipaddress.ip_network("10.1.0.0/16"))
    for _ in range(2):
        assert table.alike(address_of("10.1.2.3")) == table.alike(address_of("10.1.9.9")) == "10.1.0.0/16"
        assert table.alike(address_of("10.2.0.1")) != table.alike(address_of("10.2.0.2"))
        assert table.alike(address_of("::ffff:10.1.2.3")) == "10.1.0.0/16"
        assert (table.names(address_of("10.1.2.3")), table.names(address_of("10.2.0.1"))) == (True, False)
