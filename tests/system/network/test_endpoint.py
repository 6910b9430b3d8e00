import pytest

from appliance.network import interfaces
from appliance.network.namespaces import NetworkError
from appliance.network.public_address import PublicAddress, only_address, outward_address
from examples.landshark.lab import INTERFACE, Lab

ROUTE = "this machine's address towards its default route"
ONLY = "the only address of this machine"
LO = ("lo",)


def test_the_default_route_decides_between_addresses(lab: Lab) -> None:
    both = lab.host("both", "10.78.0.2/24", "fd78::2/64", gateway="10.78.0.1").namespace
    interfaces.add_address(both, INTERFACE, "10.79.0.2/24")
    assert outward_address(both, without=LO) == PublicAddress("10.78.0.2", ROUTE)
    six = lab.host("six", "fd78::3/64", gateway="fd78::1").namespace
    assert outward_address(six, without=LO) == PublicAddress("fd78::3", ROUTE)


def test_without_a_default_route_the_only_address_is_taken(lab: Lab) -> None:
    host = lab.host("alone", "10.78.0.4/24", "fd78::4/64").namespace
    interfaces.add_address(host, "lo", "10.113.11.1/32")
    assert (
        outward_address(host, without=LO)
        == only_address(host, without=LO)
        == PublicAddress("10.78.0.4", ONLY)
    )
    with pytest.raises(
        NetworkError, match=r"this machine has several addresses \(10\.78\.0\.4, 10\.113\.11\.1\)"
    ):
        only_address(host, without=())


def test_several_addresses_are_an_error(lab: Lab) -> None:
    host = lab.host("two", "10.78.0.5/24", "10.79.0.5/24", gateway="10.78.0.1").namespace
    with pytest.raises(NetworkError, match=r"10\.78\.0\.5, 10\.79\.0\.5"):
        only_address(host, without=LO)
    with pytest.raises(NetworkError, match="has only loopback"):
        outward_address(host, without=("lo", INTERFACE))
